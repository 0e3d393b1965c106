# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance of simulated arms: what it is for, its limits, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralFeedback,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.settings import WIDENING_TIME
from torque_safety_controller.linalg.generalized_inverse import THRESHOLD, TaskShapeError
from torque_safety_controller.nullspace import NullspaceCompliance
from torque_safety_controller.nullspace.kernels import (
    FADING_TIME,
    energy_product,
    law_torque,
    torque_matrix,
)
from viability_bounds_pkg.exceptions import SettingError

DT = 2e-3


def unlimited(n, **changes) -> IntegralSettings:
    return IntegralSettings(np.full(n, np.inf), **changes)


def energy(compliance, M) -> float:
    """What the memory stores, J."""
    a, x = compliance.memory.a, compliance.memory.root / np.sqrt(np.diag(M))
    return 0.5 * energy_product(compliance.settings.law, M, a, x, a, x)


class ComplianceRun:
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

    @property
    def now(self) -> ArmTerms:
        return arm_terms(self.terms, self.v)

    def arguments(self):
        return self.now, self.a_ref, DT

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


def started(run, settings, m=6) -> NullspaceCompliance:
    """Without any memory, at the state of an arm."""
    compliance = NullspaceCompliance(settings, m)
    compliance.reset(run.now)
    return compliance


def hand_errors(run):
    return np.linalg.norm(np.array(run.errors)[:, :3], axis=1)


# What it is for


def test_elbow_moves_further_and_the_hand_no_further():
    """Than with all joints stiff."""
    moved, errors = {}, {}
    for kind in (IntegralFeedback, NullspaceCompliance):
        run = ComplianceRun()
        action = kind(unlimited(9)) if kind is IntegralFeedback else kind(unlimited(9), 6)
        action.reset(run.now)
        run.go(action, 0.1).go(action, 2.0, push=[0.0, 40.0, 0.0])
        moved[kind], errors[kind] = np.abs(run.q - run.arm.posture).max(), hand_errors(run).max()
    assert moved[NullspaceCompliance] > 2.5 * moved[IntegralFeedback] > 0.1
    assert errors[NullspaceCompliance] < 0.005
    assert errors[NullspaceCompliance] < 1.1 * errors[IntegralFeedback]


def test_a_constant_disturbance_is_integrated_away_while_the_null_space_is_free():
    """Wrong masses. Without forgetting the hand's error goes to zero, else to what theory says."""
    arm = TaskArm("panda")
    weight = -0.1 * arm.terms(arm.posture, np.zeros(7)).h
    assert np.abs(weight).max() > 2.0

    def steady(kind=NullspaceCompliance, **changes):
        run = ComplianceRun("panda", stiffness=20.0)
        law = unlimited(7, gain=6.0, **changes)
        action = kind(law) if kind is IntegralFeedback else kind(law, 6)
        action.reset(run.now)
        run.go(action, 6.0, disturbance=weight)
        return run, np.linalg.norm(run.errors[-1]), np.abs(run.q - arm.posture).max()

    alone = ComplianceRun("panda", stiffness=20.0)
    for _ in range(500):
        alone.move(0.0, disturbance=weight)
    without = np.linalg.norm(alone.errors[-1])
    assert without > 4e-3
    _, error, moved = steady(slow_leak_rate=0.0)
    assert error < 1e-3 * without
    _, _, moved_stiff = steady(IntegralFeedback, slow_leak_rate=0.0)
    assert moved > 3.0 * moved_stiff
    run, error, _ = steady(slow_leak_rate=0.1)
    # At rest s' = 0.1 a + 99.9 N a and a_fast = 0.001 a.
    M, J = run.terms.M, run.terms.J
    K = 6.0 * np.diag(np.diag(M))
    P = np.linalg.solve(M, J.T) @ np.linalg.inv(J @ np.linalg.solve(M, J.T)) @ J
    leak = 0.1 * np.eye(7) + 99.9 * (np.eye(7) - P)
    a = np.linalg.solve(M @ leak + 0.5 * P.T @ K @ P + 0.5 * K * 1e-3, -weight)
    assert error == pytest.approx(np.linalg.norm(0.1 * J @ a / 400.0), rel=0.03)


def test_a_push_that_lasts_does_not_make_it_grow():
    """An arm held off its posture; the law as printed would double its memory."""
    run = ComplianceRun(stiffness=20.0)
    compliance = started(run, unlimited(9))
    half = []
    for _ in range(2):
        run.go(compliance, 2.5, push=[0.0, 30.0, 0.0])
        half.append(np.linalg.norm(compliance.memory.a))
    assert half[1] < 1.1 * half[0]


def test_singular_start():
    """From a stretched-out arm to where the hand is free to move, then holding it there."""
    run = ComplianceRun("panda", q=np.zeros(7))
    assert np.linalg.svd(run.terms.J)[1][-1] < 1e-15
    compliance = started(run, unlimited(7))
    for _ in range(round(1.5 / DT)):
        added = compliance.torque(*run.arguments())
        run.move(added, a_ref=20.0 * (run.arm.posture - run.q) - 9.0 * run.v)
    assert np.linalg.svd(run.terms.J)[1][-1] > THRESHOLD
    run.hand = run.arm.hand(run.q)
    run.go(compliance, 1.0)
    assert np.abs(run.torques).max() < 15.0
    assert hand_errors(run)[-1] < 0.002


# The gains


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.0, 1.0))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_gain_matrix_is_positive(seed, m, mu):
    """Semidefinite always; definite with a fast memory."""
    rng = np.random.default_rng(seed)
    n = 7
    J, J_plus = rng.normal(size=(m, n)), rng.normal(size=(n, m))
    M = np.diag(rng.uniform(0.01, 3.0, n))
    K, law = 2.0 * np.diag(M), unlimited(n, mu=mu).law
    # At rest: neither C nor J'.
    rest = ArmTerms(M, 0.0 * M, J, 0.0 * J, np.zeros(n))
    H = torque_matrix(law, rest, J_plus, 0.0 * J_plus)
    np.testing.assert_allclose(H, H.T, atol=1e-12 * np.abs(H).max())
    P = J_plus @ J
    expected = (1.0 - mu) * P.T @ np.diag(K) @ P + mu * np.diag(K)
    # The torque is linear in the memory, moving or not.
    moving = rest._replace(C=rng.normal(size=(n, n)), J_dot=rng.normal(size=(m, n)))
    rates, a, x = rng.normal(size=(n, m)), rng.normal(size=n), rng.normal(size=n)
    torque = torque_matrix(law, moving, J_plus, rates) @ a - mu * K * x
    found = law_torque(law, moving, J_plus, rates, a, x)
    np.testing.assert_allclose(found, torque, atol=1e-11 * np.abs(torque).max())
    np.testing.assert_allclose(H, expected, atol=1e-12 * H.max())
    smallest = np.linalg.eigvalsh(H)[0]
    assert smallest >= -1e-12 * H.max()
    if mu > 0.1:
        assert smallest > 0.9 * mu * K.min()


# Limits

numbers = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@given(numbers, st.integers(1, 6), st.sampled_from([0.0, 0.01, 1.0, 100.0, np.inf]))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_always_finite_and_within_the_budget(rng, m, budget):
    """Any motion, rank and size of J, however sudden: nothing is promised of it but that."""
    n = 7
    budgets = budget * rng.uniform(0.5, 1.0, n) if 0.0 < budget < np.inf else np.full(n, budget)
    law = IntegralSettings(
        budgets,
        mu=rng.choice([0.0, 0.5, 1.0]),
        slow_leak_rate=rng.choice([0.0, 0.1, 3.0]),
        fast_leak_rate=rng.choice([3.0, 100.0]),
    )
    compliance = NullspaceCompliance(law, m)
    for _ in range(20):
        rank = rng.integers(0, m + 1)
        J, J_dot = rng.normal(size=(2, m, n)) * 10.0 ** rng.uniform(-6.0, 1.0, (2, 1, 1))
        J[rank:] = 0.0
        A, C = rng.normal(size=(2, n, n))
        M = A @ A.T + 10.0 ** rng.uniform(-3.0, 0.0) * np.eye(n)
        v, a_ref = rng.normal(size=(2, n)) * 10.0 ** rng.uniform(-3.0, 3.0, (2, 1))
        arm = ArmTerms(M, C, J, J_dot, v)
        tau = compliance.torque(arm, a_ref, rng.choice([0.0, 1e-3, 1.0]))
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= budgets).all()
        assert np.isfinite(energy(compliance, M))


def with_memory(seed, budget=np.inf):
    """A moving arm and a memory from a random torque, of which the offset has gone."""
    run, rng = ComplianceRun("talos"), np.random.default_rng(seed)
    run.v = 0.5 * rng.normal(size=9)
    run.terms = run.arm.terms(run.q, run.v)
    run.a_ref = run.v.copy()
    compliance = NullspaceCompliance(unlimited(9), 6)
    compliance.initialise(np.diag(run.terms.M) * rng.normal(size=9), run.now)
    compliance.memory.offset[:] = 0.0
    compliance.settings = replace(compliance.settings, budget=np.full(9, budget))
    return run, compliance, rng


@pytest.mark.parametrize("seed", range(10))
def test_limiting_takes_energy_away_and_never_adds_any(seed):
    """The memory after limiting gives just the limited torque, and stores no more."""
    run, wide, _ = with_memory(seed)
    _, tight, rng = with_memory(seed)
    free = wide.torque(*run.arguments())
    budgets = np.abs(free) * rng.uniform(0.3, 2.0, 9)
    tight.settings = replace(tight.settings, budget=budgets)
    got = tight.torque(*run.arguments())
    assert tight.saturated.any() and not wide.saturated.any()
    assert (np.abs(got) <= budgets).all()
    M = run.terms.M
    assert energy(tight, M) <= energy(wide, M) * (1.0 + 1e-12)
    # Without more error it goes on from there.
    after = tight.torque(run.now, run.a_ref, 0.0)
    np.testing.assert_allclose(after, got, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_one_limited_joint_does_not_weaken_the_others(seed):
    """By (10) all torques would fall to nine tenths; here only the limited joint's does."""
    run, wide, _ = with_memory(seed)
    _, tight, _ = with_memory(seed)
    free = wide.torque(*run.arguments())
    j = int(np.argmax(np.abs(free)))
    budget = np.where(np.arange(9) == j, 0.9 * np.abs(free), np.inf)
    tight.settings = replace(tight.settings, budget=budget)
    got = tight.torque(*run.arguments())
    assert abs(got[j]) == pytest.approx(0.9 * abs(free[j]), rel=1e-9)
    others = np.arange(9) != j
    np.testing.assert_allclose(got[others], free[others], atol=0.02 * np.abs(free).max())


def test_it_leaves_its_limits_at_once():
    """A hand that was held off for seconds returns without the swing of an integral wound up."""
    swings = []
    for budget in (np.inf, 3.0):
        run = ComplianceRun("panda")
        compliance = started(run, IntegralSettings(np.full(7, budget)))
        for k in range(round(4.0 / DT)):
            force = run.terms.J[:3].T @ np.array([0.0, 60.0, 0.0]) if k * DT < 3.0 else 0.0
            run.move(compliance.torque(*run.arguments()), disturbance=force)
        assert np.abs(run.torques).max() <= budget
        late = hand_errors(run)[round(3.3 / DT) :]
        swings.append(late.max())
    assert swings[1] < 0.4 * swings[0]


# Going over from one mode to another


def test_from_the_plain_mode_and_back_without_a_jump():
    run = ComplianceRun()
    n, weight = 9, 3.0 * np.sin(np.arange(9) + 1.0)
    law = IntegralSettings(np.full(n, 20.0))
    plain, free = IntegralFeedback(law), NullspaceCompliance(law, 6)
    plain.reset(run.now)

    def plain_step():
        run.move(plain.torque(*run.arguments()), weight, [0.0, 20.0, 0.0])

    for _ in range(400):
        plain_step()
    last = plain.torque(*run.arguments())
    assert np.abs(last).max() > 1.0
    np.testing.assert_allclose(free.initialise(last, run.now), last, atol=1e-12)
    run.move(last, weight, [0.0, 20.0, 0.0])
    run.go(free, 1.0, disturbance=weight, push=[0.0, 20.0, 0.0])
    last = free.torque(*run.arguments())
    plain.reset(run.now)
    np.testing.assert_allclose(plain.initialise(last, run.now), last, atol=1e-9)
    run.move(last, weight, [0.0, 20.0, 0.0])
    for _ in range(200):
        plain_step()

    jumps = np.abs(np.diff(run.torques, axis=0)).max(axis=1)
    usual = jumps[5:395].max()
    fading = np.abs(run.torques[400]).max() * DT / FADING_TIME
    assert fading < 0.002 * 20.0
    for change in (400, 901):
        assert jumps[change - 2 : change + 4].max() < usual + fading
    # The hand hardly notices.
    errors = hand_errors(run)
    assert errors[400:500].max() < 1.5 * errors[300:400].max()


def test_the_task_keeps_its_torque_and_the_rest_fades():
    run = ComplianceRun("talos")
    compliance = NullspaceCompliance(unlimited(9), 6)
    torque = 5.0 * np.cos(np.arange(9))
    J, M = run.terms.J, run.terms.M
    felt = J @ np.linalg.solve(M, torque)
    first = compliance.initialise(torque, run.now)
    np.testing.assert_allclose(first, torque, atol=1e-12)
    for _ in range(round(2.0 / DT)):  # nothing moves, nothing is asked for
        later = compliance.torque(*run.arguments())
    left = np.exp(-0.1 * 2.0)  # the slow memory leaks
    np.testing.assert_allclose(J @ np.linalg.solve(M, later), left * felt, rtol=0.01, atol=0.01)
    task = J.T @ np.linalg.solve(J @ np.linalg.solve(M, J.T), felt)
    np.testing.assert_allclose(later, left * task, atol=0.02)
    assert np.abs(torque - task).max() > 1.0


def test_a_budget_is_widened_as_far_as_needed_and_returns():
    run = ComplianceRun("talos")
    budget = np.full(9, 2.0)
    compliance = NullspaceCompliance(IntegralSettings(budget), 6)
    torque = np.array([5.0, -1.0, 0.0, 3.0, 0.0, 0.0, 1.0, 0.0, -2.5])
    np.testing.assert_allclose(compliance.initialise(torque, run.now), torque, atol=1e-12)
    last = np.abs(torque)
    for k in range(1, 400):
        tau = np.abs(compliance.torque(run.now, run.a_ref, 0.01))
        widening = np.maximum(np.abs(torque) - budget, 0.0) * np.exp(-k * 0.01 / WIDENING_TIME)
        assert (tau <= budget + widening + 1e-12).all()
        assert np.abs(tau - last).max() < 0.3
        last = tau
    assert (tau <= budget + 0.1).all()


@pytest.mark.parametrize(
    "changes",
    [
        dict(gain=6.0),
        dict(mu=0.0),
        dict(mu=1.0),
        dict(slow_leak_rate=5.0),
        dict(fast_leak_rate=10.0),
        dict(budget=np.full(9, 0.1)),
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_settings_change_without_a_jump_when_initialised(changes):
    run = ComplianceRun()
    compliance = started(run, unlimited(9))
    push = dict(push=[0.0, 30.0, 0.0])
    run.go(compliance, 0.5, **push)
    usual = np.abs(np.diff(run.torques, axis=0)).max()
    last = compliance.torque(*run.arguments())
    compliance.settings = replace(compliance.settings, **changes)
    np.testing.assert_allclose(compliance.initialise(last, run.now), last, atol=1e-12)
    run.move(last, **push)
    run.go(compliance, 0.02, **push)
    assert np.abs(np.diff(run.torques[-12:], axis=0)).max() < 2.0 * usual + 0.05


# What can go wrong


def test_starts_from_zero_and_a_pause_is_no_kick():
    run = ComplianceRun()
    run.v = np.ones(9)
    compliance = started(run, unlimited(9))
    np.testing.assert_array_equal(compliance.torque(*run.arguments()), 0.0)
    run.v = np.zeros(9)
    run.go(compliance, 0.3, push=[0.0, 30.0, 0.0])
    before, stored = run.torques[-1], energy(compliance, run.terms.M)
    run.v = run.v + 1.0  # who knows why
    compliance.skip(run.now, 0.2)
    assert energy(compliance, run.terms.M) < stored
    after = compliance.torque(run.now, run.a_ref, 0.0)
    assert np.abs(after - before).max() < 0.6 * np.abs(before).max()
    compliance.reset(run.now)
    np.testing.assert_array_equal(compliance.torque(run.now, run.a_ref, 0.0), 0.0)


def test_bad_input_changes_nothing():
    run, twin = ComplianceRun(), ComplianceRun()
    compliances = [started(each, unlimited(9)) for each in (run, twin)]
    for each, compliance in zip((run, twin), compliances, strict=True):
        each.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
    compliance, now = compliances[0], run.now
    for name in now._fields:
        bad = getattr(now, name).copy()
        bad.flat[0] = np.nan
        with pytest.raises(ValueError, match="finite"):
            compliance.torque(now._replace(**{name: bad}), run.a_ref, DT)
        with pytest.raises(ValueError, match="broadcast"):
            compliance.torque(now._replace(**{name: bad[..., :-1]}), run.a_ref, DT)
    with pytest.raises(ValueError, match="finite"):
        compliance.torque(now, np.full(9, np.nan), DT)
    with pytest.raises(ValueError, match="broadcast"):
        compliance.torque(now, np.zeros(8), DT)
    negative = now._replace(M=-now.M)
    for M in (negative, now._replace(M=0.0 * now.M)):
        with pytest.raises(ValueError, match="positive definite"):
            compliance.torque(M, run.a_ref, DT)
        with pytest.raises(ValueError, match="positive definite"):
            compliance.initialise(np.ones(9), M)
    with pytest.raises(ValueError, match="finite"):
        compliance.initialise(np.full(9, np.nan), now)
    with pytest.raises(ValueError, match="v must be"):
        compliance.skip(now._replace(v=np.full(9, np.inf)), DT)
    expected = compliances[1].torque(*twin.arguments())
    np.testing.assert_array_equal(compliance.torque(*run.arguments()), expected)


@pytest.mark.parametrize("m", [0, 7, 8])
def test_a_task_without_null_space_is_refused(m):
    with pytest.raises(TaskShapeError, match=f"a task of {m} rows for 7 joints"):
        NullspaceCompliance(unlimited(7), m)


@pytest.mark.parametrize("m", range(1, 7))
def test_any_task_with_a_null_space_is_served(m):
    run = ComplianceRun("panda", rows=m)
    compliance = started(run, unlimited(7), m)
    run.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
    assert np.abs(run.terms.J @ compliance.memory.a).max() > 1e-4
    assert np.isfinite(run.torques).all()


def test_budgets_of_another_arm_are_refused():
    compliance = NullspaceCompliance(unlimited(7), 6)
    with pytest.raises(SettingError, match="one number for each of 7 joints"):
        compliance.settings = unlimited(6)


def test_energy_is_a_norm_of_the_memory():
    law = unlimited(3).law
    M = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.5]])
    a, x = np.array([1.0, -2.0, 0.5]), np.array([0.2, 0.4, -1.0])
    weight = 0.5 * 2.0 / (100.0 - 0.1)
    expected = a @ M @ a + weight * x @ np.diag(np.diag(M)) @ x
    assert energy_product(law, M, a, x, a, x) == pytest.approx(expected, rel=1e-14)
