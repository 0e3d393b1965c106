"""Anti-windup of null-space compliance: limits of its torque, kept by its memory; compiled.

The torque is linear in the memory and the energy is quadratic, so that a memory which gives less
torque and stores less energy can be found at once. `docs/nullspace_compliance.md` says how that
compares with (10) and (11) of [Benallegue2021].
"""

from __future__ import annotations

import math

import numpy as np

from torque_safety_controller.nullspace.law import Law, Terms, energy_product, law_torque, split
from viability_bounds_pkg.compiled import compiled


@compiled
def keep_within(
    law: Law,
    terms: Terms,
    limit: np.ndarray,
    s: np.ndarray,
    integral: np.ndarray,
    a: np.ndarray,
    x: np.ndarray,
    tau: np.ndarray,
) -> bool:
    """Change memory and torque such that |tau| <= limit and no energy is added; in place.

    Scaling all of the memory by (10) does both, but weakens every joint for the sake of one. So
    a is changed such that only the torques beyond their limits change, to the limits. If that
    stores more energy than before, it is done in part: the memory is the furthest point on the
    way from the scaled one that does not. Both ends are within the limits, and with them the way.

    Args:
        law: settings.
        terms: of the robot.
        limit: shape (n,), >= 0, may be infinite.
        s: memory as `law_torque` takes it, changed.
        integral: likewise.
        a: likewise.
        x: likewise.
        tau: its torque, shape (n,), changed.

    Returns:
        Whether anything had to be changed.
    """
    scale = _scale(tau, limit)
    if not scale < 1.0:
        return False
    n = len(a)
    cut = np.empty(n)
    for i in range(n):
        cut[i] = min(max(tau[i], -limit[i]), limit[i]) - tau[i]
    shift = cut.copy()
    way = 0.0
    if _eliminate(torque_matrix(law, terms), shift):
        way = _way(law, terms.M, a, x, scale, shift)
    else:
        shift[:] = 0.0
    shift_s, shift_integral = split(law, terms, shift)
    keep = scale + way * (1.0 - scale)
    for i in range(n):
        s[i] = keep * s[i] + way * shift_s[i]
        a[i] = keep * a[i] + way * shift[i]
        x[i] = keep * x[i]
        t = keep * tau[i] + way * cut[i]
        tau[i] = min(max(t, -limit[i]), limit[i])
    for i in range(len(integral)):
        integral[i] = keep * integral[i] + way * shift_integral[i]
    return True


@compiled
def torque_matrix(law: Law, terms: Terms) -> np.ndarray:
    """Return how the torque depends on a, shape (n, n): C, K or (26), and what J' adds."""
    m, n = terms.J.shape
    L, unit, none = np.empty((n, n)), np.zeros(n), np.zeros(n)
    for i in range(n):
        unit[i] = 1.0
        s, integral = split(law, terms, unit)
        L[:, i] = law_torque(law, terms, s, integral, unit, none)
        unit[i] = 0.0
    return L


@compiled
def _scale(tau: np.ndarray, limit: np.ndarray) -> float:
    """Return the factor of eq. (10): the largest up to 1 that brings `tau` within its limits."""
    factor = 1.0
    for i in range(len(tau)):
        if abs(tau[i]) > limit[i]:
            factor = min(factor, limit[i] / abs(tau[i]))
    return factor


@compiled
def _way(
    law: Law, M: np.ndarray, a: np.ndarray, x: np.ndarray, scale: float, shift: np.ndarray
) -> float:
    """Return how far from (scale a, scale x) to (a + shift, x) the energy is that of (a, x)."""
    da, dx = (1.0 - scale) * a + shift, (1.0 - scale) * x
    spare = (1.0 - scale * scale) * energy_product(law, M, a, x, a, x)
    linear = scale * energy_product(law, M, a, x, da, dx)
    square = energy_product(law, M, da, dx, da, dx)
    if square + 2.0 * linear <= spare:
        return 1.0
    root = math.sqrt(linear * linear + square * spare)
    return spare / (linear + root) if linear > 0.0 else (root - linear) / square


@compiled
def _eliminate(A: np.ndarray, b: np.ndarray) -> bool:
    """Replace `b`, shape (n,), by ``A^-1 b``; A, shape (n, n), is overwritten.

    Returns:
        False, with `b` undefined, when A is numerically singular.
    """
    n = len(b)
    smallest = 1e-12 * np.abs(A).max()
    for j in range(n):
        pivot = j
        for i in range(j + 1, n):
            if abs(A[i, j]) > abs(A[pivot, j]):
                pivot = i
        if not abs(A[pivot, j]) > smallest:
            return False
        for k in range(n):
            A[j, k], A[pivot, k] = A[pivot, k], A[j, k]
        b[j], b[pivot] = b[pivot], b[j]
        for i in range(j + 1, n):
            factor = A[i, j] / A[j, j]
            for k in range(j, n):
                A[i, k] -= factor * A[j, k]
            b[i] -= factor * b[j]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    return True
