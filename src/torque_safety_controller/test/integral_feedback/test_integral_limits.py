# SPDX-License-Identifier: Apache-2.0
"""The integral torque is within its budget, passive and continuous."""

import math

import numpy as np
import pinocchio as pin
import pytest
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
    uncorrected,
)

from torque_safety_controller.anti_windup import scale_factor
from torque_safety_controller.integral_feedback import (
    METHODS,
    IntegralFeedback,
    IntegralSettings,
)


def arm_dynamics(arm, q, v):
    """M and C of a real one."""
    data = arm.model.createData()
    return pin.crba(arm.model, data, q), pin.computeCoriolisMatrix(arm.model, data, q, v)


def passive_by(law, limit, M, C, s, y, leak):
    """-(V' + dissipation asked for), W: what must not be negative; and its rounding."""
    Ks = law.gain * np.diag(M) * s
    wanted = C @ s + np.clip(Ks, -limit, limit)
    size = np.abs(s) @ (np.abs(y) + np.abs(C) @ np.abs(s) + np.abs(Ks)) + abs(s @ M @ s)
    size += np.finfo(float).tiny / SHARP  # below, numbers lose their digits
    return s @ y + leak * (s @ M @ s) - s @ wanted, size


def both_ways(law, fast, slow, M, C):
    """s, torque and leak with the integrators corrected, and without."""
    feedback = at_state(law, fast, slow)
    before = feedback.s
    y = torque_now(feedback, M, C)
    yield feedback.s, y, feedback.leak
    y, leak = uncorrected(law, before, M, C)
    yield before, y, leak


def test_torque_and_leak_together_are_passive():
    """s'y + eta s'Ms >= s'(Cs + clip(Ks)) >= s'Cs + lambda_w s'Ks, whatever the budgets."""
    rng = np.random.default_rng(4)
    leaks, bent = 0, 0
    for _ in range(3000):
        M, C = random_dynamics(rng, speed=10.0 ** rng.uniform(-1.0, 1.0))
        s = rng.normal(size=N) * 10.0 ** rng.uniform(-3.0, 1.0, N)
        budget = rng.choice([0.0, 0.1, 1.0, 10.0, np.inf], N)
        law = IntegralSettings(budget, mu=0.3)
        for z, y, leak in both_ways(law, s, rng.normal(size=N), M, C):
            surplus, size = passive_by(law, budget, M, C, z, y, leak)
            assert surplus >= -SHARP * size
            assert (np.abs(y) <= budget).all()
            # No faster than the arm: it is zero at rest, and bounded by C everywhere.
            assert leak * (z @ M @ z) <= np.maximum(z * (C @ z), 0.0).sum() + ROUGH * size
            clipped = np.clip(C @ z + 2.0 * np.diag(M) * z, -budget, budget)
            leaks += leak > 0.0
            bent += np.abs(y - clipped).max() > ROUGH
    assert leaks > 200
    assert bent > 200


def test_correction_only_shrinks():
    """No integrator grows or changes sign, and s keeps its sign."""
    rng = np.random.default_rng(16)
    shrunk = 0
    for _ in range(1000):
        M, C = random_dynamics(rng, speed=3.0)
        fast, slow, budget = rng.normal(size=N), rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(IntegralSettings(budget, mu=0.3), fast, slow)
        s = feedback.s
        torque_now(feedback, M, C)
        for before, after in ((fast, feedback.memory.fast), (slow, feedback.memory.slow)):
            kept = after / before
            assert ((kept >= 0.0) & (kept <= 1.0)).all()
            shrunk += (kept < 1.0).any()
        assert (feedback.s * s >= -SHARP).all()
    assert shrunk > 1000


def test_no_leak_at_rest_or_within_the_budget():
    rng = np.random.default_rng(5)
    for _ in range(200):
        M, C = random_dynamics(rng)
        s = rng.normal(size=N)
        u = np.abs((C + 2.0 * np.diag(np.diag(M))) @ s)
        for budget, coriolis in ((0.5 * u, 0.0 * C), (1.001 * u, C)):
            feedback = at_state(IntegralSettings(budget), s)
            torque_now(feedback, M, coriolis)
            assert feedback.leak <= SHARP


def test_torque_is_continuous():
    """Along lines through states and speeds; a joint without s or budget at their middle."""
    rng = np.random.default_rng(6)

    def largest_step(feedback, steps):
        torques = []
        for t in np.linspace(-1.0, 1.0, steps):
            feedback.reset(arm_terms(M, C))
            feedback.memory.fast[:] = feedback.memory.slow[:] = s + t * ds
            torques.append(torque_now(feedback, M, C + t * dC))
        return np.abs(np.diff(torques, axis=0)).max()

    for _ in range(10):
        M, C = random_dynamics(rng, speed=3.0)
        dC = rng.normal(size=(N, N))
        s, ds = np.where(rng.random(N) < 0.3, 0.0, rng.normal(size=N)), rng.normal(size=N)
        budget = np.where(rng.random(N) < 0.3, 0.0, rng.uniform(0.5, 5.0, N))
        feedback = IntegralFeedback(IntegralSettings(budget))
        coarse, fine = largest_step(feedback, 501), largest_step(feedback, 5001)
        assert 0.0 < fine < 0.3 * coarse


@pytest.mark.parametrize("method", METHODS)
def test_budget_is_kept_in_any_motion(method):
    rng = np.random.default_rng(7)
    budget = np.array([0.0, 0.5, 1.0, 2.0, np.inf])
    law = IntegralSettings(budget, anti_windup=method, slow_leak_rate=0.0)
    v = rng.normal(size=N)
    feedback = begun(law, v)
    M, C = random_dynamics(rng)
    touched = 0
    for _ in range(400):
        v = v + 0.1 * rng.normal(size=N)
        C_now = C + rng.normal(size=(N, N))
        torque = feedback.torque(arm_terms(M, C_now, v), rng.normal(size=N), 0.1)
        assert np.isfinite(torque).all()
        if method == "qp":
            assert (np.abs(torque) <= budget).all()
        else:
            assert (np.abs(torque - C_now @ feedback.s) <= budget + ROUGH).all()
        touched += feedback.saturated.any()
    assert touched > 100


anything = st.floats(allow_nan=False, allow_infinity=False)


@given(
    arrays(float, (2, 3, 3), elements=anything),
    arrays(float, (4, 2, 3), elements=anything),
    arrays(float, 3, elements=st.floats(0.0)),
    st.floats(0.0, allow_infinity=False),
    st.sampled_from(METHODS),
)
@settings(max_examples=300, deadline=None, derandomize=True)
def test_finite_and_within_the_budget_for_any_finite_input(matrices, motion, budget, dt, method):
    feedback = IntegralFeedback(IntegralSettings(budget, anti_windup=method))
    for v, a_ref in motion:
        torque = feedback.torque(arm_terms(*matrices, v), a_ref, dt)
        assert np.isfinite(torque).all()
        if method == "qp":
            assert (np.abs(torque) <= budget).all()
        assert np.isfinite(feedback.memory.fast).all() and np.isfinite(feedback.memory.slow).all()
        assert math.isfinite(feedback.leak) and feedback.leak >= 0.0


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
    M, C = random_dynamics(np.random.default_rng(seed), speed=2.0)
    law = IntegralSettings(budget, mu=mu)
    for z, y, leak in both_ways(law, s, -0.5 * s, M, C):
        assert (np.abs(y) <= budget).all()
        surplus, size = passive_by(law, budget, M, C, z, y, leak)
        assert surplus >= -SHARP * size
        assert leak * (z @ M @ z) <= np.maximum(z * (C @ z), 0.0).sum() + ROUGH * size
    papers = at_state(IntegralSettings(budget, anti_windup="paper"), s)
    x, Ks = torque_now(papers, M, C) - C @ s, 2.0 * np.diag(M) * s
    rounding = SHARP * (np.abs(s) @ (np.abs(Ks) + np.abs(C) @ np.abs(s)))
    assert s @ x >= scale_factor(Ks, budget) * (s @ Ks) - rounding


def test_correction_lets_joints_leave_their_limits_even_while_they_move(arm):
    """What is corrected is the joint's own share; C s may hold it at the limit all the same."""
    rng = np.random.default_rng(8)
    left, trials = 0, 0
    for _ in range(200):
        q, v = arm.random_state(rng)
        M, C = (np.ascontiguousarray(x) for x in arm_dynamics(arm, q, 0.5 * v))
        K = 2.0 * np.diag(M)
        s = rng.normal(size=arm.n) / K
        budget = 0.8 * np.abs((C + np.diag(K)) @ s)
        feedback = at_state(IntegralSettings(budget), s)
        torque_now(feedback, M, C)
        assert feedback.saturated.all()
        # The error turns round, by a tenth.
        feedback.torque(arm_terms(M, C, 0.1 * s), np.zeros(arm.n), 0.0)
        left += (~feedback.saturated).sum()
        # Without the correction it asks for more than its limit all the same.
        assert (np.abs((C + np.diag(K)) @ (0.9 * s)) > budget).all()
        trials += arm.n
    assert left > 0.8 * trials
