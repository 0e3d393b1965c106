# SPDX-License-Identifier: Apache-2.0
"""The integral torque is that of the paper, or solves its extended problem."""

import numpy as np
import pytest
from general_solver import nearest
from integral_terms import (
    SHARP,
    N,
    arm_terms,
    at_state,
    begun,
    random_dynamics,
    torque_now,
    uncorrected,
)

from torque_safety_controller.anti_windup import project_to_limits, scale_to_limits
from torque_safety_controller.integral_feedback import (
    METHODS,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors


def extended_qp(M, s, u, limit, w):
    """(11) with a leak, as a general QP; docs/theory/integral_action.md."""
    s = s / np.abs(s).max()
    momentum = M @ s
    row = np.r_[s, s @ momentum / np.linalg.norm(momentum)]
    return nearest(np.r_[u, 0.0], np.r_[-limit, 0.0], np.r_[limit, np.inf], row, s @ w)[:-1]


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
    for _ in range(100):
        M, C = random_dynamics(rng)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(IntegralSettings(budget, anti_windup=method), s)
        torque = torque_now(feedback, M, C)
        Ks = 2.0 * np.diag(M) * s
        x = {
            "scaling": scale_to_limits(Ks, budget),
            "paper": project_to_limits(Ks, s, budget),
        }[method]
        np.testing.assert_allclose(torque, C @ s + x, rtol=SHARP, atol=SHARP)
        np.testing.assert_array_equal(feedback.memory.fast, s)  # left alone, as in the paper
        np.testing.assert_array_equal(feedback.saturated, np.abs(Ks) > budget)


def test_whole_torque_is_the_paper_s_where_there_is_no_coriolis_torque():
    rng = np.random.default_rng(2)
    for _ in range(200):
        M, _ = random_dynamics(rng)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        whole = at_state(IntegralSettings(budget), s)
        papers = at_state(IntegralSettings(budget, anti_windup="paper"), s)
        C = np.zeros((N, N))
        expected, torque = torque_now(papers, M, C), torque_now(whole, M, C)
        np.testing.assert_allclose(torque, expected, rtol=SHARP, atol=SHARP)
        assert whole.leak == 0.0
        # The corrected integrators ask for just what the joints got.
        gain_torque = 2.0 * np.diag(M) * whole.s
        np.testing.assert_allclose(gain_torque, torque, rtol=SHARP, atol=SHARP)


def test_whole_torque_solves_the_extended_problem():
    rng = np.random.default_rng(3)
    active = 0
    for _ in range(200):
        M, C = random_dynamics(rng, speed=3.0)
        s, budget = rng.normal(size=N), rng.uniform(0.1, 5.0, N)
        torque, leak = uncorrected(IntegralSettings(budget), s, M, C)
        Ks = 2.0 * np.diag(M) * s
        u, w = C @ s + Ks, C @ s + np.clip(Ks, -budget, budget)
        expected = extended_qp(M, s, u, budget, w)
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-8)
        # The leak makes up for just what the torque lacks.
        missing = max(s @ w - s @ torque, 0.0)
        assert leak == pytest.approx(missing / (s @ M @ s), rel=1e-6, abs=1e-9)
        active += np.abs(torque - np.clip(u, -budget, budget)).max() > 1e-3
    assert active > 40
