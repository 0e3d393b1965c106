# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance: the torque's limits, and changes of settings without jumps."""

from dataclasses import replace

import numpy as np
import pytest
from compliance_run import DT, ComplianceRun, energy, hand_errors, started, unlimited
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.nullspace import NullspaceCompliance

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
    """A moving arm and a memory from a random torque."""
    run, rng = ComplianceRun("talos"), np.random.default_rng(seed)
    run.v = 0.5 * rng.normal(size=9)
    run.terms = run.arm.terms(run.q, run.v)
    run.a_ref = run.v.copy()
    compliance = NullspaceCompliance(unlimited(9), 6)
    compliance.initialise(np.diag(run.terms.M) * rng.normal(size=9), run.now)
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


# Initialising


def test_the_task_keeps_its_torque():
    run = ComplianceRun("talos")
    compliance = NullspaceCompliance(unlimited(9), 6)
    torque = 5.0 * np.cos(np.arange(9))
    J, M = run.terms.J, run.terms.M
    felt = J @ np.linalg.solve(M, torque)
    first = compliance.initialise(torque, run.now)
    np.testing.assert_allclose(J @ np.linalg.solve(M, first), felt, atol=1e-9)
    for _ in range(round(2.0 / DT)):  # nothing moves, nothing is asked for
        later = compliance.torque(*run.arguments())
    left = np.exp(-0.1 * 2.0)  # the slow memory leaks
    np.testing.assert_allclose(J @ np.linalg.solve(M, later), left * felt, rtol=0.01, atol=0.01)
    task = J.T @ np.linalg.solve(J @ np.linalg.solve(M, J.T), felt)
    np.testing.assert_allclose(later, left * task, atol=0.02)
    assert np.abs(torque - task).max() > 1.0


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
    held = compliance.initialise(last, run.now)
    if "budget" in changes:
        assert (np.abs(held) <= 0.1).all()
    elif changes != {"mu": 1.0}:  # which leaves no slow memory
        # The task feels the same, but for what the motion adds.
        felt, lost = (run.terms.J @ np.linalg.solve(run.terms.M, x) for x in (last, held - last))
        assert np.linalg.norm(lost) < 0.15 * np.linalg.norm(felt)
    run.move(last, **push)
    run.go(compliance, 0.02, **push)
    assert np.abs(np.diff([held, *run.torques[-10:]], axis=0)).max() < 2.0 * usual + 0.05
