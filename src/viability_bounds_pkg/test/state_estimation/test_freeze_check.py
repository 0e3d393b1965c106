# SPDX-License-Identifier: Apache-2.0
"""States that freeze are told, also those of an arm that stands; arms that only stand are not."""

import numpy as np
import pinocchio as pin
import pytest
from sample_arm import MODEL, NONE, TAU_MAX, N

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.freeze_check import (
    ALIVE,
    FRICTION,
    FROZEN,
    ROW_TIME,
    STATES,
    STICTION,
    Expected,
)
from viability_bounds_pkg.state_estimation.state_check import WINDOW, StateCheck

REST = State(np.linspace(-0.5, 0.7, N), NONE)
M = pin.crba(MODEL, MODEL.createData(), REST.q)


class Arm:
    """States of an arm one after the other, and what they were taken for."""

    def __init__(self, rate=500.0, noise=0.0):
        limit = np.full(N, 2.5)
        self.check = StateCheck(MODEL, -limit, limit, TAU_MAX, NONE, NONE)
        self.h, self.noise, self.t = 1.0 / rate, noise, 1.0
        self.rng = np.random.default_rng(4)

    def play(self, time, states=lambda t: REST, a=NONE, friction=FRICTION, **known):
        """Go on for some time, s; return when states were refused, from now on, and why."""
        begin, refused = self.t, {}
        while self.t < begin + time - 1e-9:
            self.t += self.h
            q, v = states(self.t - begin)
            v = v + self.noise * self.rng.standard_normal(N)
            wrong = self.check.look(State(q, v), self.t)
            self.check.expect(Expected(a, friction, **known))
            if wrong:
                refused[self.t - begin] = wrong
        return refused


@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0])
def test_an_arm_with_noise_that_stands_is_told_to_be_frozen(rate):
    arm = Arm(rate, noise=1e-6)
    assert not arm.play(1.1 * max(ALIVE, STATES / rate))
    arm.noise = 0.0
    refused = arm.play(0.1)
    assert min(refused) <= max(ROW_TIME, 3.0 / rate) + 2.1 / rate
    assert set(refused.values()) == {FROZEN}
    arm.noise = 1e-6  # awake again
    again = arm.play(2.0)
    assert WINDOW - arm.h <= max(again) <= WINDOW + 2.0 * arm.h


def test_velocities_alone_that_freeze_are_told():
    arm = Arm(noise=1e-6)
    assert not arm.play(1.1 * ALIVE)
    arm.noise = 0.0

    def moves(t):
        return State(REST.q + 0.1 * t, np.full(N, 0.1))

    assert not Arm().play(0.5, moves)  # that may be, where there is no noise
    assert min(arm.play(0.5, moves)) <= ROW_TIME + 2.1 * arm.h


def test_an_arm_without_noise_that_stands_is_believed_however_long():
    arm = Arm()
    assert not arm.play(20.0)
    assert not arm.play(5.0, a=np.full(N, 0.2))  # posture error, held by a payload


@pytest.mark.parametrize("frequency", [0.0, 3.0])
def test_motions_that_end_and_rounding_are_no_noise(frequency):
    """Afterwards the arm may stand, or all its joints have the same speed, to the last bit."""
    arm = Arm()

    def ends(t):
        v = 0.009 * np.exp(-t / 0.3) * np.cos(2.0 * np.pi * frequency * t)
        return State(REST.q, np.full(N, v))

    assert not arm.play(2.0, ends)
    assert not arm.play(0.5)
    arm.noise = 1e-15
    assert not arm.play(2.0)
    arm.noise = 0.0
    assert not arm.play(0.5)
    assert not arm.play(0.5, lambda t: State(REST.q + t, np.full(N, 1.0)))


def test_where_noise_ended_the_arm_is_believed_in_the_end():
    """Brakes, for example, that take it off."""
    arm = Arm(noise=1e-6)
    assert not arm.play(1.1 * ALIVE)
    arm.noise = 0.0
    refused = arm.play(20.0)
    assert max(refused) < 3.0 * WINDOW


@pytest.mark.parametrize("friction", [0.0, FRICTION])
@pytest.mark.parametrize("joint", range(N))
def test_an_arm_that_is_to_move_is_told_before_it_is_fast(joint, friction):
    a = np.zeros(N)
    torque = np.zeros(N)
    torque[joint] = 2.0 * FRICTION * TAU_MAX[joint]
    a = np.linalg.solve(M, torque)
    a *= 10.0 / np.abs(a).max()
    beyond = np.abs(M @ a) - friction * TAU_MAX
    arm = Arm()
    assert not arm.play(1.0)
    refused = arm.play(0.1, a=a, friction=friction)
    told = min(refused, default=np.inf)
    if friction == 0.0:
        assert 0.02 < told < 0.045  # 5 mrad take 32 ms
    elif (beyond <= 0.0).all():
        assert not refused  # friction may hold it
    else:
        assert told < 0.1


def test_friction_and_what_is_known_to_disturb_may_hold_the_arm():
    a = np.zeros(N)
    a[0] = 0.9 * STICTION * TAU_MAX[0] / M[0, 0]
    a = np.linalg.solve(M, np.clip(M @ a, -0.9 * STICTION * TAU_MAX, 0.9 * STICTION * TAU_MAX))
    arm = Arm()
    assert not arm.play(3.0, a=a, friction=STICTION)
    big = np.linalg.solve(M, 0.5 * TAU_MAX)
    arm = Arm()
    assert not arm.play(3.0, a=big, disturbance=-big)
    assert Arm().play(0.1, a=big)


def test_what_moves_and_freezes_is_told_as_soon_as_it_must_have_moved():
    def moves(t):
        return State(REST.q + np.sin(t), np.full(N, np.cos(t)))

    arm = Arm()
    assert not arm.play(0.5, moves)
    last = moves(0.5)
    refused = arm.play(0.3, lambda t: last)
    assert min(refused) <= 5e-3 / last.v[0] + 3.1 * arm.h
