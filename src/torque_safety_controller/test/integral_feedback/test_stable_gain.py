# SPDX-License-Identifier: Apache-2.0
"""The gain of the integral action is stable in every posture, and changes seldom."""

import numpy as np
import pytest
from arms import load_arm

from torque_safety_controller.integral_feedback.stable_gain import StableGain
from viability_bounds_pkg.state import State

DT = 0.002


@pytest.fixture(scope="module")
def arm():
    return load_arm("panda")


def mass(arm, q):
    robot = arm.robot(DT)
    robot.update(State(q, np.zeros(arm.n)), np.zeros(arm.n))
    return robot.M.copy()


def radius(gain, M):
    """Return by how much the errors of an ideal arm's speeds grow in a period, at most."""
    step = np.eye(len(M)) - gain * DT * np.linalg.solve(M, np.diag(np.diag(M)))
    return np.abs(np.linalg.eigvals(step)).max()


def test_errors_do_not_grow_in_any_posture_and_an_asked_gain_that_is_stable_is_kept(arm):
    rng = np.random.default_rng(1)
    grows = 0
    for _ in range(200):
        M = mass(arm, arm.random_state(rng)[0])
        grows += radius(100.0, M) > 1.0
        used = StableGain(arm.n).of(100.0, M, DT, 1.0)
        assert radius(used, M) <= 1.0
        least = 1.0 / (DT * np.linalg.eigvals(np.linalg.solve(M, np.diag(np.diag(M)))).real.max())
        assert used >= min(100.0, least / np.sqrt(2.0)) * 0.999  # no lower than it must be
    assert 50 < grows < 190  # with the gain as asked


def test_it_follows_an_arm_that_moves(arm):
    rng = np.random.default_rng(2)
    stable = StableGain(arm.n)
    q, goal = arm.random_state(rng)[0], arm.random_state(rng)[0]
    used = []
    for k in range(1500):
        if k % 500 == 499:
            q, goal = goal, arm.random_state(rng)[0]
        M = mass(arm, q + (goal - q) * (k % 500) / 500)
        used.append(stable.of(1000.0, M, DT, 1.0))
        assert radius(used[-1], M) <= 1.0
        assert used[-1] >= 0.99 * StableGain(arm.n).of(1000.0, M, DT, 1.0) / np.sqrt(2.0)
    assert 3 < np.count_nonzero(np.diff(used)) < 40
    assert len(set(np.round(np.log2(1000.0 / np.array(used)) * 2.0, 6) % 1.0)) == 1


def test_a_matrix_that_is_none_changes_nothing(arm):
    stable = StableGain(arm.n)
    M = mass(arm, np.zeros(arm.n))
    used = stable.of(1000.0, M, DT, 1.0)
    assert used < 1000.0
    for bad in (np.full_like(M, np.nan), -M, np.zeros_like(M)):
        assert stable.of(1000.0, bad, DT, 1.0) == used
    assert stable.of(1000.0, M, DT, 1.0) == used
