# SPDX-License-Identifier: Apache-2.0
"""The drift of accelerations under a held torque, against Pinocchio and in closed form."""

import math

import numpy as np
import pinocchio as pin
import pytest
from estimated_models import GRAVITY, PENDULUM_LENGTH, baxter, limits_of, pendulum

from viability_bounds_pkg.estimate.drift import acceleration_drift
from viability_bounds_pkg.estimate.worst_case import LimitEstimateError, StateSpace


def test_drift_of_a_pendulum_in_closed_form():
    """Gravity's torque changes fastest as the pendulum swings through its lowest point."""
    model = pendulum()
    space = StateSpace.of(model, [-1.0], [1.0], [2.0], [1000.0])
    found = acceleration_drift(model, space, [-3.0], [3.0], 500)
    assert found[0] == pytest.approx(GRAVITY / PENDULUM_LENGTH * 2.0, rel=1e-3)


def test_a_torque_for_the_middle_of_a_period_is_off_by_half_the_period_s_drift():
    """Near worst states: what docs/theory/bounds.md concludes from the drift."""
    model, dt, bound = baxter(), 0.002, np.array([5.0, 3.0, 11.0, 15.0, 15.0, 15.0, 15.0])
    space, data = StateSpace.of(model, *limits_of(model)), model.createData()
    most = acceleration_drift(model, space, -bound, bound, 3000, starts=4, rounds=4)
    q_min, q_max, v_max, _ = limits_of(model)
    rng, largest = np.random.default_rng(1), np.zeros(7)
    for _ in range(2000):
        q, v = rng.uniform(q_min, q_max), v_max * rng.choice([-1.0, 1.0], 7)
        a = rng.uniform(-3.0, 3.0, 7)
        tau = pin.rnea(model, data, q + 0.5 * dt * v + 0.125 * dt**2 * a, v + 0.5 * dt * a, a)
        if (np.abs(tau) <= model.effortLimit).all():
            largest = np.maximum(largest, np.abs(pin.aba(model, data, q, v, tau) - a))
    assert (largest <= 1.02 * 0.5 * dt * most).all()
    assert (largest > 0.1 * 0.5 * dt * most).any()


def test_limits_without_a_state_within_torque_limits_are_refused():
    model = pendulum()
    space = StateSpace.of(model, [-1], [1], [1], [1.0])
    with pytest.raises(LimitEstimateError, match="within the torque limits"):
        acceleration_drift(model, space, [90], [91], samples=50)
    with pytest.raises(LimitEstimateError, match="a_min < a_max"):
        acceleration_drift(model, space, [1.0], [math.nan])
