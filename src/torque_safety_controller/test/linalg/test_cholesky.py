# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from torque_safety_controller.linalg.cholesky import factorise, solve


@pytest.mark.parametrize("n", [1, 2, 6, 9])
def test_a_positive_definite_matrix_has_the_factor_that_numpy_finds_and_solves_by_it(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n + 2))
    A = A @ A.T
    L = A.copy()
    assert factorise(L)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(A), rtol=1e-12, atol=1e-13)
    x = rng.normal(size=(n, 3))
    B = A @ x
    solve(L, B)
    np.testing.assert_allclose(B, x, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "A",
    [
        np.zeros((2, 2)),
        np.diag([1.0, -1.0]),
        np.ones((3, 3)),
        np.diag([1.0, np.nan]),
        np.diag([np.inf, 1.0]),
    ],
    ids=["zero", "indefinite", "singular", "nan", "infinite"],
)
def test_what_is_not_positive_definite_is_told(A):
    assert not factorise(A.copy())
