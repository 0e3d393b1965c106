# SPDX-License-Identifier: Apache-2.0
"""The integral torque is the paper's or solves its extended problem: limited and passive."""

import math

import numpy as np
import pytest
from general_solver import nearest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from integral_terms import (
    ROUGH,
    SHARP,
    N,
    arm_terms,
    at_state,
    begun,
    random_dynamics,
    torque_now,
)

from torque_safety_controller.anti_windup import (
    nearest_with_leak,
    project_to_limits,
    scale_factor,
    scale_to_limits,
)
from torque_safety_controller.integral_feedback import (
    METHODS,
    IntegralFeedback,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors


def uncorrected(law, s, M, C):
    """Torque and leak of (11*) for this s, before the integrators are corrected."""
    Ks = law.gain * np.diag(M) * s
    wanted = C @ s + np.clip(Ks, -law.budget, law.budget)
    return nearest_with_leak(M, s, C @ s + Ks, law.budget, wanted)


# As printed


@pytest.mark.parametrize("method", METHODS)
def test_is_the_law_of_the_paper_while_nothing_is_limited(method):
    """(3), (4), (12)-(14), step by step; (13) as printed but for the default."""
    rng = np.random.default_rng(0)
    law = IntegralSettings(np.full(N, np.inf), 3.0, 0.4, 60.0, 0.3, method)
    v, a_ref = rng.normal(size=N), np.zeros(N)
    feedback = begun(law, v)
    fast, slow = np.zeros(N), np.zeros(N)
    for _ in range(40):
        dt = 10.0 ** rng.uniform(-4.0, -1.0)
        v_last, v = v, v + dt * rng.normal(size=N)
        M, C = random_dynamics(rng)
        torque = feedback.torque(arm_terms(M, C, v), a_ref, dt)
        increment = dt * a_ref - (v - v_last)
        (kept_f, gain_f), (kept_s, gain_s) = (
            leak_factors(theta, dt, method != "qp") for theta in (60.0, 0.4)
        )
        fast, slow = kept_f * fast + gain_f * increment, kept_s * slow + gain_s * increment
        s = 0.3 * fast + 0.7 * slow
        expected = (C + 3.0 * np.diag(np.diag(M))) @ s
        np.testing.assert_allclose(torque, expected, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(feedback.s, s, rtol=1e-10, atol=1e-12)
        assert not feedback.saturated.any()
        a_ref = rng.normal(size=N)


@pytest.mark.parametrize("method", ["scaling", "paper"])
def test_paper_limits_the_gain_torque_only(method):
    rng = np.random.default_rng(1)
    for _ in range(30):
        M, C = random_dynamics(rng)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(IntegralSettings(budget, anti_windup=method), s)
        torque = torque_now(feedback, M, C)
        Ks = 2.0 * np.diag(M) * s
        scaled = method == "scaling"
        x = scale_to_limits(Ks, budget) if scaled else project_to_limits(Ks, s, budget)
        np.testing.assert_allclose(torque, C @ s + x, rtol=SHARP, atol=SHARP)
        np.testing.assert_array_equal(feedback.memory.fast, s)  # left alone, as in the paper
        np.testing.assert_array_equal(feedback.saturated, np.abs(Ks) > budget)


def test_whole_torque_is_the_paper_s_where_no_joint_moves_another():
    """Of one joint C is at most a gain more; without it (11*) is (11), and never leaks."""
    rng = np.random.default_rng(2)
    for k in range(40):
        M, _ = random_dynamics(rng)
        C = np.diag(rng.uniform(0.0, 3.0, N)) * (k % 2)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(IntegralSettings(budget), s)
        torque = torque_now(feedback, M, C)
        gain = np.diag(C) + 2.0 * np.diag(M)
        expected = project_to_limits(gain * s, s, budget)
        np.testing.assert_allclose(torque, expected, rtol=SHARP, atol=SHARP)
        # The corrected integrators ask for just what the joints got: they leave the limit at once.
        np.testing.assert_allclose(gain * feedback.s, torque, rtol=SHARP, atol=SHARP)
        assert feedback.leak <= SHARP * (k % 2)


# The extended problem


def test_whole_torque_solves_the_extended_problem():
    """(11*) of docs/theory/integral_action.md, as a general QP."""
    rng = np.random.default_rng(3)
    active = 0
    for _ in range(100):
        unit = 10.0 ** rng.uniform(-2.0, 1.0)
        M, C = (unit * each for each in random_dynamics(rng, speed=3.0))
        s, budget = rng.normal(size=N), unit * rng.uniform(0.1, 5.0, N)
        torque, leak = uncorrected(IntegralSettings(budget), s, M, C)
        Ks = 2.0 * np.diag(M) * s
        u, w = C @ s + Ks, C @ s + np.clip(Ks, -budget, budget)
        row = np.r_[s, s @ M @ s / np.linalg.norm(M @ s)]
        lower, upper = np.r_[-budget, 0.0], np.r_[budget, np.inf]
        expected = nearest(np.r_[u, 0.0], lower, upper, row, s @ w)[:-1]
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-8)
        # The leak makes up for just what the torque lacks.
        missing = max(s @ w - s @ torque, 0.0)
        assert leak == pytest.approx(missing / (s @ M @ s), rel=1e-6, abs=1e-9)
        active += np.abs(torque - np.clip(u, -budget, budget)).max() > 1e-3 * unit
    assert active > 20


@given(
    arrays(float, N, elements=st.floats(-10.0, 10.0)),
    arrays(float, N, elements=st.floats(0.0, 20.0)),
    st.floats(0.0, 1.0),
    st.integers(0, 2**32 - 1),
)
@example(np.array([1.1e-308, 1.25, 1.25, 1.25, 1.25]), np.ones(N), 0.0, 0)
@example(np.array([1.1e-300, 1.25, 1.25, 1.25, 1.25]), np.ones(N), 0.0, 0)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_passive_and_limited_for_any_state(s, budget, mu, seed):
    """s'y + eta s'Ms >= s'(Cs + clip(Ks)), and the leak is no faster than the arm."""
    M, C = random_dynamics(np.random.default_rng(seed), speed=2.0)
    law = IntegralSettings(budget, mu=mu)
    feedback = at_state(law, s, -0.5 * s)
    before = feedback.s
    y = torque_now(feedback, M, C)
    for z, torque, leak in (
        (feedback.s, y, feedback.leak),
        (before, *uncorrected(law, before, M, C)),
    ):
        assert (np.abs(torque) <= budget).all()
        Ks = 2.0 * np.diag(M) * z
        size = np.abs(z) @ (np.abs(torque) + np.abs(C) @ np.abs(z) + np.abs(Ks)) + z @ M @ z
        size += np.finfo(float).tiny / SHARP  # below, numbers lose their digits
        gained = z @ (C @ z + np.clip(Ks, -budget, budget))
        assert z @ torque + leak * (z @ M @ z) - gained >= -SHARP * size
        assert leak * (z @ M @ z) <= np.maximum(z * (C @ z), 0.0).sum() + ROUGH * size
    papers = at_state(IntegralSettings(budget, anti_windup="paper"), s)
    x, Ks = torque_now(papers, M, C) - C @ s, 2.0 * np.diag(M) * s
    rounding = SHARP * (np.abs(s) @ (np.abs(Ks) + np.abs(C) @ np.abs(s)))
    assert s @ x >= scale_factor(Ks, budget) * (s @ Ks) - rounding


def test_torque_is_continuous():
    """Along lines through states and speeds; a joint without s or budget at their middle."""
    rng = np.random.default_rng(6)
    for _ in range(4):
        M, C = random_dynamics(rng, speed=3.0)
        dC = rng.normal(size=(N, N))
        s, ds = np.where(rng.random(N) < 0.3, 0.0, rng.normal(size=N)), rng.normal(size=N)
        budget = np.where(rng.random(N) < 0.3, 0.0, rng.uniform(0.5, 5.0, N))
        coarse, fine = (
            np.abs(
                np.diff(
                    [
                        torque_now(at_state(IntegralSettings(budget), s + t * ds), M, C + t * dC)
                        for t in np.linspace(-1.0, 1.0, steps)
                    ],
                    axis=0,
                )
            ).max()
            for steps in (201, 1601)
        )
        assert 0.0 < fine < 0.3 * coarse


anything = st.floats(allow_nan=False, allow_infinity=False)


@given(
    arrays(float, (2, 3, 3), elements=anything),
    arrays(float, (4, 2, 3), elements=anything),
    arrays(float, 3, elements=st.floats(0.0)),
    st.floats(0.0, allow_infinity=False),
    st.sampled_from(METHODS),
)
@settings(max_examples=200, deadline=None, derandomize=True)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_finite_and_within_the_budget_for_any_finite_input(matrices, motion, budget, dt, method):
    feedback = IntegralFeedback(IntegralSettings(budget, anti_windup=method))
    for v, a_ref in motion:
        torque = feedback.torque(arm_terms(*matrices, v), a_ref, dt)
        assert np.isfinite(torque).all()
        if method == "qp":
            assert (np.abs(torque) <= budget).all()
        assert np.isfinite(feedback.memory.fast).all() and np.isfinite(feedback.memory.slow).all()
        assert math.isfinite(feedback.leak) and feedback.leak >= 0.0


# Correction of the integrators


def test_correction_only_shrinks():
    """No integrator grows or changes sign, and s keeps its sign."""
    rng = np.random.default_rng(16)
    shrunk = 0
    for _ in range(200):
        M, C = random_dynamics(rng, speed=3.0)
        fast, slow, budget = rng.normal(size=N), rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(IntegralSettings(budget, mu=0.3), fast, slow)
        s = feedback.s
        torque_now(feedback, M, C)
        for before, after in ((fast, feedback.memory.fast), (slow, feedback.memory.slow)):
            kept = after / before
            assert ((kept >= 0.0) & (kept <= 1.0)).all()
            assert (kept[before * s < 0.0] == 1.0).all()  # it does not contribute
            shrunk += (kept < 1.0).any()
        assert (feedback.s * s >= -SHARP).all()
    assert shrunk > 200
