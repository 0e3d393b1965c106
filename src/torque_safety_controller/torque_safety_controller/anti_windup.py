# SPDX-License-Identifier: Apache-2.0
"""Limits on the integral torque that keep it dissipative: eq. (10) and (11), [Benallegue2021].

The integral torque u = K s is to stay within limits u_max, and to take energy out of s all the
same: s'u > 0. Both ways leave alone what is within the limits:

- `scale_to_limits`, eq. (10), scales the whole vector by lambda_w;
- `project_to_limits`, eq. (11), takes the nearest vector within the limits that dissipates, in
  s'x, no less than (10) does.

For the K of the control step, lambda diag(M), (11) is the clip of each component by itself;
`docs/theory/integral_action.md` proves it.
"""

from __future__ import annotations

import math

import numpy as np
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


def clip(u: Array, u_max: Array) -> Array:
    """Return `u` with each component cut to its limit, shape (n,)."""
    limited: Array = np.minimum(np.maximum(u, -u_max), u_max)
    return limited


def nearest_dissipating(u: Array, s: Array, u_max: Array, level: float) -> Array:
    """Return the point nearest to `u` with |x| <= u_max and s'x >= level, shape (n,).

    It is ``x(nu) = clip(u + nu s)`` for the least nu >= 0 with s'x(nu) >= level. s'x(nu) never
    falls, and is linear between the values of nu at which a component leaves one limit or
    arrives at the other; between the two of those next to the solution the components that are
    free move together.

    Args:
        u: shape (n,).
        s: shape (n,), of size 1 or so.
        u_max: shape (n,), >= 0, may be infinite.
        level: of s'x; if no point reaches it the result has the largest s'x.
    """
    x = clip(u, u_max)
    if s @ x >= level:
        return x
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        end = np.copysign(u_max, s)
        leaves = np.where(s == 0.0, np.inf, (-end - u) / s)
        arrives = np.where(s == 0.0, -np.inf, (end - u) / s)
        points = np.concatenate((leaves, arrives))
        points = points[(points > 0.0) & (points < np.inf)]
        short = clip(u + points[:, None] * s, u_max) @ s < level
    enough = points[~short].min(initial=np.inf)
    nu = points[short & (points < enough)].max(initial=0.0)
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


def nearest_with_leak(M: Array, s: Array, u: Array, limit: Array, w: Array) -> tuple[Array, float]:
    """Return the torque y of (11) extended by a leak eta of s, and eta, 1/s.

        minimise |y - u|^2 + |eta M s|^2   subject to  |y| <= limit,  s'y + eta s'M s >= s'w.

    A leak damps as the torque eta M s does, without a limit: a solution always exists. In the
    variable f = eta |M s| the leak is one more component of the vector.
    """
    largest = np.abs(s).max()
    direction = s / max(largest, _TINY)
    momentum = M @ direction
    size, power = math.sqrt(momentum @ momentum), direction @ momentum
    damping = power / size if size > 0.0 and power > 0.0 else 0.0
    result = nearest_dissipating(
        np.append(u, 0.0), np.append(direction, damping), np.append(limit, np.inf), direction @ w
    )
    leak = float(result[-1] / (size * largest)) if size * largest > 0.0 else 0.0
    if not (np.isfinite(result).all() and math.isfinite(leak)):
        return clip(u, limit), 0.0
    return result[:-1], leak


def limited_feedback(
    fast: Array, slow: Array, mu: float, M: Array, C: Array, K: Array, limit: Array
) -> tuple[Array, float, Array, Array]:
    """Return (11) extended to the whole torque (C + K) s, its leak, and both integrators.

    Integrators of joints that are limited shrink before, until they ask for what they get. Only
    what contributes to s shrinks, and s not beyond zero, so that no integrator grows or changes
    sign: it is a leak of this joint, just as fast as it must be.

    Args:
        fast: integrator, shape (n,), rad/s.
        slow: likewise.
        mu: weight of the fast integrator.
        M: mass matrix, shape (n, n), kg m^2.
        C: Coriolis matrix, shape (n, n), N m s.
        K: diagonal of the gain, shape (n,), N m s.
        limit: shape (n,), N m.
    """
    s = mu * fast + (1.0 - mu) * slow
    u = C @ s + K * s
    outward, excess = np.copysign(1.0, s), np.abs(u) - limit
    own = K + np.maximum(np.diagonal(C), 0.0)  # torque that the joint asks for by its own s
    from_fast = np.maximum(outward * mu * fast, 0.0)
    from_slow = np.maximum(outward * (1.0 - mu) * slow, 0.0)
    contributes = from_fast + from_slow
    shrinks = (excess > 0.0) & (outward * u > 0.0) & (own > 0.0) & (contributes > 0.0)
    shift = np.minimum(excess[shrinks] / own[shrinks], np.abs(s[shrinks]))
    kept = np.ones_like(s)
    kept[shrinks] = np.maximum(1.0 - shift / contributes[shrinks], 0.0)
    fast = np.where(from_fast > 0.0, kept * fast, fast)
    slow = np.where(from_slow > 0.0, kept * slow, slow)
    s = mu * fast + (1.0 - mu) * slow
    Cs, Ks = C @ s, K * s
    return *nearest_with_leak(M, s, Cs + Ks, limit, Cs + clip(Ks, limit)), fast, slow


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
