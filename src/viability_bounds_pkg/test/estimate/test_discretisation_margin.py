# SPDX-License-Identifier: Apache-2.0
"""The margin for a torque held over a period, against Pinocchio and in closed form."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest
from estimated_models import GRAVITY, PENDULUM_LENGTH, baxter, limits_of, panda, pendulum

from viability_bounds_pkg.estimate.hold_error import (
    discretisation_margin,
    jerk_under_held_torque,
    mid_step_torque,
    zero_order_hold_error,
)
from viability_bounds_pkg.estimate.worst_case import LimitEstimateError


def test_acceleration_rate_is_the_time_derivative():
    model = panda()
    rng = np.random.default_rng(2)
    q, v = rng.uniform(-1, 1, (3, 7)), rng.uniform(-2, 2, (3, 7))
    a = rng.uniform(-9, 9, (3, 7))
    tau, rate = jerk_under_held_torque(model, q, v, a)
    data, step = model.createData(), 1e-5
    for i in range(3):
        later, earlier = (
            pin.aba(model, data, q[i] + t * v[i] + t * t / 2 * a[i], v[i] + t * a[i], tau[i])
            for t in (step, -step)
        )
        np.testing.assert_allclose(rate[i], (later - earlier) / (2 * step), rtol=1e-5, atol=1e-4)


def test_zero_order_hold_error_do_not_depend_on_the_integration_step():
    model = panda()
    rng = np.random.default_rng(4)
    q, v, a = rng.uniform(-1, 1, (5, 7)), rng.uniform(-2, 2, (5, 7)), rng.uniform(-9, 9, (5, 7))
    tau = mid_step_torque(model, q, v, a, 0.01)
    coarse = zero_order_hold_error(model, q, v, a, tau, 0.01)
    fine = zero_order_hold_error(model, q, v, a, tau, 0.01, substeps=16)
    np.testing.assert_allclose(coarse, fine, rtol=2e-3, atol=1e-5)


def test_zero_order_hold_error_of_a_pendulum_in_closed_form():
    """Leading orders of the error: gravity's torque changes as the pendulum swings."""
    model = pendulum()
    q, v, a, dt = np.array([[0.4]]), np.array([[2.0]]), np.array([[3.0]]), 1e-3
    rate = GRAVITY / PENDULUM_LENGTH * math.cos(0.4) * 2.0
    held = zero_order_hold_error(model, q, v, a, mid_step_torque(model, q, v, a, dt), dt)[0, :, 0]
    assert held[0] == pytest.approx(rate * dt / 2, rel=0.01)
    assert held[1] < 1e-3 * held[0]
    assert held[2] == pytest.approx(rate * dt**3 / 12, rel=0.01)
    plain = zero_order_hold_error(model, q, v, a, mid_step_torque(model, q, v, a, 0.0), dt)[
        0, :, 0
    ]
    assert plain[0] == pytest.approx(rate * dt, rel=0.01)
    assert plain[1] == pytest.approx(rate * dt / 2, rel=0.01)
    assert plain[2] == pytest.approx(rate * dt**3 / 6, rel=0.01)


def margin_of(dt, **options):
    model = baxter()
    bound = np.array([5.0, 3.0, 11.0, 15.0, 15.0, 15.0, 15.0])
    options = {"samples": 3000, "seed": 0, "starts": 4, "rounds": 4} | options
    return discretisation_margin(
        model, *limits_of(model)[:3], -bound, bound, model.effortLimit, dt, **options
    )


def test_mid_step_errors_follow_from_the_jerk():
    margin = margin_of(0.002)
    np.testing.assert_allclose(margin.acceleration, margin.jerk * 0.001, rtol=0.1)
    assert np.all(margin.mean_acceleration < 0.05 * margin.acceleration)
    np.testing.assert_allclose(margin.position, margin.jerk * 0.002**3 / 12, rtol=0.1)


def test_error_is_of_first_order_in_the_period():
    whole, half = margin_of(0.002), margin_of(0.001)
    np.testing.assert_allclose(half.acceleration / whole.acceleration, 0.5, atol=0.03)


def test_margin_is_attained_within_the_limits():
    held, model = margin_of(0.002), baxter()
    for j in range(7):
        q, v, a = held.q[j : j + 1], held.v[j : j + 1], held.a[j : j + 1]
        assert np.all((model.lowerPositionLimit <= q) & (q <= model.upperPositionLimit))
        assert np.all(np.abs(v) <= model.velocityLimit)
        tau = mid_step_torque(model, q, v, a, 0.002)
        assert np.all(np.abs(tau) <= model.effortLimit)
        errors = zero_order_hold_error(model, q, v, a, tau, 0.002)
        assert errors[0, 0, j] == pytest.approx(held.acceleration[j], rel=1e-9)


def test_local_search_finds_worse_than_sampling():
    sampled, searched = margin_of(0.002, rounds=0), margin_of(0.002)
    assert np.all(searched.acceleration >= sampled.acceleration)
    assert np.count_nonzero(searched.acceleration > 1.2 * sampled.acceleration) >= 4


@pytest.mark.parametrize("dt", [0.0, -1.0, math.nan])
def test_margin_needs_a_period(dt):
    with pytest.raises(LimitEstimateError, match="dt must be positive"):
        margin_of(dt)


def test_margin_without_a_state_within_torque_limits():
    model = pendulum()
    with pytest.raises(LimitEstimateError, match="within the torque limits"):
        discretisation_margin(model, [-1], [1], [1], [90], [91], [1.0], 0.01, samples=50)
