import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from proxsuite import proxqp

from torque_safety_controller.anti_windup import (
    clip_to_limits,
    project_to_limits,
    scale_factor,
    scale_to_limits,
)
from torque_safety_controller.integral_feedback.feedback import (
    IntegralFeedback,
    IntegralSettings,
    LeakyIntegrator,
    SeedingError,
    paper_settings,
)
from torque_safety_controller.integral_feedback.leaky_integrator import mix
from torque_safety_controller.integral_feedback.settings import METHODS
from viability_bounds_pkg.exceptions import SettingError

N = 5
DT = 1e-3
SHARP = 1e-12  # relative; rounding and nothing else
ROUGH = 1e-9
VARIANTS = [(m, w, c) for m in METHODS for w in (True, False) for c in (True, False)]


def random_dynamics(rng, n=N, speed=1.0):
    """A mass matrix and any C: what is said below does not need it to be a robot's."""
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.3 * np.eye(n), speed * rng.normal(size=(n, n))


def arm_dynamics(arm, q, v):
    """M and C of a real one."""
    data = arm.model.createData()
    return pin.crba(arm.model, data, q), pin.computeCoriolisMatrix(arm.model, data, q, v)


def at_state(law, fast, slow=None) -> IntegralFeedback:
    """An integral action with these integrators."""
    feedback = IntegralFeedback(law)
    feedback.start(np.zeros(len(fast)))
    feedback.fast[:] = fast
    feedback.slow[:] = fast if slow is None else slow
    return feedback


def torque_now(feedback, M, C):
    """The torque of a step that takes no time."""
    zero = np.zeros(len(M))
    return feedback.torque(M, C, zero, zero, 0.0)


def s_now(feedback):
    return mix(feedback.fast, feedback.slow, feedback.settings.mu)


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


@pytest.mark.parametrize("paper_form", [True, False])
def test_is_the_law_of_the_paper_while_nothing_is_limited(paper_form):
    """(3), (4), (12)-(14), put together from the public parts."""
    rng = np.random.default_rng(0)
    law = IntegralSettings(
        np.full(N, np.inf), 3.0, 0.4, 60.0, 0.3, anti_windup="none", paper_form=paper_form
    )
    feedback = IntegralFeedback(law)
    fast, slow = (LeakyIntegrator(t, N, paper_form) for t in (60.0, 0.4))
    v = rng.normal(size=N)
    feedback.start(v)
    reference, a_ref = v, np.zeros(N)
    for _ in range(40):
        dt = 10.0 ** rng.uniform(-4.0, -1.0)
        reference = reference + dt * a_ref
        v = v + dt * rng.normal(size=N)
        M, C = random_dynamics(rng)
        torque = feedback.torque(M, C, v, a_ref, dt)
        s = mix(fast.update(reference - v, dt), slow.update(reference - v, dt), 0.3)
        expected = (C + 3.0 * np.diag(np.diag(M))) @ s
        np.testing.assert_allclose(torque, expected, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(feedback.s, s, rtol=1e-10, atol=1e-12)
        a_ref = rng.normal(size=N)


@pytest.mark.parametrize("method", METHODS)
def test_paper_limits_the_gain_torque_only(method):
    rng = np.random.default_rng(1)
    for _ in range(100):
        M, C = random_dynamics(rng)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        feedback = at_state(replace(paper_settings(budget), anti_windup=method), s)
        torque = torque_now(feedback, M, C)
        Ks = 2.0 * np.diag(M) * s
        x = {
            "none": Ks,
            "clip": clip_to_limits(Ks, budget),
            "scaling": scale_to_limits(Ks, budget),
            "qp": project_to_limits(Ks, s, budget),
        }[method]
        np.testing.assert_allclose(torque, C @ s + x, rtol=SHARP, atol=SHARP)
        np.testing.assert_allclose(feedback.limited_gain_torque, x, rtol=SHARP, atol=SHARP)
        np.testing.assert_array_equal(feedback.fast, s)  # left alone, as in the paper
        if method != "none":
            assert feedback.lambda_w == pytest.approx(scale_factor(Ks, budget))
            np.testing.assert_array_equal(feedback.saturated, np.abs(Ks) > budget)


def test_whole_torque_is_the_paper_s_where_there_is_no_coriolis_torque():
    rng = np.random.default_rng(2)
    for _ in range(200):
        M, _ = random_dynamics(rng)
        s, budget = rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        whole = at_state(IntegralSettings(budget), s)
        papers = at_state(paper_settings(budget), s)
        C = np.zeros((N, N))
        expected = torque_now(papers, M, C)
        np.testing.assert_allclose(torque_now(whole, M, C), expected, rtol=SHARP, atol=SHARP)
        assert whole.leak == 0.0
        # The corrected integrators ask for just what the joints got.
        gain_torque = 2.0 * np.diag(M) * s_now(whole)
        np.testing.assert_allclose(gain_torque, whole.additional_torque, rtol=SHARP, atol=SHARP)


def test_whole_torque_solves_the_extended_problem():
    rng = np.random.default_rng(3)
    active = 0
    for _ in range(400):
        M, C = random_dynamics(rng, speed=3.0)
        s, budget = rng.normal(size=N), rng.uniform(0.1, 5.0, N)
        feedback = at_state(IntegralSettings(budget, correct_state=False), s)
        torque = torque_now(feedback, M, C)
        Ks = 2.0 * np.diag(M) * s
        u, w = C @ s + Ks, C @ s + np.clip(Ks, -budget, budget)
        expected = extended_qp(M, s, u, budget, w)
        np.testing.assert_allclose(torque, expected, rtol=0.0, atol=1e-8)
        # The leak makes up for just what the torque lacks.
        missing = max(s @ w - s @ torque, 0.0)
        assert feedback.leak == pytest.approx(missing / (s @ M @ s), rel=1e-6, abs=1e-9)
        active += np.abs(torque - np.clip(u, -budget, budget)).max() > 1e-3
    assert active > 40


def passive_by(feedback, M, C, y):
    """-(V' + dissipation asked for), W: what must not be negative; and its rounding."""
    z = s_now(feedback)
    limit = feedback.settings.budget + feedback.widening
    Kz = feedback.settings.lambda_ * np.diag(M) * z
    wanted = C @ z + np.clip(Kz, -limit, limit)
    size = np.abs(z) @ (np.abs(y) + np.abs(C) @ np.abs(z) + np.abs(Kz)) + abs(z @ M @ z)
    size += np.finfo(float).tiny / SHARP  # below, numbers lose their digits
    return z @ y + feedback.leak * (z @ M @ z) - z @ wanted, size


@pytest.mark.parametrize("correct_state", [True, False])
def test_torque_and_leak_together_are_passive(correct_state):
    """s'y + eta s'Ms >= s'(Cs + clip(Ks)) >= s'Cs + lambda_w s'Ks, whatever the budgets."""
    rng = np.random.default_rng(4)
    leaks, bent = 0, 0
    for _ in range(3000):
        M, C = random_dynamics(rng, speed=10.0 ** rng.uniform(-1.0, 1.0))
        s = rng.normal(size=N) * 10.0 ** rng.uniform(-3.0, 1.0, N)
        budget = rng.choice([0.0, 0.1, 1.0, 10.0, np.inf], N)
        law = IntegralSettings(budget, mu=0.3, correct_state=correct_state)
        feedback = at_state(law, s, rng.normal(size=N))
        y = torque_now(feedback, M, C)
        surplus, size = passive_by(feedback, M, C, y)
        assert surplus >= -SHARP * size
        z = feedback.s
        np.testing.assert_allclose(z, s_now(feedback), rtol=SHARP, atol=SHARP)
        # No faster than the arm: it is zero at rest, and bounded by C everywhere.
        assert feedback.leak * (z @ M @ z) <= np.maximum(z * (C @ z), 0.0).sum() + ROUGH * size
        clipped = np.clip(C @ z + 2.0 * np.diag(M) * z, -budget, budget)
        leaks += feedback.leak > 0.0
        bent += np.abs(y - clipped).max() > ROUGH
    assert leaks > 100
    assert bent > 100


def test_correction_only_shrinks():
    """No integrator grows or changes sign, and s is what the joint's budget lets it be."""
    rng = np.random.default_rng(16)
    for _ in range(1000):
        M, C = random_dynamics(rng, speed=3.0)
        fast, slow, budget = rng.normal(size=N), rng.normal(size=N), rng.uniform(0.0, 3.0, N)
        for whole_torque in (True, False):
            law = IntegralSettings(budget, mu=0.3, whole_torque=whole_torque)
            feedback = at_state(law, fast, slow)
            torque_now(feedback, M, C)
            for before, after in ((fast, feedback.fast), (slow, feedback.slow)):
                kept = after / before
                assert ((kept >= 0.0) & (kept <= 1.0)).all()
            assert (feedback.s * mix(fast, slow, 0.3) >= -SHARP).all()
            if not whole_torque:
                expected = np.clip(feedback.gain_torque, -budget, budget)
                now = 2.0 * np.diag(M) * feedback.s
                np.testing.assert_allclose(now, expected, rtol=0.0, atol=SHARP * 100.0)


@pytest.mark.parametrize("method", ["qp", "scaling"])
def test_no_leak_at_rest_or_within_the_budget(method):
    rng = np.random.default_rng(5)
    for _ in range(200):
        M, C = random_dynamics(rng)
        s = rng.normal(size=N)
        u = np.abs((C + 2.0 * np.diag(np.diag(M))) @ s)
        for budget, coriolis in ((0.5 * u, 0.0 * C), (1.001 * u, C)):
            feedback = at_state(IntegralSettings(budget, anti_windup=method), s)
            torque_now(feedback, M, coriolis)
            assert feedback.leak <= SHARP


@pytest.mark.parametrize("method", ["qp", "clip"])
def test_torque_is_continuous(method):
    """Along lines through states and speeds; a joint without s or budget at their middle."""
    rng = np.random.default_rng(6)

    def largest_step(feedback, steps):
        torques = []
        for t in np.linspace(-1.0, 1.0, steps):
            feedback.start(np.zeros(N))
            feedback.fast[:] = feedback.slow[:] = s + t * ds
            torques.append(torque_now(feedback, M, C + t * dC))
        return np.abs(np.diff(torques, axis=0)).max()

    for _ in range(10):
        M, C = random_dynamics(rng, speed=3.0)
        dC = rng.normal(size=(N, N))
        s, ds = np.where(rng.random(N) < 0.3, 0.0, rng.normal(size=N)), rng.normal(size=N)
        budget = np.where(rng.random(N) < 0.3, 0.0, rng.uniform(0.5, 5.0, N))
        feedback = IntegralFeedback(IntegralSettings(budget, anti_windup=method))
        coarse, fine = largest_step(feedback, 501), largest_step(feedback, 5001)
        assert 0.0 < fine < 0.3 * coarse


@pytest.mark.parametrize(("method", "whole_torque", "correct_state"), VARIANTS)
def test_budget_is_kept_in_any_motion(method, whole_torque, correct_state):
    rng = np.random.default_rng(7)
    budget = np.array([0.0, 0.5, 1.0, 2.0, np.inf])
    law = IntegralSettings(
        budget,
        anti_windup=method,
        whole_torque=whole_torque,
        correct_state=correct_state,
        theta_slow=0.0,
    )
    feedback = IntegralFeedback(law)
    v = rng.normal(size=N)
    feedback.start(v)
    M, C = random_dynamics(rng)
    touched = 0
    for _ in range(400):
        v = v + 0.1 * rng.normal(size=N)
        torque = feedback.torque(M, C + rng.normal(size=(N, N)), v, rng.normal(size=N), 0.1)
        assert np.isfinite(torque).all()
        if method != "none":
            limited = torque if whole_torque else feedback.limited_gain_torque
            assert (np.abs(limited) <= budget).all()
            touched += feedback.saturated.any()
        if correct_state and method != "none" and not whole_torque:
            assert (np.abs(2.0 * np.diag(M) * s_now(feedback)) <= budget + ROUGH).all()
    assert method == "none" or touched > 100


anything = st.floats(allow_nan=False, allow_infinity=False)


@given(
    arrays(float, (2, 3, 3), elements=anything),
    arrays(float, (4, 2, 3), elements=anything),
    arrays(float, 3, elements=st.floats(0.0)),
    st.floats(0.0, allow_infinity=False),
    st.sampled_from(VARIANTS),
)
@settings(max_examples=300, deadline=None)
def test_finite_and_within_the_budget_for_any_finite_input(matrices, motion, budget, dt, variant):
    method, whole_torque, correct_state = variant
    law = IntegralSettings(
        budget, anti_windup=method, whole_torque=whole_torque, correct_state=correct_state
    )
    feedback = IntegralFeedback(law)
    for v, a_ref in motion:
        torque = feedback.torque(*matrices, v, a_ref, dt)
        assert np.isfinite(torque).all()
        if method != "none" and whole_torque:
            assert (np.abs(torque) <= budget).all()
        assert np.isfinite(feedback.fast).all() and np.isfinite(feedback.slow).all()
        assert math.isfinite(feedback.leak) and feedback.leak >= 0.0


@given(
    arrays(float, N, elements=st.floats(-10.0, 10.0)),
    arrays(float, N, elements=st.floats(0.0, 20.0)),
    st.floats(0.0, 1.0),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=200, deadline=None)
def test_passive_and_limited_for_any_state(s, budget, mu, seed):
    M, C = random_dynamics(np.random.default_rng(seed), speed=2.0)
    for correct_state in (True, False):
        law = IntegralSettings(budget, mu=mu, correct_state=correct_state)
        feedback = at_state(law, s, -0.5 * s)
        y = torque_now(feedback, M, C)
        assert (np.abs(y) <= budget).all()
        surplus, size = passive_by(feedback, M, C, y)
        assert surplus >= -SHARP * size
        papers = at_state(paper_settings(budget), s)
        torque_now(papers, M, C)
        x, Ks = papers.limited_gain_torque, papers.gain_torque
        assert s @ x >= papers.lambda_w * (s @ Ks) - SHARP * (np.abs(s) @ np.abs(Ks))


def test_correction_lets_joints_leave_their_limits_even_while_they_move(arm):
    """What is corrected is the joint's own share; C s may hold it at the limit all the same."""
    rng = np.random.default_rng(8)
    left, trials = {True: 0, False: 0}, 0
    for _ in range(200):
        q, v = arm.random_state(rng)
        M, C = arm_dynamics(arm, q, 0.5 * v)
        K = 2.0 * np.diag(M)
        s = rng.normal(size=arm.n) / K
        budget = 0.8 * np.abs((C + np.diag(K)) @ s)
        for correct_state in (True, False):
            feedback = at_state(IntegralSettings(budget, correct_state=correct_state), s)
            torque_now(feedback, M, C)
            assert feedback.saturated.all()
            # The error turns round, by a tenth.
            feedback.torque(M, C, 0.1 * s, np.zeros(arm.n), 0.0)
            left[correct_state] += (~feedback.saturated).sum()
        trials += arm.n
    assert left[False] == 0
    assert left[True] > 0.8 * trials


def moving(feedback, rng, steps=50, M=None, C=None):
    """Some steps of a slow motion; the torques."""
    M, C = (
        (np.diag(rng.uniform(0.5, 2.0, N)), 0.2 * rng.normal(size=(N, N))) if M is None else (M, C)
    )
    v, torques = np.zeros(N), []
    feedback.start(v)
    for k in range(steps):
        v = v + DT * rng.normal(size=N)
        torques.append(feedback.torque(M, C, v, 3.0 * np.cos(0.05 * k + np.arange(N)), DT))
    return M, C, v, np.array(torques)


CHANGES = [
    {"lambda_": 0.5},
    {"lambda_": 9.0},
    {"mu": 0.0},
    {"mu": 1.0},
    {"theta_slow": 5.0},
    {"theta_fast": 1.0},
    {"budget": np.full(N, 1e-3)},
    {"budget": np.zeros(N)},
    {"budget": np.full(N, np.inf)},
    {"anti_windup": "none"},
    {"anti_windup": "scaling"},
    {"anti_windup": "clip"},
    {"whole_torque": False},
    {"correct_state": False},
    {"paper_form": True},
    {"lambda_": 0.7, "mu": 0.9, "budget": np.full(N, 0.01), "whole_torque": False},
]


@pytest.mark.parametrize("change", CHANGES, ids=str)
@pytest.mark.parametrize("start", [{}, {"whole_torque": False, "correct_state": False}], ids=str)
def test_live_change_does_not_make_the_torque_jump(change, start):
    rng = np.random.default_rng(9)
    before = replace(IntegralSettings(np.full(N, 0.05)), **start)
    feedback = IntegralFeedback(before)
    M, C, v, torques = moving(feedback, rng)
    ordinary = np.abs(np.diff(torques, axis=0)).max()
    assert feedback.saturated.any()
    feedback.settings = replace(feedback.settings, **change)
    assert feedback.settings.lambda_ == change.get("lambda_", 2.0)
    last, steps = torques[-1], []
    a_ref = np.zeros(N)
    for _ in range(4):
        steps.append(np.abs(feedback.torque(M, C, v, a_ref, DT) - last).max())
        last = feedback.additional_torque.copy()
    # The leak of the new rates, and of a budget that narrows, is no jump.
    assert max(steps) < 1.5 * ordinary + 0.1 * np.abs(torques[-1]).max()


def test_after_a_change_the_new_settings_count():
    rng = np.random.default_rng(10)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 0.5), widening_time=0.05))
    M, C, v, _ = moving(feedback, rng, steps=300)
    assert np.abs(feedback.additional_torque).max() > 0.15
    feedback.settings = replace(feedback.settings, budget=np.full(N, 0.1))
    last = feedback.torque(M, C, v, np.zeros(N), DT)
    assert feedback.widening.max() == pytest.approx(np.abs(last).max() - 0.1)
    for k in range(1, 500):
        torque = feedback.torque(M, C, v, np.zeros(N), DT)
        excess = (np.abs(last) - 0.1).clip(0.0) * math.exp(-k * DT / 0.05)
        assert (np.abs(torque) <= 0.1 + excess + SHARP).all()
    assert np.abs(torque).max() <= 0.1 + 1e-4


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("whole_torque", [True, False])
def test_seeding_gives_the_torque_asked_for(mu, whole_torque):
    rng = np.random.default_rng(11)
    budget = np.array([0.0, 0.5, 2.0, 10.0, np.inf])
    law = IntegralSettings(budget, mu=mu, whole_torque=whole_torque, widening_time=0.5)
    feedback = IntegralFeedback(law)
    for _ in range(20):
        M, C = random_dynamics(rng, speed=0.1)
        wanted = 3.0 * rng.normal(size=N)
        v = rng.normal(size=N)
        feedback.start(v)
        np.testing.assert_allclose(feedback.seed(wanted, M, C), wanted, rtol=1e-10, atol=1e-11)
        limited = wanted if whole_torque else feedback.gain_torque.copy()
        expected = np.maximum(np.abs(limited) - budget, 0.0)
        np.testing.assert_allclose(feedback.widening, expected, rtol=SHARP, atol=SHARP)
        # It goes on from there, and is forgotten slowly.
        after = feedback.torque(M, C, v, np.zeros(N), 0.01)
        free = feedback.widening == 0.0
        if not whole_torque and mu < 1.0:
            decay = feedback.limited_gain_torque / limited
            np.testing.assert_allclose(decay[free], np.exp(-0.01 * 0.1), rtol=ROUGH)
            assert (decay >= np.exp(-0.01 / 0.5) * (1.0 - ROUGH)).all()
        assert np.abs(after - wanted).max() < (0.1 if mu < 1.0 else 0.7) * np.abs(wanted).max()


def test_seed_fades_as_the_widened_budget_does():
    M, C, v = np.eye(N), np.zeros((N, N)), np.zeros(N)
    law = IntegralSettings(np.full(N, 1.0), theta_slow=0.0, widening_time=0.2)
    feedback = IntegralFeedback(law)
    feedback.start(v)
    feedback.seed(np.full(N, 3.0), M, C)
    for k in range(1, 400):
        torque = feedback.torque(M, C, v, v, DT)
        np.testing.assert_allclose(torque, 1.0 + 2.0 * math.exp(-k * DT / 0.2), rtol=ROUGH)
    # The state came along: it leaves the limit at once.
    assert (feedback.torque(M, C, v, np.full(N, -1.0), DT) < 1.0 + 2.0 * math.exp(-2.0)).all()


def test_seeding_is_refused_with_a_reason():
    feedback = IntegralFeedback(IntegralSettings(np.ones(N)))
    M = np.eye(N)
    with pytest.raises(SeedingError, match="has not been started"):
        feedback.seed(np.ones(N), M, 0.0 * M)
    feedback.start(np.zeros(N))
    with pytest.raises(ValueError, match="additional_torque must be 5 finite numbers"):
        feedback.seed(np.full(N, np.nan), M, 0.0 * M)
    for C in (-2.0 * M, -1.999999 * M, np.full((N, N), np.nan)):
        with pytest.raises(SeedingError, match="too fast"):
            feedback.seed(np.ones(N), M, C)
    np.testing.assert_array_equal(s_now(feedback), 0.0)


def test_a_pause_or_a_jump_in_time_does_not_kick():
    rng = np.random.default_rng(12)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    M, C, v, torques = moving(feedback, rng)
    fast, slow = feedback.fast.copy(), feedback.slow.copy()
    feedback.skip(v + 3.0, 2.0)  # somewhere else, at another speed
    np.testing.assert_allclose(feedback.fast, math.exp(-200.0) * fast, rtol=1e-9)
    np.testing.assert_allclose(feedback.slow, math.exp(-0.2) * slow, rtol=1e-12)
    torque = feedback.torque(M, C, v + 3.0, np.zeros(N), 0.0)
    assert np.abs(torque).max() <= 1.5 * np.abs(torques[-1]).max()
    # The same without skipping is what it protects from.
    kicked = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    moving(kicked, np.random.default_rng(12))
    assert np.abs(kicked.torque(M, C, v + 3.0, np.zeros(N), 2.0)).max() > 1.0


def test_first_call_is_a_start_and_start_forgets():
    rng = np.random.default_rng(13)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    M, C = random_dynamics(rng)
    np.testing.assert_array_equal(feedback.torque(M, C, np.ones(N), np.zeros(N), DT), 0.0)
    assert np.abs(feedback.torque(M, C, np.zeros(N), np.zeros(N), DT)).max() > 0.1
    feedback.start(np.ones(N))
    np.testing.assert_array_equal(feedback.additional_torque, 0.0)
    np.testing.assert_array_equal(feedback.torque(M, C, np.ones(N), np.zeros(N), DT), 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"budget": [1.0, -1.0]}, "'budget' is .* a number >= 0 for each joint"),
        ({"budget": [1.0, math.nan]}, "budget"),
        ({"budget": []}, "budget"),
        ({"budget": [[1.0]]}, "budget"),
        ({"lambda_": 0.0}, "'lambda_' is '?0'?; allowed: a finite number > 0"),
        ({"lambda_": math.nan}, "lambda_"),
        ({"theta_slow": -0.1}, "'theta_slow' is '?-0.1'?; allowed: a finite number >= 0"),
        ({"theta_fast": math.inf}, "theta_fast"),
        ({"mu": 1.1}, "'mu' is '?1.1'?; allowed: a number from 0 to 1"),
        ({"mu": math.nan}, "mu"),
        ({"widening_time": 0.0}, "widening_time"),
        (
            {"anti_windup": "hope"},
            "'anti_windup' is '?hope'?; allowed: none or clip or scaling or qp",
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
    M, C, v, _ = moving(feedback, rng)
    with pytest.raises(SettingError, match="one number for each of 5 joints"):
        feedback.settings = IntegralSettings(np.ones(N + 1))
    assert feedback.settings.budget.shape == (N,)
    before = feedback._memory.copy()
    good = {"M": M, "C": C, "v": v, "a_ref_last": v, "dt": DT}
    for name in good:
        value = np.array(good[name], dtype=float)
        value.flat[0] = np.nan
        with pytest.raises(ValueError, match="must be finite"):
            feedback.torque(**{**good, name: value if value.ndim else float(value)})
    with pytest.raises(ValueError, match="dt = -0.1"):
        feedback.torque(**{**good, "dt": -0.1})
    for name, shape in (("M", (N, N + 1)), ("C", (N,)), ("v", (N + 1,)), ("a_ref_last", (1,))):
        with pytest.raises(ValueError, match="vectors must have shape"):
            feedback.torque(**{**good, name: np.zeros(shape)})
    for arguments in ((np.full(N, np.nan), 0.1), (v, -1.0), (v, np.inf), (v[1:], 0.1)):
        with pytest.raises(ValueError, match="must be"):
            feedback.skip(*arguments)
    with pytest.raises(ValueError, match="v must be"):
        feedback.start(np.full(N, np.inf))
    np.testing.assert_array_equal(feedback._memory, before)


def test_budget_of_the_settings_is_a_copy():
    budget = np.ones(N)
    law = IntegralSettings(budget)
    budget[:] = 7.0
    np.testing.assert_array_equal(law.budget, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        law.budget[0] = 2.0


def test_takes_pinocchio_s_matrices():
    arm = load_arm("panda")
    feedback = at_state(IntegralSettings(np.full(arm.n, 1e3)), np.ones(arm.n))
    q, v = arm.random_state(np.random.default_rng(15))
    M, C = arm_dynamics(arm, q, v)
    expected = (C + 2.0 * np.diag(np.diag(M))) @ np.ones(arm.n)
    for order in "CF":
        torque = torque_now(feedback, np.asarray(M, order=order), np.asarray(C, order=order))
        np.testing.assert_allclose(torque, expected, rtol=1e-10)
