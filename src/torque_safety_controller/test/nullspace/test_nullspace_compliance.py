# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance of simulated arms: what it is for, its limits, and what it refuses."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralFeedback,
    IntegralSettings,
    LeakyIntegrator,
)
from torque_safety_controller.integral_feedback.nullspace import (
    NullspaceCompliance,
    TaskShapeError,
)
from torque_safety_controller.integral_feedback.task_inverse import THRESHOLD

DT = 2e-3


def unlimited(n, **changes) -> IntegralSettings:
    return IntegralSettings(np.full(n, np.inf), **changes)


def energy(compliance, M) -> float:
    """What the memory stores, J."""
    a, x = compliance.memory.a, compliance.memory.root / np.sqrt(np.diag(M))
    settings = compliance.settings
    weight = settings.mu * settings.gain / (settings.fast_leak_rate - settings.slow_leak_rate)
    return 0.5 * (a @ M @ a + weight * x @ (np.diag(M) * x))


class ComplianceRun:
    """An arm with friction and heavy rotors that holds its hand still."""

    def __init__(self, robot="talos", rows=6, q=None, stiffness=0.0):
        self.arm, self.stiffness = TaskArm(robot, rows, armature=0.15), stiffness
        self.q = self.arm.posture.copy() if q is None else np.array(q, dtype=float)
        self.v, self.a_ref = np.zeros((2, self.arm.n))
        self.hand = self.arm.hand(self.q)
        self.terms = self.arm.terms(self.q, self.v)
        self.errors, self.torques = [], []

    @property
    def now(self) -> ArmTerms:
        return arm_terms(self.terms, self.v)

    def started(self, settings, kind=NullspaceCompliance):
        """An integral action without any memory."""
        action = kind(settings, self.arm.rows) if kind is NullspaceCompliance else kind(settings)
        action.reset(self.now)
        return action

    def move(self, added, disturbance=0.0, push=None, a_ref=None):
        """Hold the model's and the added torque for a control period; `push` is on the elbow."""
        t, arm = self.terms, self.arm
        error = pin.log6(arm.hand(self.q).actInv(self.hand)).vector[: arm.rows]
        if a_ref is None:
            rest = self.stiffness * (arm.posture - self.q) - 5.0 * self.v
            task = 400.0 * error - 40.0 * t.J @ self.v - t.J_dot @ self.v
            a_ref = rest + np.linalg.pinv(t.J) @ (task - t.J @ rest)
        self.a_ref = a_ref
        tau = t.M @ a_ref + t.h + added + disturbance
        if push is not None:
            tau = tau + arm.push(self.q, np.array(push))
        self.q, self.v = arm.move(self.q, self.v, tau, DT, friction=2.0)
        self.terms = arm.terms(self.q, self.v)
        self.errors.append(np.linalg.norm(error[:3]))
        self.torques.append(added)

    def go(self, action, duration, **others):
        for _ in range(round(duration / DT)):
            self.move(action.torque(self.now, self.a_ref, DT), **others)
        return self


# What it is for


def test_elbow_moves_further_and_the_hand_no_further():
    """Than with all joints stiff."""
    moved, errors = {}, {}
    for kind in (IntegralFeedback, NullspaceCompliance):
        run = ComplianceRun()
        action = run.started(unlimited(9), kind)
        run.go(action, 0.1).go(action, 2.0, push=[0.0, 40.0, 0.0])
        moved[kind], errors[kind] = np.abs(run.q - run.arm.posture).max(), max(run.errors)
    assert moved[NullspaceCompliance] > 2.5 * moved[IntegralFeedback] > 0.1
    assert errors[NullspaceCompliance] < 0.005
    assert errors[NullspaceCompliance] < 1.1 * errors[IntegralFeedback]


@pytest.mark.parametrize("slow", [0.0, 0.1])
def test_a_constant_disturbance_is_integrated_away(slow):
    """Wrong masses. Without forgetting the hand's error goes to zero, else to what theory says."""
    run = ComplianceRun("panda", stiffness=20.0)
    weight = -0.1 * run.terms.h
    run.go(run.started(unlimited(7, gain=6.0, slow_leak_rate=slow)), 5.0, disturbance=weight)
    # At rest s' = slow a + (100 - slow) N a and a_fast = 0.01 s'.
    M, J = run.terms.M, run.terms.J
    K = 6.0 * np.diag(np.diag(M))
    P = np.linalg.solve(M, J.T) @ np.linalg.inv(J @ np.linalg.solve(M, J.T)) @ J
    leak = slow * np.eye(7) + (100.0 - slow) * (np.eye(7) - P)
    a = np.linalg.solve(M @ leak + 0.5 * P.T @ K @ P + 0.5 * K * slow / 100.0, -weight)
    expected = np.linalg.norm(slow * (J @ a)[:3] / 400.0)
    assert run.errors[-1] == pytest.approx(expected, rel=0.03, abs=4e-6)
    without = np.linalg.norm((J @ np.linalg.solve(M, weight))[:3] / 400.0)
    assert expected < 0.2 * without > 4e-4


def test_a_push_that_lasts_does_not_make_it_grow():
    """An arm held off its posture; the law as printed would double its memory."""
    run = ComplianceRun(stiffness=20.0)
    compliance = run.started(unlimited(9))
    half = []
    for _ in range(2):
        run.go(compliance, 1.5, push=[0.0, 30.0, 0.0])
        half.append(np.linalg.norm(compliance.memory.a))
    assert half[1] < 1.1 * half[0]


def test_singular_start():
    """From a stretched-out arm to where the hand is free to move, then holding it there."""
    run = ComplianceRun("panda", q=np.zeros(7))
    assert np.linalg.svd(run.terms.J)[1][-1] < 1e-15
    compliance = run.started(unlimited(7))
    for _ in range(round(1.5 / DT)):
        added = compliance.torque(run.now, run.a_ref, DT)
        run.move(added, a_ref=20.0 * (run.arm.posture - run.q) - 9.0 * run.v)
    assert np.linalg.svd(run.terms.J)[1][-1] > THRESHOLD
    run.hand = run.arm.hand(run.q)
    run.go(compliance, 1.0)
    assert np.abs(run.torques).max() < 15.0
    assert run.errors[-1] < 0.002


def test_its_memories_are_leaky_integrals_of_the_task_s_error():
    """(13), exactly for any step, where J does not change."""
    run = ComplianceRun("panda")
    compliance = run.started(unlimited(7, slow_leak_rate=1.0, fast_leak_rate=8.0))
    slow, fast, s = LeakyIntegrator(1.0, 7), LeakyIntegrator(8.0, 7), np.zeros(7)
    M, J = run.terms.M, run.terms.J
    for k, dt in enumerate((0.3, 0.01, 1.0)):
        a_ref = np.linalg.solve(M, J.T @ np.cos(k + np.arange(6)))  # nothing in the null space
        s = s + a_ref * dt
        compliance.torque(run.now, a_ref, dt)
        a, forgotten = compliance.memory.a, compliance.memory.root / np.sqrt(np.diag(M))
        np.testing.assert_allclose(a, slow.update(s, dt), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(a - forgotten, fast.update(s, dt), rtol=1e-9, atol=1e-9)


# Limits


@given(
    st.integers(0, 2**32 - 1).map(np.random.default_rng),
    st.integers(1, 6),
    st.sampled_from([0.0, 0.01, 1.0, 100.0, np.inf]),
)
@settings(max_examples=80, deadline=None, derandomize=True)
def test_always_finite_and_within_the_budget(rng, m, budget):
    """Any motion, rank and size of J, however sudden: nothing is promised of it but that."""
    n = 7
    budgets = budget * rng.uniform(0.5, 1.0, n) if 0.0 < budget < np.inf else np.full(n, budget)
    law = IntegralSettings(
        budgets,
        mu=rng.choice([0.0, 0.5, 1.0]),
        slow_leak_rate=rng.choice([0.0, 0.1, 2.0]),
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
        tau = compliance.torque(ArmTerms(M, C, J, J_dot, v), a_ref, rng.choice([0.0, 1e-3, 1.0]))
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= budgets).all()
        assert np.isfinite(energy(compliance, M))


def with_memory(seed, **changes):
    """A moving arm, and twice a memory from a random torque."""
    run, rng = ComplianceRun("talos"), np.random.default_rng(seed)
    run.v = 0.5 * rng.normal(size=9)
    run.terms = run.arm.terms(run.q, run.v)
    run.a_ref = run.v.copy()
    torque = np.diag(run.terms.M) * rng.normal(size=9)
    twins = [NullspaceCompliance(unlimited(9, **changes), 6) for _ in range(2)]
    for each in twins:
        each.initialise(torque, run.now)
    return run, *twins


@pytest.mark.parametrize("fast", [0.6, 100.0])
def test_limiting_cuts_the_torque_as_far_as_that_stores_no_more_energy(fast):
    """Mostly only the torque of joints beyond their limits; by (10) all would be scaled."""
    in_part = 0
    for seed in range(40):
        run, wide, tight = with_memory(seed, fast_leak_rate=fast)
        free = wide.torque(run.now, run.a_ref, DT)
        budgets = np.abs(free) * np.random.default_rng(seed).uniform(0.3, 2.0, 9)
        tight.settings = replace(tight.settings, budget=budgets)
        got = tight.torque(run.now, run.a_ref, DT)
        assert not wide.saturated.any()
        assert (np.abs(got) <= budgets).all()
        at_limit = np.abs(got) > (1.0 - 1e-6) * budgets
        assert at_limit.any()
        np.testing.assert_array_equal(tight.saturated, at_limit)
        gained = energy(tight, run.terms.M) / energy(wide, run.terms.M) - 1.0
        assert gained <= 1e-12
        if np.abs(got - np.clip(free, -budgets, budgets)).max() > 1e-9:
            in_part += 1
            assert gained >= -1e-9  # as far as may be
        # Without more error it goes on from there.
        after = tight.torque(run.now, run.a_ref, 0.0)
        np.testing.assert_allclose(after, got, atol=1e-9)
    assert 1 < in_part < 10


def test_it_leaves_its_limits_at_once():
    """A hand that was held off for seconds returns without the swing of an integral wound up."""
    swings = []
    for budget in (np.inf, 3.0):
        run = ComplianceRun("panda")
        compliance = run.started(IntegralSettings(np.full(7, budget)))
        for k in range(round(3.0 / DT)):
            force = run.terms.J[:3].T @ np.array([0.0, 60.0, 0.0]) if k * DT < 2.0 else 0.0
            run.move(compliance.torque(run.now, run.a_ref, DT), disturbance=force)
        assert np.abs(run.torques).max() <= budget
        swings.append(max(run.errors[round(2.3 / DT) :]))
    assert swings[1] < 0.4 * swings[0]


# What can go wrong


def test_of_an_initial_torque_the_task_keeps_what_it_feels():
    run = ComplianceRun("talos")
    compliance = NullspaceCompliance(unlimited(9), 6)
    torque = 5.0 * np.cos(np.arange(9))
    J, M = run.terms.J, run.terms.M
    felt = J @ np.linalg.solve(M, torque)
    first = compliance.initialise(torque, run.now)
    np.testing.assert_allclose(J @ np.linalg.solve(M, first), felt, atol=1e-9)
    for _ in range(round(2.0 / DT)):  # nothing moves, nothing is asked for
        later = compliance.torque(run.now, run.a_ref, DT)
    left = np.exp(-0.1 * 2.0)  # the slow memory leaks
    np.testing.assert_allclose(J @ np.linalg.solve(M, later), left * felt, rtol=0.01, atol=0.01)
    task = J.T @ np.linalg.solve(J @ np.linalg.solve(M, J.T), felt)
    np.testing.assert_allclose(later, left * task, atol=0.02)
    assert np.abs(torque - task).max() > 1.0


def test_starts_from_zero_and_a_pause_is_no_kick():
    run = ComplianceRun()
    run.v = np.ones(9)
    compliance = run.started(unlimited(9))
    np.testing.assert_array_equal(compliance.torque(run.now, run.a_ref, DT), 0.0)
    run.v = np.zeros(9)
    run.go(compliance, 0.3, push=[0.0, 30.0, 0.0])
    before, stored = run.torques[-1], energy(compliance, run.terms.M)
    run.v = run.v + 1.0  # who knows why
    compliance.skip(run.now, 0.2)
    assert energy(compliance, run.terms.M) == pytest.approx(np.exp(-2 * 0.1 * 0.2) * stored)
    after = compliance.torque(run.now, run.a_ref, 0.0)
    assert np.abs(after - before).max() < 0.6 * np.abs(before).max()
    compliance.reset(run.now)
    np.testing.assert_array_equal(compliance.torque(run.now, run.a_ref, 0.0), 0.0)


def test_bad_input_changes_nothing():
    run = ComplianceRun()
    compliance = run.started(unlimited(9))
    run.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
    now, before = run.now, [x.copy() for x in compliance.memory]
    for name in now._fields:
        bad = getattr(now, name).copy()
        bad.flat[0] = np.nan
        with pytest.raises(ValueError, match="finite"):
            compliance.torque(now._replace(**{name: bad}), run.a_ref, DT)
    with pytest.raises(ValueError, match="finite"):
        compliance.torque(now, np.full(9, np.nan), DT)
    for M in (-now.M, 0.0 * now.M):
        with pytest.raises(ValueError, match="positive definite"):
            compliance.torque(now._replace(M=M), run.a_ref, DT)
        with pytest.raises(ValueError, match="positive definite"):
            compliance.initialise(np.ones(9), now._replace(M=M))
    with pytest.raises(ValueError, match="finite"):
        compliance.initialise(np.full(9, np.nan), now)
    with pytest.raises(ValueError, match="v must be"):
        compliance.skip(now._replace(v=np.full(9, np.inf)), DT)
    for x, y in zip(compliance.memory, before, strict=True):
        np.testing.assert_array_equal(x, y)


def test_only_a_task_with_a_null_space_is_served():
    for m in (0, 7, 8):
        message = f"a task of {m} rows for 7 joints; .* 1 to 6 rows"
        with pytest.raises(TaskShapeError, match=message):
            NullspaceCompliance(unlimited(7), m)
    for m in (1, 6):
        run = ComplianceRun("panda", rows=m)
        compliance = run.started(unlimited(7))
        run.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
        assert np.abs(run.terms.J @ compliance.memory.a).max() > 1e-4
