"""Both inverses and their derivatives, against NumPy and finite differences on real arms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from task_arm import TaskArm

from torque_safety_controller.linalg.generalized_inverse import (
    GeneralizedInverseError,
    dynamically_consistent_inverse,
    pseudo_inverse,
)
from torque_safety_controller.linalg.singularity_damping import damping, symmetric_eigen

NEVER = 1e-9
ARMS = ("panda", "baxter_left_arm", "talos")
KINDS = ("pseudo", "consistent")


def inverse(kind, terms, threshold):
    if kind == "pseudo":
        return pseudo_inverse(terms.J, terms.J_dot, threshold)
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
def test_definitions(robot):
    arm = TaskArm(robot)
    for q, v in states(arm, 20):
        terms = arm.terms(q, v)
        plain, consistent = (inverse(kind, terms, NEVER) for kind in KINDS)
        np.testing.assert_allclose(plain.J_plus, np.linalg.pinv(terms.J), atol=1e-8)
        N = np.eye(arm.n) - consistent.J_plus @ terms.J
        size = np.abs(consistent.J_plus).max()
        # Torques in its null space do not accelerate the task.
        torque = N.T @ np.random.default_rng(1).normal(size=arm.n)
        a = terms.J @ np.linalg.solve(terms.M, torque)
        np.testing.assert_allclose(a, 0.0, atol=1e-7 * size)
        for x in (plain, consistent):
            np.testing.assert_allclose(terms.J @ x.J_plus, np.eye(6), atol=1e-8)
            assert not x.damped


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("threshold", [NEVER, 0.1, 0.4, 2.0])
@pytest.mark.parametrize("robot", ARMS)
def test_derivative_is_that_of_what_is_returned(robot, threshold, kind):
    """Central differences along motions, with no, some and all directions damped."""
    arm, h, damped = TaskArm(robot), 1e-5, 0
    for q, v in states(arm, 15):
        x = inverse(kind, arm.terms(q, v), threshold)
        above = inverse(kind, arm.terms(q + h * v, v), threshold)
        below = inverse(kind, arm.terms(q - h * v, v), threshold)
        expected = (above.J_plus - below.J_plus) / (2.0 * h)
        size = np.abs(expected).max()
        assert size > 0.1
        np.testing.assert_allclose(x.J_plus_dot, expected, atol=1e-6 * size)
        damped += x.damped
    if threshold in (NEVER, 2.0):
        assert damped == (15 if threshold == 2.0 else 0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", range(1, 9))
def test_any_number_of_rows(rows, kind):
    arm, h = TaskArm("talos", rows), 1e-5
    for q, v in states(arm, 5):
        x = inverse(kind, arm.terms(q, v), 0.05)
        above, below = (inverse(kind, arm.terms(q + k * v, v), 0.05).J_plus for k in (h, -h))
        expected = (above - below) / (2.0 * h)
        np.testing.assert_allclose(x.J_plus_dot, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("kind", KINDS)
def test_what_damping_leaves_is_exact_in_the_other_directions(kind):
    arm, threshold = TaskArm("talos"), 0.3
    for q, v in states(arm, 20):
        terms = arm.terms(q, v)
        x = inverse(kind, terms, threshold)
        U, singular, _ = np.linalg.svd(terms.J)
        assert singular[-1] < threshold < singular[0]
        D = damping_of(terms.J, threshold)
        W_inv = np.eye(arm.n) if kind == "pseudo" else np.linalg.inv(terms.M)
        c = 1.0 if kind == "pseudo" else arm.n / np.trace(terms.M)
        Y = terms.J @ W_inv @ terms.J.T + c * D
        left_over = np.eye(6) - terms.J @ x.J_plus
        np.testing.assert_allclose(left_over, c * D @ np.linalg.inv(Y), atol=1e-9)
        free = U[:, singular > threshold]
        np.testing.assert_allclose(free.T @ left_over, 0.0, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_above_the_threshold_it_has_no_effect_at_all(kind):
    arm = TaskArm("panda")
    q = arm.posture
    terms = arm.terms(q, np.ones(arm.n))
    smallest = np.linalg.svd(terms.J)[1][-1]
    x, y = inverse(kind, terms, NEVER), inverse(kind, terms, 0.999 * smallest)
    assert not y.damped
    np.testing.assert_array_equal(x.J_plus, y.J_plus)
    np.testing.assert_array_equal(x.J_plus_dot, y.J_plus_dot)
    assert inverse(kind, terms, 1.001 * smallest).damped


@pytest.mark.parametrize("kind", KINDS)
def test_derivative_does_not_jump_at_the_threshold(kind):
    """Seen from both sides of the threshold the difference goes to zero with the distance."""
    arm = TaskArm("panda")
    terms = arm.terms(arm.posture, np.ones(arm.n))
    smallest = np.linalg.svd(terms.J)[1][-1]
    free = inverse(kind, terms, NEVER).J_plus_dot
    jumps = [
        np.abs(inverse(kind, terms, smallest * (1.0 + d)).J_plus_dot - free).max()
        for d in (1e-2, 1e-3, 1e-4)
    ]
    assert jumps[0] > 0.0
    assert jumps[1] < 0.2 * jumps[0] and jumps[2] < 0.2 * jumps[1]


def test_derivative_where_singular_values_meet():
    """Two equal ones below the threshold, of which no eigenvector is a smooth function of time."""
    rng = np.random.default_rng(2)
    J = 0.1 * np.linalg.qr(rng.normal(size=(5, 5)))[0][:3]
    J_dot, h = rng.normal(size=J.shape), 1e-6
    x = pseudo_inverse(J, J_dot, 0.2)
    above, below = (pseudo_inverse(J + k * J_dot, J_dot, 0.2).J_plus for k in (h, -h))
    expected = (above - below) / (2.0 * h)
    np.testing.assert_allclose(x.J_plus_dot, expected, rtol=1e-6, atol=1e-6)


matrices = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@given(matrices, st.integers(1, 8), st.integers(0, 8), st.floats(-12.0, 3.0))
@settings(max_examples=200, deadline=None)
def test_gain_is_bounded_whatever_the_rank(rng, m, rank, exponent):
    """|J^+| < 1.07 / threshold; the other in the mass matrix's norm, as the docs derive."""
    n, threshold = 9, 0.05
    rank = min(rank, m)
    J = rng.normal(size=(m, rank)) @ rng.normal(size=(rank, n)) * 10.0**exponent
    J_dot = rng.normal(size=(m, n))
    A = rng.normal(size=(n, n))
    M = A @ A.T + 0.01 * np.eye(n)
    plain = pseudo_inverse(J, J_dot, threshold)
    assert np.linalg.norm(plain.J_plus, 2) < 1.07 / threshold
    assert np.isfinite(plain.J_plus_dot).all()
    consistent = dynamically_consistent_inverse(J, J_dot, M, A + A.T, threshold)
    assert np.isfinite(consistent.J_plus_dot).all()
    root = np.linalg.cholesky(M).T
    size = np.linalg.norm(root @ consistent.J_plus, 2)
    assert size < 1.16 / threshold * np.sqrt(np.trace(M))


@given(matrices, st.integers(1, 12), st.booleans())
@settings(max_examples=100, deadline=None)
def test_eigenvectors_against_numpy(rng, m, degenerate):
    A = rng.normal(size=(m, m))
    G = A @ A.T
    if degenerate:
        Q = np.linalg.qr(A)[0]
        G = Q @ np.diag(rng.integers(0, 3, m).astype(float)) @ Q.T
        G = 0.5 * (G + G.T)
    g, U = symmetric_eigen(G)
    size = max(np.abs(G).max(), 1e-300)
    np.testing.assert_allclose(np.sort(g), np.linalg.eigvalsh(G), atol=1e-13 * m * size)
    np.testing.assert_allclose(U @ U.T, np.eye(m), atol=1e-13 * m)
    np.testing.assert_allclose(U @ np.diag(g) @ U.T, G, atol=1e-13 * m * size)


def test_damping_and_its_derivative_by_numpy():
    rng, threshold, h = np.random.default_rng(4), 1.0, 1e-6
    for _ in range(20):
        J, J_dot = rng.normal(size=(4, 6)) * 0.5, rng.normal(size=(4, 6))
        D, D_dot = damping(J @ J.T, J_dot @ J.T + J @ J_dot.T, threshold)
        np.testing.assert_allclose(D, damping_of(J, threshold), atol=1e-12)
        above, below = (damping_of(J + k * J_dot, threshold) for k in (h, -h))
        np.testing.assert_allclose(D_dot, (above - below) / (2.0 * h), atol=1e-7)


@pytest.mark.parametrize("m, n", [(7, 7), (8, 7), (0, 7)])
def test_a_task_without_null_space_is_refused(m, n):
    with pytest.raises(GeneralizedInverseError, match=rf"{m} rows for {n} joints; .* 1 to 6 rows"):
        pseudo_inverse(np.zeros((m, n)), np.zeros((m, n)))


@pytest.mark.parametrize("threshold", [0.0, -1.0, np.inf, np.nan])
def test_a_useless_threshold_is_refused(threshold):
    with pytest.raises(GeneralizedInverseError, match="threshold = .* must be positive"):
        pseudo_inverse(np.eye(2, 3), np.eye(2, 3), threshold)


def test_bad_matrices_are_refused():
    J, M = np.eye(2, 3), np.eye(3)
    with pytest.raises(GeneralizedInverseError, match=r"J_dot \(3, 2\)"):
        pseudo_inverse(J, J.T)
    with pytest.raises(GeneralizedInverseError, match=r"M \(2, 2\)"):
        dynamically_consistent_inverse(J, J, np.eye(2), np.eye(2))
    for bad in (-M, np.zeros((3, 3)), np.full((3, 3), np.nan)):
        with pytest.raises(GeneralizedInverseError, match="positive definite"):
            dynamically_consistent_inverse(J, J, bad, M)
    with pytest.raises(GeneralizedInverseError, match="finite"):
        pseudo_inverse(J, np.full((2, 3), np.nan))
    with pytest.raises(GeneralizedInverseError, match="finite"):
        pseudo_inverse(np.full((2, 3), np.nan), J)
