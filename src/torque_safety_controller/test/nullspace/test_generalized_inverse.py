# SPDX-License-Identifier: Apache-2.0
"""The inverse and its derivative, against NumPy and finite differences on real arms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm

from torque_safety_controller.integral_feedback.nullspace_step import (
    damping,
    dynamically_consistent_inverse,
)

NEVER = 1e-9
ARMS = ("panda", "baxter_left_arm", "talos")


def inverse(terms, threshold):
    """J^+ and its derivative."""
    return dynamically_consistent_inverse(
        terms.J, terms.J_dot, terms.M, terms.C + terms.C.T, threshold
    )


def states(arm, count, seed=0, spread=0.5):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield arm.posture + rng.uniform(-spread, spread, arm.n), rng.normal(size=arm.n)


def damping_of(J, threshold):
    """D by NumPy's eigenvectors."""
    g, U = np.linalg.eigh(J @ J.T)
    return U @ np.diag(np.maximum(threshold**2 - g, 0.0) ** 2 / threshold**2) @ U.T


@pytest.mark.parametrize("robot", ARMS)
def test_definition(robot):
    arm = TaskArm(robot)
    for q, v in states(arm, 20):
        terms = arm.terms(q, v)
        J_plus, _ = inverse(terms, NEVER)
        N = np.eye(arm.n) - J_plus @ terms.J
        # Torques in its null space do not accelerate the task.
        torque = N.T @ np.random.default_rng(1).normal(size=arm.n)
        a = terms.J @ np.linalg.solve(terms.M, torque)
        np.testing.assert_allclose(a, 0.0, atol=1e-7 * np.abs(J_plus).max())
        np.testing.assert_allclose(terms.J @ J_plus, np.eye(6), atol=1e-8)


@pytest.mark.parametrize("threshold", [NEVER, 0.1, 0.4, 2.0])
@pytest.mark.parametrize("robot", ARMS)
def test_derivative_is_that_of_what_is_returned(robot, threshold):
    """Central differences along motions, with no, some and all directions damped."""
    arm, h, damped = TaskArm(robot), 1e-5, 0
    for q, v in states(arm, 15):
        terms = arm.terms(q, v)
        J_plus_dot = inverse(terms, threshold)[1]
        above, below = (inverse(arm.terms(q + k * v, v), threshold)[0] for k in (h, -h))
        expected = (above - below) / (2.0 * h)
        size = np.abs(expected).max()
        assert size > 0.1
        np.testing.assert_allclose(J_plus_dot, expected, atol=1e-6 * size)
        damped += np.linalg.svd(terms.J)[1][-1] <= threshold
    if threshold in (NEVER, 2.0):
        assert damped == (15 if threshold == 2.0 else 0)


@pytest.mark.parametrize("rows", range(1, 9))
def test_any_number_of_rows(rows):
    arm, h = TaskArm("talos", rows), 1e-5
    for q, v in states(arm, 5):
        _, J_plus_dot = inverse(arm.terms(q, v), 0.05)
        above, below = (inverse(arm.terms(q + k * v, v), 0.05)[0] for k in (h, -h))
        expected = (above - below) / (2.0 * h)
        np.testing.assert_allclose(J_plus_dot, expected, atol=1e-6 * np.abs(expected).max())


def test_what_damping_leaves_is_exact_in_the_other_directions():
    arm, threshold = TaskArm("talos"), 0.3
    for q, v in states(arm, 20):
        terms = arm.terms(q, v)
        J_plus, _ = inverse(terms, threshold)
        U, singular, _ = np.linalg.svd(terms.J)
        assert singular[-1] < threshold < singular[0]
        D = arm.n / np.trace(terms.M) * damping_of(terms.J, threshold)
        Y = terms.J @ np.linalg.inv(terms.M) @ terms.J.T + D
        left_over = np.eye(6) - terms.J @ J_plus
        np.testing.assert_allclose(left_over, D @ np.linalg.inv(Y), atol=1e-9)
        free = U[:, singular > threshold]
        np.testing.assert_allclose(free.T @ left_over, 0.0, atol=1e-10)


def test_above_the_threshold_it_has_no_effect_at_all():
    arm = TaskArm("panda")
    terms = arm.terms(arm.posture, np.ones(arm.n))
    smallest = np.linalg.svd(terms.J)[1][-1]
    x, y = inverse(terms, NEVER), inverse(terms, 0.999 * smallest)
    np.testing.assert_array_equal(x[0], y[0])
    np.testing.assert_array_equal(x[1], y[1])
    assert not np.array_equal(x[0], inverse(terms, 1.001 * smallest)[0])


def test_derivative_does_not_jump_at_the_threshold():
    """Seen from both sides of the threshold the difference goes to zero with the distance."""
    arm = TaskArm("panda")
    terms = arm.terms(arm.posture, np.ones(arm.n))
    smallest = np.linalg.svd(terms.J)[1][-1]
    free = inverse(terms, NEVER)[1]
    jumps = [
        np.abs(inverse(terms, smallest * (1.0 + d))[1] - free).max() for d in (1e-2, 1e-3, 1e-4)
    ]
    assert jumps[0] > 0.0
    assert jumps[1] < 0.2 * jumps[0] and jumps[2] < 0.2 * jumps[1]


def test_derivative_where_singular_values_meet():
    """Two equal ones below the threshold, of which no eigenvector is a smooth function of time."""
    rng = np.random.default_rng(2)
    J = np.ascontiguousarray(0.1 * np.linalg.qr(rng.normal(size=(5, 5)))[0][:3])
    J_dot, M, h = rng.normal(size=J.shape), np.eye(5), 1e-6
    _, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, 0.0 * M, 0.2)
    above, below = (
        dynamically_consistent_inverse(J + k * J_dot, J_dot, M, 0.0 * M, 0.2)[0] for k in (h, -h)
    )
    expected = (above - below) / (2.0 * h)
    np.testing.assert_allclose(J_plus_dot, expected, rtol=1e-6, atol=1e-6)


matrices = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@given(matrices, st.integers(1, 8), st.integers(0, 8), st.floats(-12.0, 3.0))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_gain_is_bounded_whatever_the_rank(rng, m, rank, exponent):
    """|M^(1/2) J^+| < 1.16 / threshold sqrt(tr M), as the docs derive."""
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


def test_damping_and_its_derivative_by_numpy():
    rng, threshold, h = np.random.default_rng(4), 1.0, 1e-6
    for _ in range(20):
        J, J_dot = rng.normal(size=(4, 6)) * 0.5, rng.normal(size=(4, 6))
        D, D_dot = damping(J @ J.T, J_dot @ J.T + J @ J_dot.T, threshold)
        np.testing.assert_allclose(D, damping_of(J, threshold), atol=1e-12)
        above, below = (damping_of(J + k * J_dot, threshold) for k in (h, -h))
        np.testing.assert_allclose(D_dot, (above - below) / (2.0 * h), atol=1e-7)


def test_what_is_no_mass_matrix_is_refused():
    J, M = np.eye(2, 3), np.eye(3)
    for bad in (np.zeros((3, 3)), np.full((3, 3), np.nan)):
        with pytest.raises(np.linalg.LinAlgError):
            dynamically_consistent_inverse(J, J, bad, M, 0.03)
