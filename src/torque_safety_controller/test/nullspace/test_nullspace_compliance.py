# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance of simulated arms: what it is for, its limits, and what it refuses."""

import numpy as np
import pytest
from compliance_run import DT, ComplianceRun, energy, hand_errors, started, unlimited
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm

from torque_safety_controller.integral_feedback import (
    IntegralFeedback,
)
from torque_safety_controller.integral_feedback.nullspace import (
    NullspaceCompliance,
    TaskShapeError,
)
from torque_safety_controller.integral_feedback.nullspace_step import THRESHOLD, torque_matrix

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
    K = 2.0 * np.diag(M)
    # At rest: neither C nor J'.
    H = torque_matrix(J, 0.0 * J, M, 0.0 * M, 2.0, mu, J_plus, 0.0 * J_plus)
    np.testing.assert_allclose(H, H.T, atol=1e-12 * np.abs(H).max())
    P = J_plus @ J
    expected = (1.0 - mu) * P.T @ np.diag(K) @ P + mu * np.diag(K)
    # And in motion it is (21) with (26).
    C, J_dot = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    rates, a = rng.normal(size=(n, m)), rng.normal(size=n)
    found = torque_matrix(J, J_dot, M, C, 2.0, mu, J_plus, rates) @ a
    s, integral = a - P @ a, -J @ a
    torque = C @ a - M @ (J_plus @ J_dot @ s + rates @ integral) + expected @ a
    np.testing.assert_allclose(found, torque, atol=1e-11 * np.abs(torque).max())
    np.testing.assert_allclose(H, expected, atol=1e-12 * H.max())
    smallest = np.linalg.eigvalsh(H)[0]
    assert smallest >= -1e-12 * H.max()
    if mu > 0.1:
        assert smallest > 0.9 * mu * K.min()


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
    with pytest.raises(ValueError, match="finite"):
        compliance.torque(now, np.full(9, np.nan), DT)
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
    with pytest.raises(TaskShapeError, match=f"a task of {m} rows for 7 joints; .* 1 to 6 rows"):
        NullspaceCompliance(unlimited(7), m)


@pytest.mark.parametrize("m", range(1, 7))
def test_any_task_with_a_null_space_is_served(m):
    run = ComplianceRun("panda", rows=m)
    compliance = started(run, unlimited(7), m)
    run.go(compliance, 0.1, push=[0.0, 30.0, 0.0])
    assert np.abs(run.terms.J @ compliance.memory.a).max() > 1e-4
    assert np.isfinite(run.torques).all()
