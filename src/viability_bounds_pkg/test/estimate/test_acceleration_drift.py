# SPDX-License-Identifier: Apache-2.0
"""The drift of accelerations under a held torque, against Pinocchio and in closed form."""

import math

import numpy as np
import pinocchio as pin
import pytest
from estimated_models import GRAVITY, PENDULUM_LENGTH, baxter, pendulum

from viability_bounds_pkg.estimate.drift import acceleration_drift, jerk_under_held_torque
from viability_bounds_pkg.estimate.worst_case import LimitEstimateError, StateSpace


def test_drift_of_a_pendulum_in_closed_form():
    """Gravity's torque changes fastest as the pendulum swings through its lowest point."""
    model = pendulum()
    space = StateSpace.of(model, [-1.0], [1.0], [2.0], [1000.0])
    found = acceleration_drift(model, space, [-3.0], [3.0], 500)
    assert found[0] == pytest.approx(GRAVITY / PENDULUM_LENGTH * 2.0, rel=1e-3)


def test_the_drift_is_the_time_derivative_of_the_acceleration():
    model, step = baxter(), 1e-5
    rng, data = np.random.default_rng(2), model.createData()
    q, v, a = (rng.uniform(-size, size, (3, 7)) for size in (1.0, 2.0, 9.0))
    tau, rate = jerk_under_held_torque(model, q, v, a)
    for i in range(3):
        later, earlier = (
            pin.aba(model, data, q[i] + t * v[i] + t * t / 2 * a[i], v[i] + t * a[i], tau[i])
            for t in (step, -step)
        )
        np.testing.assert_allclose(rate[i], (later - earlier) / (2 * step), rtol=1e-5, atol=1e-4)


def test_limits_without_a_state_within_torque_limits_are_refused():
    model = pendulum()
    space = StateSpace.of(model, [-1], [1], [1], [1.0])
    with pytest.raises(LimitEstimateError, match="within the torque limits"):
        acceleration_drift(model, space, [90], [91], samples=50)
    with pytest.raises(LimitEstimateError, match="a_min < a_max"):
        acceleration_drift(model, space, [1.0], [math.nan])
