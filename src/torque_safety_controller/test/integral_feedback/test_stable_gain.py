# SPDX-License-Identifier: Apache-2.0
"""The gain of the integral action is stable in every posture, and changes seldom."""

import numpy as np
import pytest
from arms import load_arm

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.integral_feedback.stable_gain import coupling
from torque_safety_controller.parts.integral import IntegralAction
from viability_bounds_pkg.state import State

DT = 0.002
REST = np.zeros(7)
ARM = load_arm("panda")


def at(q):
    robot = ARM.robot(DT)
    robot.update(State(q, REST), REST)
    return robot


def action(gain):
    return IntegralAction("joints", IntegralSettings(ARM.tau_max, gain), 2.0 * ARM.tau_max)


def used(made, robot):
    """The gain after a step."""
    made.torque(robot, REST, DT)
    return made.gain


def radius(gain, M):
    """By how much the errors of an ideal arm's speeds grow in a period, at most."""
    step = np.eye(len(M)) - gain * DT * np.linalg.solve(M, np.diag(np.diag(M)))
    return np.abs(np.linalg.eigvals(step)).max()


def test_errors_do_not_grow_in_any_posture_and_a_stable_gain_is_kept():
    rng = np.random.default_rng(1)
    grows = 0
    for _ in range(60):
        robot = at(ARM.random_state(rng)[0])
        M = robot.M
        grows += radius(100.0, M) > 1.0
        gain = used(action(100.0), robot)
        assert radius(gain, M) <= 1.0 + 1e-9
        largest = np.linalg.eigvals(np.linalg.solve(M, np.diag(np.diag(M)))).real.max()
        assert coupling(M) == pytest.approx(largest, rel=1e-9)
        # No lower than it must be.
        assert gain >= min(100.0, 1.0 / (DT * largest) / np.sqrt(2.0)) * 0.999
    assert 15 < grows < 57  # with the gain as asked


def test_it_follows_an_arm_that_moves():
    rng = np.random.default_rng(2)
    made = action(1000.0)
    q, goal = (ARM.random_state(rng)[0] for _ in range(2))
    gains = []
    for way in np.r_[np.linspace(0.0, 1.0, 400), np.linspace(1.0, 0.0, 400)]:
        robot = at(q + way * (goal - q))
        gains.append(used(made, robot))
        assert radius(gains[-1], robot.M) <= 1.0 + 1e-9
        assert gains[-1] >= 0.99 * used(action(1000.0), robot) / np.sqrt(2.0)
    assert 3 < np.count_nonzero(np.diff(gains)) < 26
    # In steps of sqrt(2).
    assert len(set(np.round(np.log2(1000.0 / np.array(gains)) * 2.0, 6) % 1.0)) == 1


def test_a_matrix_that_is_none_has_no_coupling():
    M = at(REST).M
    for bad in (np.full_like(M, np.nan), -M, np.zeros_like(M)):
        assert np.isnan(coupling(bad))
