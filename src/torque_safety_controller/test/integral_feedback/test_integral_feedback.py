# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from proxsuite import proxqp

from torque_safety_controller.anti_windup import project_to_limits, scale_factor, scale_to_limits
from torque_safety_controller.integral_feedback import (
    METHODS,
    ArmTerms,
    InitialisationError,
    IntegralFeedback,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.kernels import nearest_with_leak
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.settings import WIDENING_TIME
from viability_bounds_pkg.exceptions import SettingError

N = 5
DT = 1e-3
SHARP = 1e-12  # relative; rounding and nothing else
ROUGH = 1e-9


def random_dynamics(rng, n=N, speed=1.0):
    """A mass matrix and any C: what is said below does not need it to be a robot's."""
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.3 * np.eye(n), speed * rng.normal(size=(n, n))


def arm_dynamics(arm, q, v):
    """M and C of a real one."""
    data = arm.model.createData()
    return pin.crba(arm.model, data, q), pin.computeCoriolisMatrix(arm.model, data, q, v)


def arm_terms(M, C, v=None) -> ArmTerms:
    """Terms of an arm without a task."""
    n = len(M)
    no_task = np.zeros((0, n))
    return ArmTerms(M, C, no_task, no_task, np.zeros(n) if v is None else v)


def begun(law, v=None) -> IntegralFeedback:
    """An integral action at the beginning, at this velocity."""
    feedback = IntegralFeedback(law)
    zero = np.zeros((len(law.budget),) * 2)
    feedback.reset(arm_terms(zero, zero, v))
    return feedback


def at_state(law, fast, slow=None) -> IntegralFeedback:
    """An integral action with these integrators."""
    feedback = begun(law)
    feedback.memory.fast[:] = fast
    feedback.memory.slow[:] = fast if slow is None else slow
    return feedback


def torque_now(feedback, M, C):
    """The torque of a step that takes no time."""
    return feedback.torque(arm_terms(M, C), np.zeros(len(M)), 0.0)


def uncorrected(law, s, M, C):
    """Torque and leak of (11*) for this s, before the integrators are corrected."""
    torque, limit = np.empty(len(s)), law.budget
    Ks = law.gain * np.diag(M) * s
    w = C @ s + np.clip(Ks, -limit, limit)
    return torque, nearest_with_leak(M, s, C @ s + Ks, limit, w, torque)


def extended_qp(M, s, u, limit, w):
    """(11) with a leak, as a general QP; docs/integral_action.md."""
    n = len(s)
    s = s / np.abs(s).max()
    momentum = M @ s
    size = np.linalg.norm(momentum)
    qp = proxqp.dense.QP(n + 1, 0, n + 2)
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-11, 0.0
    qp.settings.check_duality_gap = True
    qp.settings.eps_duality_gap_abs, qp.settings.eps_duality_gap_rel = 1e-11, 0.0
    C = np.vstack([np.eye(n + 1), np.r_[s, s @ momentum / size]])
    lower, upper = np.r_[-limit, 0.0, s @ w], np.r_[limit, np.inf, np.inf]
    qp.init(np.eye(n + 1), -np.r_[u, 0.0], None, None, C, lower, upper)
    qp.solve()
    assert qp.results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
    return np.array(qp.results.x)[:n]


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


@pytest.mark.parametrize("method", ["none", "scaling", "paper"])
def test_paper_limits_the_gain_torque_only(method):
    rng = np.random.default_rng(1)
    for _ in range(100):
        M, C = random_dynamics(rng)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(IntegralSettings(budget, anti_windup=method), s)
        torque = torque_now(feedback, M, C)
        Ks = 2.0 * np.diag(M) * s
        x = {
            "none": Ks,
            "scaling": scale_to_limits(Ks, budget),
            "paper": project_to_limits(Ks, s, budget),
        }[method]
        np.testing.assert_allclose(torque, C @ s + x, rtol=SHARP, atol=SHARP)
        np.testing.assert_array_equal(feedback.memory.fast, s)  # left alone, as in the paper
        if method != "none":
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
        elif method != "none":
            assert (np.abs(torque - C_now @ feedback.s) <= budget + ROUGH).all()
        touched += feedback.saturated.any()
    assert touched > 100 or method == "none"


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


def moving(feedback, rng, steps=50):
    """Some steps of a slow motion; the terms after them and the torques."""
    M, C = np.diag(rng.uniform(0.5, 2.0, N)), 0.2 * rng.normal(size=(N, N))
    v, torques = np.zeros(N), []
    feedback.reset(arm_terms(M, C))
    for k in range(steps):
        v = v + DT * rng.normal(size=N)
        a_ref = 3.0 * np.cos(0.05 * k + np.arange(N))
        torques.append(feedback.torque(arm_terms(M, C, v), a_ref, DT))
    return arm_terms(M, C, v), np.array(torques)


CHANGES = [
    {"gain": 0.5},
    {"gain": 9.0},
    {"mu": 0.0},
    {"mu": 1.0},
    {"slow_leak_rate": 5.0},
    {"fast_leak_rate": 1.0},
    {"budget": np.full(N, 1e-3)},
    {"budget": np.zeros(N)},
    {"budget": np.full(N, np.inf)},
    *({"anti_windup": method} for method in METHODS),
    {"gain": 0.7, "mu": 0.9, "budget": np.full(N, 0.01), "anti_windup": "paper"},
]


@pytest.mark.parametrize("change", CHANGES, ids=str)
@pytest.mark.parametrize("method", ["qp", "paper"])
def test_initialised_after_a_change_the_torque_does_not_jump(change, method):
    rng = np.random.default_rng(9)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 0.05), anti_windup=method))
    arm, torques = moving(feedback, rng)
    ordinary = np.abs(np.diff(torques, axis=0)).max()
    assert feedback.saturated.any()
    last, steps = torques[-1], []
    feedback.settings = replace(feedback.settings, **change)
    np.testing.assert_allclose(feedback.initialise(last, arm), last, rtol=1e-10, atol=1e-12)
    for _ in range(4):
        torque = feedback.torque(arm, np.zeros(N), DT)
        steps.append(np.abs(torque - last).max())
        last = torque
    # The leak of the new rates, and of a budget that narrows, is no jump.
    assert max(steps) < 1.5 * ordinary + 0.1 * np.abs(torques[-1]).max()


def test_gain_torque_is_kept_when_the_gain_changes():
    feedback = at_state(IntegralSettings(np.full(N, np.inf)), np.ones(N), np.arange(N))
    M, C = np.eye(N), np.zeros((N, N))
    before = torque_now(feedback, M, C)
    feedback.settings = replace(feedback.settings, gain=50.0)
    np.testing.assert_allclose(torque_now(feedback, M, C), before, rtol=SHARP)


def test_after_a_change_the_new_settings_count():
    rng = np.random.default_rng(10)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 0.5)))
    arm, torques = moving(feedback, rng, steps=300)
    last = torques[-1]
    assert np.abs(last).max() > 0.15
    feedback.settings = replace(feedback.settings, budget=np.full(N, 0.1))
    feedback.initialise(last, arm)
    widening = feedback.memory.widening.copy()
    assert widening.max() == pytest.approx(np.abs(last).max() - 0.1)
    for k in range(1, 500):
        torque = feedback.torque(arm, np.zeros(N), 0.02)
        excess = widening * math.exp(-k * 0.02 / WIDENING_TIME)
        assert (np.abs(torque) <= 0.1 + excess + SHARP).all()
    assert np.abs(torque).max() <= 0.1 + 1e-4


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("method", ["qp", "paper"])
def test_initialising_gives_the_torque_asked_for(mu, method):
    rng = np.random.default_rng(11)
    budget = np.array([0.0, 0.5, 2.0, 10.0, np.inf])
    for _ in range(20):
        M, C = random_dynamics(rng, speed=0.1)
        wanted = 3.0 * rng.normal(size=N)
        arm = arm_terms(M, C, rng.normal(size=N))
        feedback = begun(IntegralSettings(budget, mu=mu, anti_windup=method), arm.v)
        np.testing.assert_allclose(feedback.initialise(wanted, arm), wanted, rtol=1e-9, atol=1e-9)
        limited = wanted if method == "qp" else 2.0 * np.diag(M) * feedback.s
        expected = np.maximum(np.abs(limited) - budget, 0.0)
        np.testing.assert_allclose(feedback.memory.widening, expected, rtol=1e-9, atol=1e-9)
        # It goes on from there, and is forgotten slowly.
        after = feedback.torque(arm, np.zeros(N), 0.01)
        free = expected == 0.0
        if method == "paper" and mu < 1.0:
            decay = (after - C @ feedback.s) / limited
            np.testing.assert_allclose(decay[free], np.exp(-0.01 * 0.1), rtol=1e-8)
            assert (decay >= np.exp(-0.01 / WIDENING_TIME) * (1.0 - ROUGH)).all()
        assert np.abs(after - wanted).max() < (0.1 if mu < 1.0 else 0.7) * np.abs(wanted).max()


def test_initial_torque_fades_as_the_widened_budget_does():
    arm = arm_terms(np.eye(N), np.zeros((N, N)))
    feedback = begun(IntegralSettings(np.full(N, 1.0), slow_leak_rate=0.0))
    feedback.initialise(np.full(N, 3.0), arm)
    for k in range(1, 400):
        torque = feedback.torque(arm, arm.v, 0.01)
        np.testing.assert_allclose(
            torque, 1.0 + 2.0 * math.exp(-k * 0.01 / WIDENING_TIME), rtol=ROUGH
        )
    # The state came along: it leaves the limit at once.
    after = feedback.torque(arm, np.full(N, -1.0), 0.01)
    assert (after < 1.0 + 2.0 * math.exp(-4.0)).all()


def test_initialising_is_refused_with_a_reason():
    feedback = begun(IntegralSettings(np.ones(N)))
    M = np.eye(N)
    with pytest.raises(InitialisationError):
        feedback.initialise(np.full(N, np.nan), arm_terms(M, 0.0 * M))
    for C in (-2.0 * M, -1.999999 * M, np.full((N, N), np.nan)):
        with pytest.raises(InitialisationError, match="too fast"):
            feedback.initialise(np.ones(N), arm_terms(M, C))
    np.testing.assert_array_equal(feedback.s, 0.0)


def test_a_pause_or_a_jump_in_time_does_not_kick():
    rng = np.random.default_rng(12)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    arm, torques = moving(feedback, rng)
    fast, slow = feedback.memory.fast.copy(), feedback.memory.slow.copy()
    elsewhere = arm._replace(v=arm.v + 3.0)
    feedback.skip(elsewhere, 2.0)
    np.testing.assert_allclose(feedback.memory.fast, math.exp(-200.0) * fast, rtol=1e-9)
    np.testing.assert_allclose(feedback.memory.slow, math.exp(-0.2) * slow, rtol=1e-12)
    torque = feedback.torque(elsewhere, np.zeros(N), 0.0)
    assert np.abs(torque).max() <= 1.5 * np.abs(torques[-1]).max()
    # The same without skipping is what it protects from.
    kicked = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    moving(kicked, np.random.default_rng(12))
    assert np.abs(kicked.torque(elsewhere, np.zeros(N), 2.0)).max() > 1.0


def test_reset_forgets():
    rng = np.random.default_rng(13)
    arm = arm_terms(*random_dynamics(rng), np.ones(N))
    feedback = begun(IntegralSettings(np.full(N, 5.0)), arm.v)
    np.testing.assert_array_equal(feedback.torque(arm, np.zeros(N), DT), 0.0)
    still = arm._replace(v=np.zeros(N))
    assert np.abs(feedback.torque(still, np.zeros(N), DT)).max() > 0.1
    feedback.reset(arm)
    assert not feedback.saturated.any()
    np.testing.assert_array_equal(feedback.torque(arm, np.zeros(N), DT), 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"budget": [1.0, -1.0]}, "'budget' is .* a number >= 0 for each joint"),
        ({"budget": [1.0, math.nan]}, "budget"),
        ({"budget": []}, "budget"),
        ({"budget": [[1.0]]}, "budget"),
        ({"budget": [math.nan]}, "'budget' is .* >= 0"),
        ({"gain": 0.0}, "'gain' is '?0'?; allowed: a finite number > 0"),
        ({"gain": math.nan}, "gain"),
        ({"slow_leak_rate": -0.1}, "'slow_leak_rate' is '?-0.1'?; allowed: a finite number >= 0"),
        ({"fast_leak_rate": math.inf}, "fast_leak_rate"),
        ({"fast_leak_rate": 0.01}, "'fast_leak_rate' is '?0.01'?; allowed: .* slow one, 0.1"),
        ({"mu": 1.1}, "'mu' is '?1.1'?; allowed: a number from 0 to 1"),
        ({"mu": math.nan}, "mu"),
        (
            {"anti_windup": "hope"},
            "'anti_windup' is '?hope'?; allowed: none or scaling or paper or qp",
        ),
    ],
)
def test_settings_out_of_range_are_refused(values, message):
    with pytest.raises(SettingError, match=message) as caught:
        IntegralSettings(**{"budget": np.ones(2), **values})
    assert caught.value.name in values


def test_unusable_input_changes_nothing():
    rng = np.random.default_rng(14)
    feedback = IntegralFeedback(IntegralSettings(np.ones(N)))
    arm, _ = moving(feedback, rng)
    with pytest.raises(SettingError, match="one number for each of 5 joints"):
        feedback.settings = IntegralSettings(np.ones(N + 1))
    assert feedback.settings.budget.shape == (N,)
    before = np.array(feedback.memory)
    for name in ("M", "C", "v"):
        value = getattr(arm, name).copy()
        value.flat[0] = np.nan
        with pytest.raises(ValueError, match="must be finite"):
            feedback.torque(arm._replace(**{name: value}), arm.v, DT)
        with pytest.raises(ValueError, match="broadcast"):
            feedback.torque(arm._replace(**{name: value[1:]}), arm.v, DT)
    with pytest.raises(ValueError, match="must be finite"):
        feedback.torque(arm, np.full(N, np.inf), DT)
    with pytest.raises(ValueError, match="broadcast"):
        feedback.torque(arm, np.zeros(N + 1), DT)
    with pytest.raises(ValueError, match="v must be finite"):
        feedback.skip(arm._replace(v=np.full(N, np.nan)), 0.1)
    np.testing.assert_array_equal(np.array(feedback.memory), before)


def test_budget_of_the_settings_is_a_copy():
    budget = np.ones(N)
    law = IntegralSettings(budget)
    budget[:] = 7.0
    np.testing.assert_array_equal(law.budget, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        law.budget[0] = 2.0


def test_settings_are_compared_by_value():
    law = IntegralSettings(np.ones(N))
    assert law.same_as(IntegralSettings([1.0] * N))
    for change in CHANGES:
        changed = replace(law, **change)
        assert changed.same_as(law) == (change == {"anti_windup": "qp"})
