"""Null-space compliance of simulated arms: what it is for, its limits, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm

from torque_safety_controller.integral_feedback.feedback import IntegralFeedback, IntegralSettings
from torque_safety_controller.linalg.generalized_inverse import GeneralizedInverseError
from torque_safety_controller.nullspace.compliance import NullspaceCompliance, NullspaceSettings
from torque_safety_controller.nullspace.law import Terms, energy_product
from torque_safety_controller.nullspace.limit import torque_matrix
from viability_bounds_pkg.exceptions import SettingError

DT = 2e-3


def unlimited(n, **changes) -> NullspaceSettings:
    return NullspaceSettings(np.full(n, np.inf), **changes)


class Run:
    """An arm with friction and heavy rotors that holds its hand still; `push` is on its elbow."""

    def __init__(self, robot="talos", rows=6, q=None, **reference):
        self.arm = TaskArm(robot, rows, armature=0.15)
        self.q = self.arm.posture.copy() if q is None else np.array(q, dtype=float)
        self.v = np.zeros(self.arm.n)
        self.hand = self.arm.hand(self.q)
        self.reference = reference
        self.a_ref = np.zeros(self.arm.n)
        self.terms = self.arm.terms(self.q, self.v)
        self.errors, self.torques, self.positions = [], [], []

    def arguments(self):
        t = self.terms
        return t.M, t.C, t.J, t.J_dot, self.v, self.a_ref, DT

    def seed(self, compliance, torque):
        t = self.terms
        return compliance.seed(torque, t.M, t.C, t.J, t.J_dot, self.v)

    def move(self, added, disturbance=0.0, push=None, a_ref=None):
        """Hold the model's and the added torque for a control period."""
        t, error = self.terms, np.zeros(6)
        if a_ref is None:
            a_ref, error = self.arm.reference(self.q, self.v, t, self.hand, **self.reference)
        self.a_ref = a_ref
        tau = t.M @ self.a_ref + t.h + added + disturbance
        if push is not None:
            tau = tau + self.arm.push(self.q, np.array(push))
        self.q, self.v = self.arm.move(self.q, self.v, tau, DT, friction=2.0)
        self.terms = self.arm.terms(self.q, self.v)
        self.errors.append(error)
        self.torques.append(added)
        self.positions.append(self.q)

    def go(self, compliance, duration, **others):
        for _ in range(round(duration / DT)):
            self.move(compliance.torque(*self.arguments()), **others)
        return self


def hand_errors(run):
    return np.linalg.norm(np.array(run.errors)[:, :3], axis=1)


# What it is for


def test_elbow_moves_further_and_the_hand_no_further():
    runs = []
    for free in (False, True):
        run = Run()
        compliance = NullspaceCompliance(unlimited(9, free_null_space=free), 6)
        runs.append(run.go(compliance, 0.1).go(compliance, 2.0, push=[0.0, 40.0, 0.0]))
    moved = [np.abs(run.q - run.arm.posture).max() for run in runs]
    assert moved[1] > 2.5 * moved[0] > 0.1
    stiff, free = (hand_errors(run).max() for run in runs)
    assert free < 0.005
    assert free < 1.1 * stiff


@pytest.mark.parametrize("consistent", [True, False])
def test_a_constant_disturbance_is_integrated_away_while_the_null_space_is_free(consistent):
    """Wrong masses. Without forgetting the hand's error goes to zero, else to what theory says."""
    arm = TaskArm("panda")
    weight = -0.1 * arm.terms(arm.posture, np.zeros(7)).h
    assert np.abs(weight).max() > 2.0

    def steady(**changes):
        run = Run("panda", stiffness=20.0)
        law = unlimited(7, lambda_=6.0, dynamically_consistent=consistent, **changes)
        compliance = NullspaceCompliance(law, 6)
        run.go(compliance, 6.0, disturbance=weight)
        return run, np.linalg.norm(run.errors[-1]), np.abs(run.q - arm.posture).max()

    alone = Run("panda", stiffness=20.0)
    for _ in range(500):
        alone.move(0.0, disturbance=weight)
    without = np.linalg.norm(alone.errors[-1])
    assert without > 4e-3
    _, error, moved = steady(theta_slow=0.0)
    assert error < 1e-3 * without
    _, _, moved_stiff = steady(theta_slow=0.0, free_null_space=False)
    assert moved > 3.0 * moved_stiff
    run, error, _ = steady(theta_slow=0.1)
    # At rest s' = 0.1 a + 99.9 N a and a_fast = 0.001 a.
    M, J = run.terms.M, run.terms.J
    K = 6.0 * np.diag(np.diag(M))
    J_bar = np.linalg.solve(M, J.T) @ np.linalg.inv(J @ np.linalg.solve(M, J.T))
    P = (J_bar if consistent else np.linalg.pinv(J)) @ J
    leak = 0.1 * np.eye(7) + 99.9 * (np.eye(7) - J_bar @ J)
    a = np.linalg.solve(M @ leak + 0.5 * P.T @ K @ P + 0.5 * K * 1e-3, -weight)
    assert error == pytest.approx(np.linalg.norm(0.1 * J @ a / 400.0), rel=0.03)


def test_a_push_that_lasts_does_not_make_it_grow():
    """An arm held off its posture: the printed law's memory grows with time, here not."""
    printed = dict(theta_slow=0.0, theta_null=0.0, keep_integral=True)
    growth, sizes = [], []
    for changes in (printed, {}):
        run = Run(stiffness=20.0)
        compliance = NullspaceCompliance(unlimited(9, **changes), 6)
        half = []
        for _ in range(2):
            run.go(compliance, 2.5, push=[0.0, 30.0, 0.0])
            half.append(np.linalg.norm(compliance.a))
        growth.append(half[1] / half[0])
        sizes.append(half[1])
    assert growth[0] > 1.6
    assert growth[1] < 1.1
    assert sizes[1] < 0.25 * sizes[0]


@pytest.mark.parametrize("consistent", [True, False])
def test_singular_start(consistent):
    """From a stretched-out arm to where the hand is free to move, then holding it there."""
    run = Run("panda", q=np.zeros(7))
    assert np.linalg.svd(run.terms.J)[1][-1] < 1e-15
    compliance = NullspaceCompliance(unlimited(7, dynamically_consistent=consistent), 6)
    singular = []
    for _ in range(round(1.5 / DT)):
        added = compliance.torque(*run.arguments())
        singular.append(compliance.near_singular)
        run.move(added, a_ref=20.0 * (run.arm.posture - run.q) - 9.0 * run.v)
    assert singular[0] and not singular[-1]
    run.hand = run.arm.hand(run.q)
    run.go(compliance, 1.0)
    assert np.abs(run.torques).max() < 15.0
    assert hand_errors(run)[-1] < 0.002


# The gains


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.0, 1.0), st.booleans())
@settings(max_examples=100, deadline=None)
def test_gain_matrix_is_positive(seed, m, mu, free):
    """Semidefinite always; definite with a fast memory, or where the null space is not free."""
    rng = np.random.default_rng(seed)
    n = 7
    J, J_plus = rng.normal(size=(m, n)), rng.normal(size=(n, m))
    K = rng.uniform(0.01, 3.0, n)
    law = NullspaceCompliance(unlimited(n, mu=mu, free_null_space=free), m)._law
    none, zero = np.zeros((n, m)), np.zeros((n, n))
    # At rest: neither C nor J'.
    H = torque_matrix(law, Terms(np.eye(n), zero, J, 0.0 * J, J_plus, none, J_plus, K))
    np.testing.assert_allclose(H, H.T, atol=1e-12 * np.abs(H).max())
    P = J_plus @ J
    slow = P.T @ np.diag(K) @ P if free else np.diag(K)
    np.testing.assert_allclose(H, (1.0 - mu) * slow + mu * np.diag(K), atol=1e-12 * H.max())
    smallest = np.linalg.eigvalsh(H)[0]
    assert smallest >= -1e-12 * H.max()
    if mu > 0.1 or not free:
        assert smallest > 0.9 * min(mu if free else 1.0, 1.0) * K.min()


# Limits

numbers = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@given(
    numbers,
    st.integers(1, 6),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0.0, 0.01, 1.0, 100.0, np.inf]),
)
@settings(max_examples=150, deadline=None)
def test_always_finite_and_within_the_budget(rng, m, consistent, keep, free, budget):
    """Any motion, rank and size of J, however sudden: nothing is promised of it but that."""
    n = 7
    budgets = budget * rng.uniform(0.5, 1.0, n) if 0.0 < budget < np.inf else np.full(n, budget)
    compliance = NullspaceCompliance(
        NullspaceSettings(
            budgets,
            dynamically_consistent=consistent,
            keep_integral=keep,
            free_null_space=free,
            mu=rng.choice([0.0, 0.5, 1.0]),
            theta_slow=rng.choice([0.0, 0.1, 3.0]),
            theta_fast=rng.choice([3.0, 100.0]),
        ),
        m,
    )
    for _ in range(20):
        rank = rng.integers(0, m + 1)
        J, J_dot = rng.normal(size=(2, m, n)) * 10.0 ** rng.uniform(-6.0, 1.0, (2, 1, 1))
        J[rank:] = 0.0
        A, C = rng.normal(size=(2, n, n))
        M = A @ A.T + 10.0 ** rng.uniform(-3.0, 0.0) * np.eye(n)
        v, a_ref = rng.normal(size=(2, n)) * 10.0 ** rng.uniform(-3.0, 3.0, (2, 1))
        tau = compliance.torque(M, C, J, J_dot, v, a_ref, rng.choice([0.0, 1e-3, 1.0]))
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= budgets).all()
        assert np.isfinite(compliance.energy) and np.isfinite(compliance.task_integral).all()


def seeded(seed, **changes):
    """A moving arm and a memory from a random torque, of which the offset has gone."""
    run, rng = Run("talos"), np.random.default_rng(seed)
    run.v = 0.5 * rng.normal(size=9)
    run.terms = run.arm.terms(run.q, run.v)
    run.a_ref = run.v.copy()
    settings = unlimited(9, blend_time=1e-9, widening_time=1e-9, **changes)
    compliance = NullspaceCompliance(settings, 6)
    run.seed(compliance, np.diag(run.terms.M) * rng.normal(size=9))
    return run, compliance, rng


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_limiting_takes_energy_away_and_never_adds_any(seed, keep):
    """The memory after limiting gives just the limited torque, and stores no more."""
    run, wide, _ = seeded(seed, keep_integral=keep)
    _, tight, rng = seeded(seed, keep_integral=keep)
    free = wide.torque(*run.arguments())
    budgets = np.abs(free) * rng.uniform(0.3, 2.0, 9)
    # Not through `settings`, which would widen the budgets.
    tight._budget[:] = budgets
    got = tight.torque(*run.arguments())
    assert tight.limited and not wide.limited
    assert (np.abs(got) <= budgets).all()
    assert tight.energy <= wide.energy * (1.0 + 1e-12)
    # Without more error it goes on from there.
    after = tight.torque(*run.arguments()[:-1], 0.0)
    np.testing.assert_allclose(after, got, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_one_limited_joint_does_not_weaken_the_others(seed):
    """By (10) all torques would fall to nine tenths; here only the limited joint's does."""
    run, wide, _ = seeded(seed)
    _, tight, _ = seeded(seed)
    free = wide.torque(*run.arguments())
    j = int(np.argmax(np.abs(free)))
    tight._budget[j] = 0.9 * np.abs(free[j])
    got = tight.torque(*run.arguments())
    assert abs(got[j]) == pytest.approx(0.9 * abs(free[j]), rel=1e-9)
    others = np.arange(9) != j
    np.testing.assert_allclose(got[others], free[others], atol=0.02 * np.abs(free).max())


def test_it_leaves_its_limits_at_once():
    """A hand that was held off for seconds returns without the swing of an integral wound up."""
    swings = []
    for budget in (np.inf, 3.0):
        run = Run("panda")
        compliance = NullspaceCompliance(NullspaceSettings(np.full(7, budget)), 6)
        for k in range(round(4.0 / DT)):
            force = run.terms.J[:3].T @ np.array([0.0, 60.0, 0.0]) if k * DT < 3.0 else 0.0
            run.move(compliance.torque(*run.arguments()), disturbance=force)
        assert np.abs(run.torques).max() <= budget
        late = hand_errors(run)[round(3.3 / DT) :]
        swings.append(late.max())
    assert swings[1] < 0.4 * swings[0]


# Going over from one mode to another


@pytest.mark.parametrize("consistent", [True, False])
def test_from_the_plain_mode_and_back_without_a_jump(consistent):
    run = Run()
    n, weight = 9, 3.0 * np.sin(np.arange(9) + 1.0)
    plain = IntegralFeedback(IntegralSettings(np.full(n, 20.0)))
    free = NullspaceCompliance(
        NullspaceSettings(np.full(n, 20.0), dynamically_consistent=consistent), 6
    )

    def plain_step():
        t = run.terms
        run.move(plain.torque(t.M, t.C, run.v, run.a_ref, DT), weight, [0.0, 20.0, 0.0])

    for _ in range(400):
        plain_step()
    t = run.terms
    last = plain.torque(t.M, t.C, run.v, run.a_ref, DT)
    assert np.abs(last).max() > 1.0
    np.testing.assert_allclose(run.seed(free, last), last, atol=1e-12)
    run.move(last, weight, [0.0, 20.0, 0.0])
    run.go(free, 1.0, disturbance=weight, push=[0.0, 20.0, 0.0])
    t = run.terms
    last = free.torque(*run.arguments())
    plain.start(run.v)
    np.testing.assert_allclose(plain.seed(last, t.M, t.C), last, atol=1e-9)
    run.move(last, weight, [0.0, 20.0, 0.0])
    for _ in range(200):
        plain_step()

    jumps = np.abs(np.diff(run.torques, axis=0)).max(axis=1)
    usual = jumps[5:395].max()
    fading = np.abs(run.torques[400]).max() * DT / free.settings.blend_time
    assert fading < 0.002 * 20.0
    for change in (400, 901):
        assert jumps[change - 2 : change + 4].max() < usual + fading
    # The hand hardly notices.
    errors = hand_errors(run)
    assert errors[400:500].max() < 1.5 * errors[300:400].max()


def test_the_task_keeps_its_torque_and_the_rest_fades():
    run = Run("talos")
    compliance = NullspaceCompliance(unlimited(9, blend_time=0.05), 6)
    torque = 5.0 * np.cos(np.arange(9))
    J, M = run.terms.J, run.terms.M
    felt = J @ np.linalg.solve(M, torque)
    first = run.seed(compliance, torque)
    np.testing.assert_allclose(first, torque, atol=1e-12)
    for _ in range(round(0.5 / DT)):  # nothing moves, nothing is asked for
        later = compliance.torque(*run.arguments())
    left = np.exp(-0.1 * 0.5)  # the slow memory leaks
    np.testing.assert_allclose(J @ np.linalg.solve(M, later), left * felt, rtol=0.01, atol=0.01)
    task = J.T @ np.linalg.solve(J @ np.linalg.solve(M, J.T), felt)
    np.testing.assert_allclose(later, left * task, atol=0.02)
    assert np.abs(torque - task).max() > 1.0


def test_a_budget_is_widened_as_far_as_needed_and_returns():
    run = Run("talos")
    budget = np.full(9, 2.0)
    compliance = NullspaceCompliance(NullspaceSettings(budget, widening_time=0.1), 6)
    torque = np.array([5.0, -1.0, 0.0, 3.0, 0.0, 0.0, 1.0, 0.0, -2.5])
    np.testing.assert_allclose(run.seed(compliance, torque), torque, atol=1e-12)
    last = np.abs(torque)
    for k in range(1, 200):
        tau = np.abs(compliance.torque(*run.arguments()))
        widening = np.maximum(np.abs(torque) - budget, 0.0) * np.exp(-k * DT / 0.1)
        assert (tau <= budget + widening + 1e-12).all()
        assert np.abs(tau - last).max() < 0.3
        last = tau
    assert (tau <= budget + 0.1).all()


@pytest.mark.parametrize(
    "changes",
    [
        dict(lambda_=6.0),
        dict(mu=0.0),
        dict(mu=1.0),
        dict(free_null_space=False),
        dict(dynamically_consistent=False),
        dict(keep_integral=True),
        dict(theta_slow=5.0),
        dict(theta_fast=10.0),
        dict(theta_null=0.2),
        dict(threshold=0.5),
        dict(budget=np.full(9, 0.1)),
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_settings_change_live_without_a_jump(changes):
    """The step of the change gives the torque that the old settings give."""
    runs = [Run(), Run()]
    compliances = [NullspaceCompliance(unlimited(9), 6) for _ in runs]
    push = dict(push=[0.0, 30.0, 0.0])
    for run, compliance in zip(runs, compliances, strict=True):
        run.go(compliance, 0.5, **push)
    usual = np.abs(np.diff(runs[0].torques, axis=0)).max()
    new = replace(compliances[1].settings, **changes)
    compliances[1].settings = new
    assert compliances[1].settings is new
    for run, compliance in zip(runs, compliances, strict=True):
        run.go(compliance, DT, **push)
    np.testing.assert_allclose(runs[1].torques[-1], runs[0].torques[-1], atol=1e-12)
    runs[1].go(compliances[1], 0.02, **push)
    assert np.abs(np.diff(runs[1].torques[-11:], axis=0)).max() < 2.0 * usual + 0.05


def test_settings_before_the_start_take_effect_at_once():
    compliance = NullspaceCompliance(unlimited(7), 6)
    new = unlimited(7, lambda_=1.0)
    compliance.settings = new
    assert compliance.settings is new and compliance._law.lambda_ == 1.0


# What can go wrong


def test_starts_from_zero_and_a_pause_is_no_kick():
    run = Run()
    compliance = NullspaceCompliance(unlimited(9), 6)
    run.v = np.ones(9)
    np.testing.assert_array_equal(compliance.torque(*run.arguments()), 0.0)
    run.v = np.zeros(9)
    run.go(compliance, 0.3, push=[0.0, 30.0, 0.0])
    before, energy = compliance.additional_torque, compliance.energy
    run.v = run.v + 1.0  # who knows why
    compliance.skip(run.v, run.terms.J, 0.2)
    assert compliance.energy < energy
    after = compliance.torque(*run.arguments()[:-1], 0.0)
    assert np.abs(after - before).max() < 0.6 * np.abs(before).max()
    compliance.start(run.v, run.terms.J)
    np.testing.assert_array_equal(compliance.torque(*run.arguments()[:-1], 0.0), 0.0)


def test_bad_input_changes_nothing():
    run, twin = Run(), Run()
    compliances = [NullspaceCompliance(unlimited(9), 6) for _ in range(2)]
    for each, compliance in zip((run, twin), compliances, strict=True):
        each.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
    good = run.arguments()
    for k in range(6):
        bad = [np.array(x) for x in good[:6]]
        bad[k].flat[0] = np.nan
        with pytest.raises(ValueError, match="finite"):
            compliances[0].torque(*bad, DT)
        bad[k] = bad[k][..., :-1]
        with pytest.raises(ValueError, match="for 9 joints and a task of 6 rows"):
            compliances[0].torque(*bad, DT)
    with pytest.raises(ValueError, match="positive definite"):
        compliances[0].torque(-good[0], *good[1:])
    for dt in (-1e-3, np.nan, np.inf):
        with pytest.raises(ValueError, match="dt must be"):
            compliances[0].torque(*good[:-1], dt)
        with pytest.raises(ValueError, match="dt must be"):
            compliances[0].skip(run.v, run.terms.J, dt)
    with pytest.raises(ValueError, match="additional_torque must be 9 finite"):
        run.seed(compliances[0], np.full(9, np.nan))
    with pytest.raises(ValueError, match="positive definite"):
        compliances[0].seed(np.ones(9), -good[0], *good[1:5])
    with pytest.raises(ValueError, match="v must be"):
        compliances[0].skip(np.zeros(3), run.terms.J, DT)
    with pytest.raises(ValueError, match="J must be 6 by 9"):
        compliances[0].start(run.v, run.terms.J.T)
    expected = compliances[1].torque(*twin.arguments())
    np.testing.assert_array_equal(compliances[0].torque(*good), expected)


@pytest.mark.parametrize("m", [0, 7, 8])
def test_a_task_without_null_space_is_refused(m):
    with pytest.raises(GeneralizedInverseError, match=f"a task of {m} rows for 7 joints"):
        NullspaceCompliance(unlimited(7), m)


@pytest.mark.parametrize("m", range(1, 7))
def test_any_task_with_a_null_space_is_served(m):
    run = Run("panda", rows=m)
    compliance = NullspaceCompliance(unlimited(7), m)
    run.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
    assert np.abs(compliance.task_integral).max() > 1e-4
    assert np.isfinite(run.torques).all()


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(budget=np.array([1.0, -1.0])), "'budget' is .* >= 0"),
        (dict(budget=np.array([np.nan])), "'budget' is .* >= 0"),
        (dict(budget=np.ones((2, 2))), "budget"),
        (dict(lambda_=0.0), "'lambda_' is '?0'?; allowed: a finite number > 0"),
        (dict(lambda_=np.nan), "lambda_"),
        (dict(mu=1.5), "'mu' is '?1.5'?; allowed: a number from 0 to 1"),
        (dict(mu=np.nan), "mu"),
        (dict(theta_slow=-0.1), "'theta_slow' is -0.1"),
        (dict(theta_fast=0.01), "'theta_fast' is '?0.01'?; allowed: .* >= theta_slow = 0.1"),
        (dict(theta_null=0.01), "'theta_null' is '?0.01'?; allowed: .* >= theta_slow = 0.1"),
        (dict(theta_null=np.inf), "theta_null"),
        (dict(threshold=0.0), "'threshold' is '?0'?; allowed: a finite number > 0"),
        (dict(blend_time=0.0), "blend_time"),
        (dict(widening_time=-1.0), "widening_time"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(SettingError, match=message):
        replace(unlimited(2), **changes)


def test_budgets_of_another_arm_are_refused():
    compliance = NullspaceCompliance(unlimited(7), 6)
    with pytest.raises(SettingError, match="one number for each of 7 joints"):
        compliance.settings = unlimited(6)


def test_energy_is_a_norm_of_the_memory():
    law = NullspaceCompliance(unlimited(3), 1)._law
    M = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.5]])
    a, x = np.array([1.0, -2.0, 0.5]), np.array([0.2, 0.4, -1.0])
    weight = 0.5 * 2.0 / (100.0 - 0.1)
    expected = a @ M @ a + weight * x @ np.diag(np.diag(M)) @ x
    assert energy_product(law, M, a, x, a, x) == pytest.approx(expected, rel=1e-14)
