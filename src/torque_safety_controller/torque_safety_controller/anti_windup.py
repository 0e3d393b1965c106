# SPDX-License-Identifier: Apache-2.0
"""Limits on the integral torque that keep it dissipative: eq. (10) and (11), [Benallegue2021].

The integral torque u = K s is to stay within limits u_max, and to take energy out of s all the
same: s'u > 0. Both ways leave alone what is within the limits:

- `scale_to_limits`, eq. (10), scales the whole vector by lambda_w;
- `project_to_limits`, eq. (11), takes the nearest vector within the limits that dissipates, in
  s'x, no less than (10) does.

For the K of the control step, lambda diag(M), (11) is the clip of each component by itself;
`docs/integral_action.md` proves it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_TINY = 1e-300  # for 0, so that it can be divided by


def scale_to_limits(u: ArrayLike, u_max: ArrayLike) -> Array:
    """Return ``lambda_w u``, shape (n,), N m: eq. (10), [Benallegue2021].

    lambda_w = min(1, min_i u_max_i / |u_i|). Where u_i is 0 it is not limited, even by
    u_max_i = 0. No component is beyond its limit, not even by rounding.

    Args:
        u: shape (n,), N m.
        u_max: limits, shape (n,), N m, >= 0; inf for none.

    Raises:
        ValueError: wrong shapes, u not finite, or limits negative or NaN.
    """
    u, u_max = _checked(u_max, u=u)
    return clip(scale_factor(u, u_max) * u, u_max)


def project_to_limits(u: ArrayLike, s: ArrayLike, u_max: ArrayLike) -> Array:
    """Solve the QP of eq. (11), [Benallegue2021].

        minimise  |x - u|^2   subject to   -u_max <= x <= u_max,   s'x >= lambda_w s'u.

    It always has a solution, as lambda_w u fulfils both. The limits hold exactly; the inequality
    holds to rounding, 1e-14 of sum_i |s_i| (|x_i| + |u_i|); x is exact to 1e-12 of the largest
    |u_i| where the s_i are of like size, and loses a digit for each power of ten between those
    whose joints are within their limits and the largest.

    Args:
        u: shape (n,), N m; K s in the paper, but any vector will do.
        s: shape (n,), rad/s; only its direction matters.
        u_max: limits, shape (n,), N m, >= 0; inf for none.

    Returns:
        x, shape (n,), N m.

    Raises:
        ValueError: wrong shapes, u or s not finite, or limits negative or NaN.
    """
    u, s, u_max = _checked(u_max, u=u, s=s)
    return project(u, s, u_max)


def project(u: Array, s: Array, u_max: Array) -> Array:
    """Solve the QP of eq. (11); see `project_to_limits`, which checks the arguments first."""
    # Scaled to about 1, products of very large or small numbers stay numbers.
    unit = max(float(np.abs(u).max()), _TINY)
    s = np.where(u_max > 0.0, s, 0.0)  # it has no say where x is 0
    s = s / max(float(np.abs(s).max()), _TINY)
    u, limits = u / unit, u_max / unit
    x = nearest_dissipating(u, s, limits, scale_factor(u, limits) * float(s @ u))
    return clip(unit * x, u_max)


def scale_factor(u: Array, u_max: Array) -> float:
    """Return lambda_w of eq. (10); see `scale_to_limits`."""
    beyond = np.abs(u) > u_max
    return float((u_max[beyond] / np.abs(u[beyond])).min(initial=1.0))


@njit(cache=True)
def clip(u: Array, u_max: Array) -> Array:
    """Return `u` with each component cut to its limit, shape (n,)."""
    return np.minimum(np.maximum(u, -u_max), u_max)


@njit(cache=True)
def nearest_dissipating(u: Array, s: Array, u_max: Array, level: float) -> Array:
    """Return the point nearest to `u` with |x| <= u_max and s'x >= level, shape (n,).

    It is ``x(nu) = clip(u + nu s)`` for the least nu >= 0 with s'x(nu) >= level. s'x(nu) never
    falls, and is linear between the values of nu at which a component leaves one limit or
    arrives at the other. The two of those values next to the solution are found by trying them
    all; between them the components that are free move together.

    Args:
        u: shape (n,).
        s: shape (n,), of size 1 or so.
        u_max: shape (n,), >= 0, may be infinite.
        level: of s'x; if no point reaches it the result has the largest s'x.
    """
    x = clip(u, u_max)
    if s @ x >= level:
        return x
    leaves, arrives = np.full(len(u), np.inf), np.full(len(u), -np.inf)
    for i in range(len(u)):
        if s[i] != 0.0:
            end = np.copysign(u_max[i], s[i])
            leaves[i] = (-end - u[i]) / s[i]
            arrives[i] = (end - u[i]) / s[i]
    nu, enough = 0.0, np.inf
    for point in np.concatenate((leaves, arrives)):
        if nu < point < enough:
            if s @ clip(u + point * s, u_max) < level:
                nu = point
            else:
                enough = point
    x = clip(u + nu * s, u_max)
    missing = level - s @ x
    push = np.where((leaves <= nu) & (nu < arrives), s, 0.0)
    slope = push @ push
    if slope > 0.0 and missing <= slope * (enough - nu):
        return clip(x + missing / slope * push, u_max)
    if enough < np.inf:
        # Where |u_i| is 1e16 times its limit, i leaves and arrives at the same rounded nu.
        rest = clip(u + enough * s, u_max) - x
        return clip(x + missing / (s @ rest) * rest, u_max)
    return x


@njit(cache=True)
def nearest_with_leak(M: Array, s: Array, u: Array, limit: Array, w: Array) -> tuple[Array, float]:
    """Return the torque y of (11) extended by a leak eta of s, and eta, 1/s.

        minimise |y - u|^2 + |eta M s|^2   subject to  |y| <= limit,  s'y + eta s'M s >= s'w.

    A leak damps as the torque eta M s does, without a limit: a solution always exists. In the
    variable f = eta |M s| the leak is one more component of the vector.
    """
    n, largest = len(s), np.abs(s).max()
    direction, wish, limits = np.zeros(n + 1), np.zeros(n + 1), np.full(n + 1, np.inf)
    wish[:n], limits[:n], size = u, limit, 0.0
    if largest > 0.0:
        direction[:n] = s / largest
        momentum = M @ direction[:n]
        size = math.sqrt(momentum @ momentum)
        power = direction[:n] @ momentum
        if size > 0.0 and power > 0.0:
            direction[n] = power / size
    result = nearest_dissipating(wish, direction, limits, float(direction[:n] @ w))
    leak = result[n] / (size * largest) if size * largest > 0.0 else 0.0
    if not (np.isfinite(result).all() and math.isfinite(leak)):
        return clip(u, limit), 0.0
    return result[:n].copy(), leak


@njit(cache=True)
def limited_feedback(
    fast: Array, slow: Array, mu: float, M: Array, C: Array, K: Array, limit: Array
) -> tuple[Array, float]:
    """Return (11) extended to the whole torque (C + K) s; see `nearest_with_leak`.

    Integrators of joints that are limited shrink before, until they ask for what they get. Only
    what contributes to s shrinks, and s not beyond zero, so that no integrator grows or changes
    sign: it is a leak of this joint, just as fast as it must be.

    Args:
        fast: integrator, shape (n,), rad/s, changed in place.
        slow: likewise.
        mu: weight of the fast integrator.
        M: mass matrix, shape (n, n), kg m^2.
        C: Coriolis matrix, shape (n, n), N m s.
        K: diagonal of the gain, shape (n,), N m s.
        limit: shape (n,), N m.
    """
    s = mu * fast + (1.0 - mu) * slow
    u = C @ s + K * s
    for i in range(len(s)):
        outward, excess = math.copysign(1.0, s[i]), abs(u[i]) - limit[i]
        own = K[i] + max(C[i, i], 0.0)  # torque that the joint asks for by its own s
        from_fast = max(outward * mu * fast[i], 0.0)
        from_slow = max(outward * (1.0 - mu) * slow[i], 0.0)
        if excess > 0.0 and outward * u[i] > 0.0 and own > 0.0 and from_fast + from_slow > 0.0:
            shift = min(excess / own, abs(s[i]))
            kept = max(1.0 - shift / (from_fast + from_slow), 0.0)
            if from_fast > 0.0:
                fast[i] *= kept
            if from_slow > 0.0:
                slow[i] *= kept
    s = mu * fast + (1.0 - mu) * slow
    Cs, Ks = C @ s, K * s
    return nearest_with_leak(M, s, Cs + Ks, limit, Cs + clip(Ks, limit))


def _checked(u_max: ArrayLike, **vectors: ArrayLike) -> list[Array]:
    """Return the vectors and then the limits as arrays of one length."""
    arrays = {name: np.asarray(x, dtype=np.float64) for name, x in vectors.items()}
    limits = np.asarray(u_max, dtype=np.float64)
    if any(x.ndim != 1 or x.shape != limits.shape for x in arrays.values()):
        shapes = ", ".join(f"{name} {x.shape}" for name, x in arrays.items())
        raise ValueError(f"must all have shape (n,): {shapes}, u_max {limits.shape}")
    for name, x in arrays.items():
        if not np.isfinite(x).all():
            raise ValueError(f"{name} must be finite, is {x}")
    if not (limits >= 0.0).all():
        raise ValueError(f"u_max must be numbers >= 0, is {limits}")
    return [*arrays.values(), limits]
