# SPDX-License-Identifier: Apache-2.0
"""Accelerations that the motors can give, next to those wanted."""

import numpy as np
import pytest

from viability_bounds_pkg.stop import STIFFNESS, within_torque_limits


def problem(seed, n=5, weak=1):
    """A random arm whose first motors are too weak for what is wanted."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    M = root @ root.T + 0.3 * np.eye(n)
    a, scale = rng.uniform(-1.0, 1.0, n), rng.uniform(1.0, 5.0, n)
    lower, upper = a - rng.uniform(0.0, 3.0, n), a + rng.uniform(0.0, 3.0, n)
    tau = M @ a + rng.normal(size=n)
    tau_max = 1.2 * np.abs(tau) + 0.5
    tau_max[:weak] = 0.6 * np.abs(tau[:weak])
    return a, lower, upper, scale, M, tau, tau_max


def cost(a, given, lower, upper, scale):
    departure = (given - np.clip(given, lower, upper)) / scale
    return np.sum(((given - a) / scale) ** 2) + STIFFNESS * np.sum(departure**2)


def test_what_is_feasible_is_left_alone():
    a, lower, upper, scale, M, tau, _ = problem(0)
    np.testing.assert_array_equal(
        within_torque_limits(a, lower, upper, scale, M, tau, 1.01 * np.abs(tau)), a
    )


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("weak", [1, 2])
def test_torque_limits_hold_and_nothing_feasible_is_nearer(seed, weak):
    a, lower, upper, scale, M, tau, tau_max = problem(seed, weak=weak)
    found = within_torque_limits(a, lower, upper, scale, M, tau, tau_max)
    torque = tau + M @ (found - a)
    assert (np.abs(torque) <= tau_max * (1.0 + 1e-5)).all()
    best = cost(a, found, lower, upper, scale)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(200):
            other = np.clip(torque + size * tau_max * rng.normal(size=len(a)), -tau_max, tau_max)
            candidate = a + np.linalg.solve(M, other - tau)
            assert cost(a, candidate, lower, upper, scale) > best * (1.0 - 1e-3)


def test_a_joint_at_its_limit_is_helped_by_the_others():
    """The first motor is too weak; the second joint helps where the first is at its limit."""
    M = np.array([[1.0, 0.8], [0.8, 1.0]])
    a, tau = np.array([-3.0, 0.0]), np.array([-3.0, -2.4])
    tau_max = np.array([2.0, 20.0])
    wide, edge = np.full(2, np.inf), np.array([-3.0, np.inf])
    alone = within_torque_limits(a, -wide, wide, np.ones(2), M, tau, tau_max)
    helped = within_torque_limits(a, -wide, edge, np.ones(2), M, tau, tau_max)
    assert alone[0] > -2.5
    assert helped[0] == pytest.approx(-3.0, abs=0.01)
    assert helped[1] > 1.0
