"""Eq. (10) and (11) of [Benallegue2021], compiled; `docs/integral_action.md` derives them.

What (11) returns is the solution of a problem with one multiplier,

    x = clip(u + nu s, -u_max, u_max),   the least nu >= 0 with s'x >= s'w,   w = lambda_w u,

and s'x is piecewise linear and nowhere decreasing in nu. So the solution is exact after a search
among at most 2 n break points, and one division.

Near a break point all may hang on a difference that rounding would hide: joints whose s is large
keep s'x = s'w to the last digit while one whose s is small has still far to go. The sums are
therefore carried to twice the working precision, which costs less than the call.
"""

from __future__ import annotations

import math

import numpy as np

from viability_bounds_pkg.compiled import compiled

_SPLIT = 134217729.0  # 2^27 + 1, Veltkamp
_SUM_ERROR = 2.0**-98  # of a sum of n terms carried to twice the precision, n up to 100
# The products of factors below this, the largest being 1, may lose digits.
_SMALL = 2.0**-360
_LEAST = 2.0**-1074
_ATTEMPTS = 8


@compiled
def _two_sum(a: float, b: float) -> tuple[float, float]:
    """Return a + b rounded, and what rounding took away."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@compiled
def _two_product(a: float, b: float) -> tuple[float, float]:
    """Return a b rounded, and what rounding took away."""
    product = a * b
    c = _SPLIT * a
    a_high = c - (c - a)
    a_low = a - a_high
    c = _SPLIT * b
    b_high = c - (c - b)
    b_low = b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@compiled
def all_finite(x: np.ndarray) -> bool:
    """Return whether no number in x, shape (n,), is infinite or NaN."""
    finite = True
    for i in range(len(x)):
        finite = finite and math.isfinite(x[i])
    return finite


@compiled
def all_limits(x: np.ndarray) -> bool:
    """Return whether all numbers in x, shape (n,), are >= 0; they may be infinite."""
    limits = True
    for i in range(len(x)):
        limits = limits and x[i] >= 0.0
    return limits


@compiled
def scale_factor(u: np.ndarray, u_max: np.ndarray) -> float:
    """Return lambda_w of eq. (10), rounded down: no lambda_w |u_i| is beyond its limit."""
    smallest = 1.0
    for i in range(len(u)):
        size = abs(u[i])
        if size > u_max[i]:
            ratio = u_max[i] / size
            if ratio > 0.0:
                # Compare ratio * size with u_max exactly, on mantissas.
                a, exponent_a = math.frexp(ratio)
                b, exponent_b = math.frexp(size)
                c, exponent_c = math.frexp(u_max[i])
                product, rest = _two_product(a, b)
                c = math.ldexp(c, exponent_c - exponent_a - exponent_b)
                if product > c or (product == c and rest > 0.0):
                    ratio = np.nextafter(ratio, 0.0)
            smallest = min(smallest, ratio)
    return smallest


@compiled
def clip(u: np.ndarray, u_max: np.ndarray, x: np.ndarray) -> None:
    """Fill `x` with `u`, each component within its limit."""
    for i in range(len(u)):
        x[i] = min(max(u[i], -u_max[i]), u_max[i])


@compiled
def _surplus(s: np.ndarray, x: np.ndarray, w: np.ndarray, w_low: np.ndarray) -> float:
    """Return s'(x - w - w_low), computed to twice the working precision."""
    high = low = 0.0
    for i in range(len(s)):
        if s[i] != 0.0:
            d, rest = _two_sum(x[i], -w[i])
            d, rest = _two_sum(d, rest - w_low[i])
            product, error = _two_product(s[i], d)
            high, lost = _two_sum(high, product)
            low += lost + (error + s[i] * rest)
    return high + low


@compiled
def nearest(
    u: np.ndarray,
    s: np.ndarray,
    u_max: np.ndarray,
    w: np.ndarray,
    w_low: np.ndarray,
    x: np.ndarray,
) -> None:
    """Fill `x` with the nearest point to `u` that has |x| <= u_max and s'x >= s'(w + w_low).

    Args:
        u: shape (n,).
        s: shape (n,); its scale does not matter.
        u_max: shape (n,), may be infinite.
        w: shape (n,), any.
        w_low: shape (n,), what is lost in w by rounding.
        x: shape (n,), receives the result. If no point fulfils the inequality it is one with
            the largest s'x.
    """
    n = len(u)
    clip(u, u_max, x)
    if _surplus(s, x, w, w_low) >= 0.0:
        return
    # With growing nu component i leaves one limit at opens[i] and meets the other at shuts[i].
    opens = np.full(n, np.inf)
    shuts = np.full(n, np.inf)
    points = np.empty(2 * n + 1)
    points[0] = 0.0
    count = 1
    for i in range(n):
        size = abs(s[i])
        outward = u[i] if s[i] > 0.0 else -u[i]
        if size > 0.0 and outward < u_max[i]:
            opens[i] = max(0.0, (-u_max[i] - outward) / size)
            shuts[i] = (u_max[i] - outward) / size
            for point in (opens[i], shuts[i]):
                if 0.0 < point < np.inf:
                    k = count
                    while points[k - 1] > point:
                        points[k] = points[k - 1]
                        k -= 1
                    points[k] = point
                    count += 1
    # The last break point that is not far enough.
    first, last = 0, count
    while last - first > 1:
        middle = (first + last) // 2
        _move(u, s, u_max, opens, shuts, points[middle], x)
        if _surplus(s, x, w, w_low) >= 0.0:
            last = middle
        else:
            first = middle
    nu = points[first]
    _move(u, s, u_max, opens, shuts, nu, x)
    free = np.empty(n, dtype=np.bool_)
    for i in range(n):
        # Where u_i is 1e16 times its limit, one break point of rounded numbers is both.
        free[i] = opens[i] <= nu and (nu < shuts[i] or opens[i] == nu)
    # Once, but for such components.
    for _ in range(n):
        short = -_surplus(s, x, w, w_low)
        if not short > 0.0 or not _push(s, u_max, free, short, x):
            return


@compiled
def _push(s: np.ndarray, u_max: np.ndarray, free: np.ndarray, power: float, x: np.ndarray) -> bool:
    """Move free components of `x` along s, within the limits, to gain `power` in s'x.

    Components that are at their limit already are struck off `free`. Returns False when there
    is none left.
    """
    n = len(s)
    largest = 0.0
    for i in range(n):
        if s[i] == 0.0 or x[i] == math.copysign(u_max[i], s[i]):
            free[i] = False
        if free[i]:
            largest = max(largest, abs(s[i]))
    if largest == 0.0:
        return False
    slope = 0.0
    for i in range(n):
        if free[i]:
            slope += (s[i] / largest) ** 2
    way = power / largest / slope
    for i in range(n):
        if free[i]:
            x[i] = min(max(x[i] + way * (s[i] / largest), -u_max[i]), u_max[i])
    return True


@compiled
def _move(
    u: np.ndarray,
    s: np.ndarray,
    u_max: np.ndarray,
    opens: np.ndarray,
    shuts: np.ndarray,
    nu: float,
    x: np.ndarray,
) -> None:
    """Fill `x` with clip(u + nu s), exact where it is at a limit."""
    for i in range(len(u)):
        y = u[i]
        if opens[i] < nu:
            y = math.copysign(u_max[i], s[i]) if shuts[i] <= nu else u[i] + nu * s[i]
        x[i] = min(max(y, -u_max[i]), u_max[i])


@compiled
def _scaled(x: np.ndarray, exponent: int) -> np.ndarray:
    """Return 2^exponent x, where only zeros become zero."""
    y = np.empty(len(x))
    for i in range(len(x)):
        y[i] = math.ldexp(x[i], exponent)
        if y[i] == 0.0 and x[i] != 0.0:
            y[i] = math.copysign(_LEAST, x[i])
    return y


@compiled
def _exponent(x: np.ndarray) -> int:
    """Return by which power of 2 to divide x, so that the largest number is about 1."""
    largest = 0.0
    for i in range(len(x)):
        largest = max(largest, abs(x[i]))
    return math.frexp(largest)[1]


@compiled
def _doubt(s: np.ndarray, x: np.ndarray, w: np.ndarray, w_low: np.ndarray) -> float:
    """Return by how much `_surplus` may be wrong; all numbers at most about 1."""
    doubt = 0.0
    for i in range(len(s)):
        size = max(abs(x[i]), abs(w[i]))
        if abs(s[i]) >= _SMALL and size >= _SMALL:
            doubt += _SUM_ERROR * abs(s[i]) * (abs(x[i] - w[i]) + 2.0**50 * abs(w_low[i]))
        elif s[i] != 0.0 and size > 0.0:
            doubt += 16.0 * _SMALL  # twice the whole term
    return doubt


@compiled
def project(u: np.ndarray, s: np.ndarray, u_max: np.ndarray, x: np.ndarray) -> float:
    """Fill `x`, shape (n,), with the solution of eq. (11); return lambda_w.

    For finite u and s and limits >= 0. The limits and the inequality s'x >= lambda_w s'u hold
    for the numbers returned exactly, not only up to rounding.
    """
    n = len(u)
    factor = scale_factor(u, u_max)
    clip(u, u_max, x)
    aligned = True
    for i in range(n):
        if (s[i] > 0.0 > u[i]) or (s[i] < 0.0 < u[i]):
            aligned = False
    if aligned or factor == 1.0:
        # min(|u_i|, u_max_i) >= lambda_w |u_i|: each term of the inequality holds by itself.
        return factor
    # Where nothing is allowed, x_i = 0 = lambda_w u_i, and s_i does not matter.
    s = np.where(u_max > 0.0, s, 0.0)
    scale_u, scale_s = _exponent(u), _exponent(s)
    u_near, s_near, limits = _scaled(u, -scale_u), _scaled(s, -scale_s), _scaled(u_max, -scale_u)
    w, w_low = np.empty(n), np.empty(n)
    for i in range(n):
        w[i], w_low[i] = _two_product(factor, u_near[i])
    y = np.empty(n)
    nearest(u_near, s_near, limits, w, w_low, y)
    free = np.ones(n, dtype=np.bool_)
    digit = 2.0**-52
    for _ in range(_ATTEMPTS):
        surplus = _surplus(s_near, y, w, w_low)
        if surplus >= _doubt(s_near, y, w, w_low):
            for i in range(n):
                x[i] = min(max(math.ldexp(y[i], scale_u), -u_max[i]), u_max[i])
            return factor
        # Rounding left it short by a digit or so.
        short = max(0.0, -surplus)
        for i in range(n):
            if y[i] != math.copysign(limits[i], s_near[i]):
                short += digit * abs(s_near[i] * y[i])
        if not _push(s_near, limits, free, short, y):
            break
        digit *= 4.0
    # Numbers so far apart that their products have no digits in common with the rest: what
    # holds term by term will do.
    for i in range(n):
        if (s[i] > 0.0 > u[i]) or (s[i] < 0.0 < u[i]):
            x[i] = _toward_zero(factor, u[i])
    return factor


@compiled
def _toward_zero(factor: float, u: float) -> float:
    """Return factor * u, rounded towards zero."""
    a, exponent_a = math.frexp(factor)
    b, exponent_b = math.frexp(u)
    product, rest = _two_product(a, b)
    if product * rest < 0.0:
        product = np.nextafter(product, 0.0)
    x = math.ldexp(product, exponent_a + exponent_b)
    # At the bottom of the range ldexp rounds by itself.
    return np.nextafter(x, 0.0) if abs(x) < 2.0**-1021 else x
