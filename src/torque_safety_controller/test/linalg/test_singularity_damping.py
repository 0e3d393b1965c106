# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from torque_safety_controller.linalg.singularity_damping import is_positive_definite


@pytest.mark.parametrize("n", [1, 2, 6, 9])
def test_a_positive_definite_matrix_has_the_factor_that_numpy_finds(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n + 2))
    A = A @ A.T
    L = A.copy()
    assert is_positive_definite(L)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(A), rtol=1e-12, atol=1e-13)


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
    assert not is_positive_definite(A.copy())
