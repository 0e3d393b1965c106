# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from torque_safety_controller.integral_feedback import LeakyIntegrator
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors

SHARP = 1e-12


def ramps(rng, steps):
    """Times and samples of an s that is piecewise linear, with steps of any length."""
    dts = 10.0 ** rng.uniform(-4.0, 0.5, steps)
    return dts, np.cumsum(rng.normal(size=(steps, 3)), axis=0)


@pytest.mark.parametrize("theta", [0.0, 0.1, 7.0, 100.0])
def test_exact_for_any_step(theta):
    """Against (12) itself, solved numerically, for s' constant between samples."""
    dts, samples = ramps(np.random.default_rng(0), 12)
    integrator = LeakyIntegrator(theta, 3)
    expected, s_last = np.zeros(3), np.zeros(3)
    for dt, s in zip(dts, samples, strict=True):
        slope = (s - s_last) / dt
        solution = solve_ivp(
            lambda _, y, slope=slope: slope - theta * y,
            (0.0, dt),
            expected,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        )
        expected, s_last = solution.y[:, -1], s
        np.testing.assert_allclose(integrator.update(s, dt), expected, rtol=1e-9, atol=1e-11)


@given(
    st.floats(0.0, 1e3),
    st.floats(1e-6, 10.0),
    st.integers(1, 20),
    st.floats(-1e3, 1e3),
    st.floats(-1e3, 1e3),
)
@settings(deadline=None, derandomize=True)
def test_many_steps_are_one(theta, dt, parts, start, increment):
    """A step may be cut in any number of parts: the exact form is consistent with itself."""
    whole, cut = LeakyIntegrator(theta, 1), LeakyIntegrator(theta, 1)
    for integrator in (whole, cut):
        integrator.update([start], 0.0)
    whole.update([start + increment], dt)
    for k in range(parts):
        cut.update([start + increment * (k + 1) / parts], dt / parts)
    size = abs(start) + abs(increment)
    np.testing.assert_allclose(cut.value, whole.value, rtol=0.0, atol=1e-11 * size)


def test_without_leak_it_is_the_plain_integrator():
    integrator = LeakyIntegrator(0.0, 3)
    for dt, s in zip(*ramps(np.random.default_rng(1), 50), strict=True):
        np.testing.assert_allclose(integrator.update(s, dt), s, rtol=SHARP, atol=SHARP)


@pytest.mark.parametrize("theta", [0.1, 100.0])
def test_forgets_63_percent_within_the_time_constant(theta):
    for dt in (1.0 / theta, 1e-3 / theta):
        integrator = LeakyIntegrator(theta, 1)
        integrator.update([1.0], 0.0)
        for _ in range(round(1.0 / (theta * dt))):
            integrator.update([1.0], dt)
        assert 1.0 - integrator.value[0] == pytest.approx(1.0 - math.exp(-1.0), rel=1e-9)


def test_steady_slope_is_remembered_for_the_time_constant():
    """s' / theta is where a leaky integral of a constant s' ends."""
    theta, dt, slope = 5.0, 0.01, 3.0
    exact, printed = LeakyIntegrator(theta, 1), 0.0
    decay, gain = leak_factors(theta, dt, True)
    for k in range(1, 2000):
        exact.update([slope * k * dt], dt)
        printed = decay * printed + gain * slope * dt
    assert exact.value[0] == pytest.approx(slope / theta, rel=1e-9)
    # (13) is above it by half a step's leak, to first order.
    excess = printed / exact.value[0] - 1.0
    assert excess == pytest.approx(0.5 * theta * dt, rel=0.02)


def test_paper_form_is_equation_13():
    for theta, dt in ((30.0, 0.002), (0.0, 1.0), (1e3, 1e3)):
        assert leak_factors(theta, dt, True) == (math.exp(-theta * dt), 1.0)


def test_longest_and_shortest_steps():
    for theta, dt, left in ((1e300, 1e300, 0.0), (1e-300, 1e-300, 2.0), (1e3, 1e3, 1e-6)):
        integrator = LeakyIntegrator(theta, 1)
        integrator.update([1.0], 0.0)
        assert integrator.update([2.0], dt)[0] == pytest.approx(left, rel=1e-6)


def test_refuses_what_it_cannot_use_and_keeps_what_it_has():
    for theta in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="theta must be a finite number >= 0"):
            LeakyIntegrator(theta, 2)
    with pytest.raises(ValueError, match="n must be at least 1"):
        LeakyIntegrator(1.0, 0)
    integrator = LeakyIntegrator(1.0, 2)
    integrator.update([1.0, 2.0], 0.1)
    before = integrator.value.copy()
    for s in ([1.0], [1.0, math.nan], [[1.0, 2.0]], [math.inf, 0.0]):
        with pytest.raises(ValueError, match="s must be 2 finite numbers"):
            integrator.update(s, 0.1)
    for dt in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="dt must be a finite number >= 0"):
            integrator.update([5.0, 5.0], dt)
    np.testing.assert_array_equal(integrator.value, before)
    np.testing.assert_allclose(integrator.update([1.0, 2.0], 0.0), before)
