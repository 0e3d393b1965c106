# SPDX-License-Identifier: Apache-2.0
"""The drift of accelerations under a held torque, against Pinocchio and in closed form."""

import math

import numpy as np
import pinocchio as pin
import pytest
from estimated_models import GRAVITY, PENDULUM_LENGTH, baxter, pendulum

from viability_bounds_pkg.estimate.drift import (
    acceleration_drift,
    jerk_limits,
    jerk_under_held_torque,
)
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


def test_jerk_of_a_pendulum_in_closed_form():
    """At its lowest point gravity's torque takes most of the rate."""
    model = pendulum()
    space = StateSpace.of(model, [-1.0], [1.0], [2.0], [1000.0])
    inertia = pin.crba(model, model.createData(), np.zeros(1))[0, 0]
    drift = GRAVITY / PENDULUM_LENGTH * 2.0
    found = jerk_limits(model, space, [-3.0], [3.0], [50.0 * inertia], 500)
    assert found[0] == pytest.approx(50.0 - drift, rel=1e-3)
    with pytest.raises(LimitEstimateError, match="too small to keep accelerations at q = "):
        jerk_limits(model, space, [-3.0], [3.0], [0.9 * drift * inertia], 500)


def test_torques_of_the_jerk_found_keep_the_rate():
    """Against the inverse dynamics of motions that are not those searched."""
    model, rate, step = baxter(), 500.0, 1e-6
    rng, data = np.random.default_rng(3), model.createData()
    size = np.full(7, 3.0)
    space = StateSpace.of(model, -size / 2.0, size / 2.0, np.full(7, 1.0), np.full(7, 200.0))
    jerk = jerk_limits(model, space, -size, size, np.full(7, rate), 100)
    largest = 0.0
    for _ in range(500):
        q = rng.uniform(-1.5, 1.5, 7)
        v, a, change = (rng.choice([-1.0, 1.0], 7) * each for each in (1.0, 3.0, step * jerk))
        now = pin.rnea(model, data, q, v, a)
        later = pin.rnea(model, data, q + step * v, v + step * a, a + change)
        largest = max(largest, np.abs(later - now).max() / step)
    assert 0.7 * rate < largest <= rate


def test_limits_without_a_state_within_torque_limits_are_refused():
    model = pendulum()
    space = StateSpace.of(model, [-1], [1], [1], [1.0])
    with pytest.raises(LimitEstimateError, match="within the torque limits"):
        acceleration_drift(model, space, [90], [91], samples=50)
    with pytest.raises(LimitEstimateError, match="a_min < a_max"):
        acceleration_drift(model, space, [1.0], [math.nan])
