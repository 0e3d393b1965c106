# SPDX-License-Identifier: Apache-2.0
"""The inverse and its derivative, against NumPy and finite differences on real arms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm

from torque_safety_controller.integral_feedback.task_inverse import (
    dynamically_consistent_inverse,
)

NEVER = 1e-9


def inverse(terms, threshold):
    """J^+ and its derivative."""
    return dynamically_consistent_inverse(
        terms.J, terms.J_dot, terms.M, terms.C + terms.C.T, threshold
    )


def states(arm, count):
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield arm.posture + rng.uniform(-0.5, 0.5, arm.n), rng.normal(size=arm.n)


@pytest.mark.parametrize("robot", ["panda", "talos"])
def test_torques_in_its_null_space_do_not_accelerate_the_task(robot):
    arm = TaskArm(robot)
    for q, v in states(arm, 10):
        terms = arm.terms(q, v)
        J_plus, _ = inverse(terms, NEVER)
        N = np.eye(arm.n) - J_plus @ terms.J
        torque = N.T @ np.random.default_rng(1).normal(size=arm.n)
        a = terms.J @ np.linalg.solve(terms.M, torque)
        np.testing.assert_allclose(a, 0.0, atol=1e-7 * np.abs(J_plus).max())
        np.testing.assert_allclose(terms.J @ J_plus, np.eye(6), atol=1e-8)


@pytest.mark.parametrize("threshold", [NEVER, 0.1, 0.4, 2.0])
@pytest.mark.parametrize(("robot", "rows"), [("panda", 6), ("talos", 1), ("talos", 8)])
def test_derivative_is_that_of_what_is_returned(robot, rows, threshold):
    """Central differences along motions, with no, some and all directions damped."""
    arm, h, damped = TaskArm(robot, rows), 1e-5, 0
    for q, v in states(arm, 8):
        terms = arm.terms(q, v)
        J_plus_dot = inverse(terms, threshold)[1]
        above, below = (inverse(arm.terms(q + k * v, v), threshold)[0] for k in (h, -h))
        expected = (above - below) / (2.0 * h)
        np.testing.assert_allclose(J_plus_dot, expected, atol=1e-6 * np.abs(expected).max())
        damped += np.linalg.svd(terms.J)[1][-1] <= threshold
    if threshold in (NEVER, 2.0):
        assert damped == (8 if threshold == 2.0 else 0)


def test_what_damping_leaves_is_exact_in_the_other_directions():
    arm, threshold = TaskArm("talos"), 0.3
    for q, v in states(arm, 10):
        terms = arm.terms(q, v)
        J_plus, _ = inverse(terms, threshold)
        U, singular, _ = np.linalg.svd(terms.J)
        assert singular[-1] < threshold < singular[0]
        h = np.maximum(threshold**2 - singular**2, 0.0) ** 2 / threshold**2
        D = arm.n / np.trace(terms.M) * U @ np.diag(h) @ U.T
        Y = terms.J @ np.linalg.inv(terms.M) @ terms.J.T + D
        left_over = np.eye(6) - terms.J @ J_plus
        np.testing.assert_allclose(left_over, D @ np.linalg.inv(Y), atol=1e-9)
        free = U[:, singular > threshold]
        np.testing.assert_allclose(free.T @ left_over, 0.0, atol=1e-10)


def test_damping_begins_at_the_threshold_without_a_jump():
    arm = TaskArm("panda")
    terms = arm.terms(arm.posture, np.ones(arm.n))
    smallest = np.linalg.svd(terms.J)[1][-1]
    free = inverse(terms, NEVER)
    np.testing.assert_array_equal(inverse(terms, 0.999 * smallest), free)
    # From the other side the difference of the derivative goes to zero with the distance.
    far, near, nearest = (
        np.abs(inverse(terms, smallest * (1.0 + d))[1] - free[1]).max() for d in (1e-2, 1e-3, 1e-4)
    )
    assert far > 0.0
    assert near < 0.2 * far
    assert nearest < 0.2 * near


@given(
    st.integers(0, 2**32 - 1).map(np.random.default_rng),
    st.integers(1, 8),
    st.integers(0, 8),
    st.floats(-12.0, 3.0),
)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_gain_is_bounded_whatever_the_rank(rng, m, rank, exponent):
    """|M^(1/2) J^+| < 1.16 / threshold sqrt(tr M), as docs/theory/nullspace.md derives."""
    n, threshold = 9, 0.05
    rank = min(rank, m)
    J = rng.normal(size=(m, rank)) @ rng.normal(size=(rank, n)) * 10.0**exponent
    J_dot = rng.normal(size=(m, n))
    A = rng.normal(size=(n, n))
    M = A @ A.T + 0.01 * np.eye(n)
    J_plus, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, A + A.T, threshold)
    assert np.isfinite(J_plus_dot).all()
    size = np.linalg.norm(np.linalg.cholesky(M).T @ J_plus, 2)
    assert size < 1.16 / threshold * np.sqrt(np.trace(M))
