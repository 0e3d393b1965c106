# SPDX-License-Identifier: Apache-2.0
"""The integral action of an arm whose motors give what they are told, less a disturbance."""

import math

import numpy as np
import pytest
from integral_loop import (
    ARM,
    DT,
    LAMBDA,
    REST,
    IntegralLoop,
    N,
    make_settings,
    relative,
    settled,
)

from torque_safety_controller.integral_feedback import MODES
from viability_bounds_pkg.state import State

# No jumps


@pytest.mark.parametrize("mode", MODES[1:])
def test_what_is_forgotten_again_and_again_fades_from_what_it_was(mode):
    """As while the motors do not do as they are told: no time counts then."""
    loop = settled(mode)
    torques = [loop.action.last.copy()]
    for _ in range(500):
        loop.action.forget()
        loop.robot.update(State(loop.robot.q, loop.robot.v), np.zeros(N))
        torques.append(loop.action.torque(loop.robot, np.zeros(N), math.inf))
    assert relative(torques[0]) > 0.03
    assert relative(np.diff(torques, axis=0)) < 0.02 * relative(torques[0])
    np.testing.assert_allclose(torques[-1], torques[0] * math.exp(-500 * DT / 0.2), rtol=0.05)


@pytest.mark.parametrize("mode", ["joints", "task"])
@pytest.mark.parametrize(
    "others",
    [
        {"budget": 0.01 * ARM.tau_max},
        {"budget": np.zeros(N)},
        {"gain": 2.0},
        {"gain": 80.0},
        {"slow_leak_rate": 1.0},
        {"fast_leak_rate": 5.0},
        {"mu": 0.0},
        {"mu": 0.9},
    ],
    ids=" ".join,
)
def test_settings_change_without_a_jump(mode, others):
    loop = settled(mode)
    loop.action.settings = make_settings(**others)
    loop.run(0.1)
    assert loop.steps(100) < (2e-3 if mode == "joints" else 5e-3)


@pytest.mark.parametrize("mode", ["joints", "task"])
def test_a_budget_that_shrinks_is_kept_soon(mode):
    loop = settled(mode)
    small, begin = 0.01 * ARM.tau_max, relative(loop.action.last)
    loop.action.settings = make_settings(budget=small)
    for _ in range(1000):
        loop.step()
        assert relative(loop.action.last) < 1.05 * begin
    loop.run(5.0)
    assert (np.abs(loop.action.last) <= 1.02 * small).all()
    assert loop.action.saturated.any()


# Initialising


@pytest.mark.parametrize("mode", MODES)
def test_it_begins_with_the_torque_it_is_told(mode):
    rng = np.random.default_rng(5)
    for _ in range(20):
        loop = IntegralLoop(mode)
        torque = rng.uniform(-0.3, 0.3, N) * ARM.tau_max
        loop.robot.update(State(loop.q, REST), REST)
        loop.action.resume(loop.robot, torque)
        np.testing.assert_array_equal(loop.action.last, torque)
        after = loop.action.torque(loop.robot, REST, DT)
        assert relative(after - torque) <= 0.01


def test_what_cannot_be_initialised_fades():
    loop = IntegralLoop("joints")
    loop.robot.update(State(loop.q, REST), REST)
    loop.robot.C = -LAMBDA * np.diag(np.diagonal(loop.robot.M))  # C + K is singular
    torque = 0.1 * ARM.tau_max
    loop.action.resume(loop.robot, torque)
    np.testing.assert_array_equal(loop.action.last, torque)
    after = loop.action.torque(loop.robot, REST, DT)
    np.testing.assert_allclose(after, torque * math.exp(-DT / 0.2), rtol=1e-9)
