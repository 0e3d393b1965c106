# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for the friction of one joint, with the model's errors eliminated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]

_PIECE = 0.25  # s; residuals of one such piece count as one
_RANK = 1e-7  # singular values of the model's error below this share are rounding
_HUBER = 1.345  # standard deviations up to which a residual counts in full


class JointRegression:
    """Averaged blocks of one joint, and the regression on them.

    Args:
        samples: of the velocity, shape (B, m), rad/s.
        direction: of it, shape (B,), 1 or -1.
        t: middle of the blocks, shape (B,), s.
        beyond: torque beyond the model's, shape (B,), N m.
        errors: columns that errors of the model explain, shape (B, k).

    Attributes:
        weights: square roots of what each block counts, shape (B,).
    """

    def __init__(
        self, samples: Array, direction: Array, t: Array, beyond: Array, errors: Array
    ) -> None:
        self._samples, self._direction, self._beyond = samples, direction, beyond
        sizes = np.linalg.norm(errors, axis=0)
        columns = errors[:, sizes > 0.0] / sizes[sizes > 0.0]
        U, size, _ = np.linalg.svd(columns, full_matrices=False)
        self._errors = U[:, size > _RANK * size[0]]
        self._pieces = np.unique((t / _PIECE).astype(int), return_inverse=True)[1]
        self._weigh(np.ones(len(beyond)))

    def _weigh(self, weights: Array) -> None:
        self.weights = weights
        self._basis = np.linalg.qr(weights[:, None] * self._errors)[0]
        self._y = self.reduce(self._beyond)

    @property
    def unknowns(self) -> int:
        """How many numbers are fitted."""
        return int(self._basis.shape[1]) + 4

    def reduce(self, columns: Array) -> Array:
        """Return what the errors of the model leave of weighted columns, shape (B, ...)."""
        columns = (self.weights * columns.T).T
        return columns - self._basis @ (self._basis.T @ columns)

    def left(self, column: Array) -> float:
        """Return the share of a column's square that the errors of the model leave."""
        size = np.linalg.norm(self.weights * column)
        return float((np.linalg.norm(self.reduce(column)) / size) ** 2)

    def slower(self, speed: float) -> int:
        """Return how many blocks are slower than that, rad/s."""
        return int((np.abs(self._samples.mean(axis=1)) < speed).sum())

    def columns(self, v_s: float) -> Array:
        """Return what F_c, F_s - F_c and d are multiplied by, block by block, shape (B, 3)."""
        falling = np.exp(-((self._samples / v_s) ** 2)).mean(axis=1)
        return np.column_stack(
            [self._direction, self._direction * falling, self._samples.mean(axis=1)]
        )

    def solve(self, v_s: float, kept: Sequence[int] = (0, 1, 2)) -> tuple[float, Array]:
        """Return the least sum of squares with coefficients >= 0, and them, shape (3,)."""
        columns, x = list(kept), np.zeros(3)
        x[columns], residual = nnls(self.reduce(self.columns(v_s)[:, columns]), self._y)
        return float(residual) ** 2, x

    def reweight(self, v_s: float, x: Array) -> None:
        """Reduce the weight of blocks with large residuals: Huber's weights."""
        columns = self.columns(v_s)
        residual = (self._y - self.reduce(columns) @ x) / self.weights
        size = 1.4826 * float(np.median(np.abs(residual))) + 1e-12
        self._weigh(np.sqrt(np.minimum(1.0, _HUBER * size / (np.abs(residual) + 1e-300))))

    def standard_errors(self, v_s: float, x: Array, kept: Sequence[int]) -> tuple[Array, float]:
        """Return those of F_c, F_s - F_c, d, v_s and F_s, shape (5,), and the residual's size."""
        X = self.columns(v_s)
        residual = self._y - self.reduce(X) @ x
        columns = [X[:, k] for k in kept]
        if 1 in kept:
            step = 1e-3 * v_s
            change = (self.columns(v_s + step) - self.columns(v_s - step))[:, 1] / (2.0 * step)
            columns.append(x[1] * change)
        J = self.reduce(np.column_stack(columns))
        inverse = np.linalg.pinv(J.T @ J)
        scores = np.zeros((self._pieces.max() + 1, J.shape[1]))
        np.add.at(scores, self._pieces, J * residual[:, None])
        freedom = len(residual) / max(len(residual) - self.unknowns, 1)
        covariance = freedom * inverse @ (scores.T @ scores) @ inverse
        errors = np.full(5, np.nan)
        places = [*kept, 3] if 1 in kept else list(kept)
        errors[places] = np.sqrt(np.diag(covariance))
        errors[4] = errors[0]
        if 0 in kept and 1 in kept:
            i, j = places.index(0), places.index(1)
            errors[4] = np.sqrt(max(covariance[i, i] + covariance[j, j] + 2 * covariance[i, j], 0))
        plain = residual / self.weights
        return errors, float(np.sqrt(freedom * np.mean(plain**2)))
