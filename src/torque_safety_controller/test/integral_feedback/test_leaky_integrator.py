# SPDX-License-Identifier: Apache-2.0
"""Leaky integration: exact for any step, and (13) as printed."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from torque_safety_controller.integral_feedback import LeakyIntegrator
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors


@pytest.mark.parametrize("theta", [0.0, 7.0])
def test_exact_for_any_step(theta):
    """Against (12) itself, solved numerically, for s' constant between samples."""
    rng = np.random.default_rng(0)
    integrator = LeakyIntegrator(theta, 3)
    expected, s_last = np.zeros(3), np.zeros(3)
    for dt in 10.0 ** rng.uniform(-4.0, 0.5, 12):
        s = s_last + rng.normal(size=3)
        solution = solve_ivp(
            lambda _, y, slope=(s - s_last) / dt: slope - theta * y,
            (0.0, dt),
            expected,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        )
        expected, s_last = solution.y[:, -1], s
        np.testing.assert_allclose(integrator.update(s, dt), expected, rtol=1e-9, atol=1e-11)


def test_longest_and_shortest_steps():
    for theta, dt, left in ((1e300, 1e300, 0.0), (1e-300, 1e-300, 2.0), (1e3, 1e3, 1e-6)):
        integrator = LeakyIntegrator(theta, 1)
        integrator.update([1.0], 0.0)
        assert integrator.update([2.0], dt)[0] == pytest.approx(left, rel=1e-6)


def test_paper_form_is_equation_13():
    for theta, dt in ((30.0, 0.002), (0.0, 1.0), (1e3, 1e3)):
        assert leak_factors(theta, dt, True) == (math.exp(-theta * dt), 1.0)


def test_refuses_what_it_cannot_use_and_keeps_what_it_has():
    for theta in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="theta must be a finite number >= 0"):
            LeakyIntegrator(theta, 2)
    with pytest.raises(ValueError, match="n must be at least 1"):
        LeakyIntegrator(1.0, 0)
    integrator = LeakyIntegrator(1.0, 2)
    before = integrator.update([1.0, 2.0], 0.1)
    for s in ([1.0], [1.0, math.nan], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match="s must be 2 finite numbers"):
            integrator.update(s, 0.1)
    for dt in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="dt must be a finite number >= 0"):
            integrator.update([5.0, 5.0], dt)
    np.testing.assert_array_equal(integrator.update([1.0, 2.0], 0.0), before)
