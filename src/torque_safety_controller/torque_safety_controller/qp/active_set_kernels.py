"""The factorisation behind `active_set`: of the active normals N in the metric of H^-1.

With H = L L' and ``L^-1 N = Q (R; 0)``, kept are R, upper triangular, shape (n, n), of which the
first q columns count, and ``K = Q' L^-1``, shape (n, n). The normal of a limit points to where
the limit is kept. `C`, `lower`, `upper`, `side` and `x` are as in `active_set.minimise`;
`active` holds the indices of the q active constraints, `u` their multipliers.
"""

from __future__ import annotations

import math

from torque_safety_controller.linalg.cholesky import factorise
from viability_bounds_pkg.compiled import compiled

_FEASIBLE = 1e-9
"""What a constraint may be violated by, for a normal of length 1."""
_ROUNDING = 1e-13  # of a limit
_DEPENDENT = 1e-12
"""A normal of which less is independent of the active ones, in the metric of H^-1, depends."""
_BLOCKING = 1e-14
"""Multipliers that fall slower than this, of the fastest, do not fall but for rounding."""
_PULLING = 1e-12
"""A multiplier below zero by less than this, of the greatest, is zero but for rounding."""


@compiled(error_model="numpy")
def prepare(H, g, C, lower, upper, K, lengths):
    """Set ``K = L^-1`` and the lengths of C's rows; tell whether the problem makes sense."""
    n = len(g)
    for i in range(n):
        if not math.isfinite(g[i]):
            return False
    for i in range(len(lower)):
        if not (lower[i] <= upper[i] and lower[i] < math.inf and upper[i] > -math.inf):
            return False
    for i in range(len(lengths)):
        s = 0.0
        for k in range(n):
            s += C[i, k] * C[i, k]
        if not math.isfinite(s):
            return False
        lengths[i] = math.sqrt(s) if s > 0.0 else 1.0
    L = H.copy()
    if not factorise(L):
        return False
    for j in range(n):
        for i in range(j):
            K[i, j] = 0.0
        K[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            s = 0.0
            for k in range(j, i):
                s -= L[i, k] * K[k, j]
            K[i, j] = s / L[i, i]
    return True


@compiled(error_model="numpy")
def value_of(C, x, i):
    """Return what constraint i limits: an element of x, or of C x."""
    n = len(x)
    if i < n:
        return x[i]
    s = 0.0
    for k in range(n):
        s += C[i - n, k] * x[k]
    return s


@compiled(error_model="numpy")
def transformed_normal(C, K, i, sign, d):
    """Set ``d = K n``, with n the gradient of constraint i times `sign`, 1 or -1."""
    n = len(d)
    for j in range(n):
        if i < n:
            d[j] = sign * K[j, i]
        else:
            s = 0.0
            for k in range(n):
                s += C[i - n, k] * K[j, k]
            d[j] = sign * s


@compiled(error_model="numpy")
def square(d, first):
    """Return the square of d's length, from element `first` on."""
    s = 0.0
    for j in range(first, len(d)):
        s += d[j] * d[j]
    return s


@compiled(error_model="numpy")
def is_independent(d, q):
    """Return whether the normal behind `d` is more than a combination of the active ones."""
    return square(d, q) > _DEPENDENT * _DEPENDENT * square(d, 0)


@compiled(error_model="numpy")
def take_in(K, R, d, q):
    """Append to R the column that rotations make of `d`, and rotate K along."""
    n = len(d)
    for j in range(n - 1, q, -1):
        h = math.hypot(d[j - 1], d[j])
        if h == 0.0:
            continue
        c, s = d[j - 1] / h, d[j] / h
        d[j - 1], d[j] = h, 0.0
        for k in range(n):
            above, below = K[j - 1, k], K[j, k]
            K[j - 1, k] = c * above + s * below
            K[j, k] = c * below - s * above
    for j in range(q + 1):
        R[j, q] = d[j]


@compiled(error_model="numpy")
def take_in_all(C, K, R, active, side, lower, upper, d):
    """Make active what `side` says, as far as it is independent; return how many that are."""
    q = 0
    for i in range(len(side)):
        if side[i] == 0:
            continue
        transformed_normal(C, K, i, side[i], d)
        limit = lower[i] if side[i] > 0 else upper[i]
        if q < len(d) and math.isfinite(limit) and is_independent(d, q):
            take_in(K, R, d, q)
            active[q] = i
            q += 1
        else:
            side[i] = 0.0
    return q


@compiled(error_model="numpy")
def let_go(K, R, active, u, q, position):
    """Remove the active constraint at `position` of q."""
    n = K.shape[0]
    for p in range(position, q - 1):
        active[p] = active[p + 1]
        u[p] = u[p + 1]
        for j in range(p + 2):
            R[j, p] = R[j, p + 1]
        h = math.hypot(R[p, p], R[p + 1, p])
        if h == 0.0:
            continue
        c, s = R[p, p] / h, R[p + 1, p] / h
        R[p, p] = h
        for k in range(p + 2, q):
            above, below = R[p, k], R[p + 1, k]
            R[p, k] = c * above + s * below
            R[p + 1, k] = c * below - s * above
        for k in range(n):
            above, below = K[p, k], K[p + 1, k]
            K[p, k] = c * above + s * below
            K[p + 1, k] = c * below - s * above


@compiled(error_model="numpy")
def solve_upper(R, u, q):
    """Replace the first q elements of `u` by those of ``R^-1 u``."""
    for j in range(q - 1, -1, -1):
        for k in range(j + 1, q):
            u[j] -= R[j, k] * u[k]
        u[j] /= R[j, j]


@compiled(error_model="numpy")
def minimum_on(K, R, active, side, g, lower, upper, q, x, u, y):
    """Set x to the minimum with the active constraints as equations, u to their multipliers.

    With ``x = K' y`` and b the active limits: ``R' y_1 = b``, ``y_2 = -(K g)_2`` and
    ``R u = y_1 + (K g)_1``.
    """
    n = len(x)
    for j in range(n):
        s = 0.0
        for k in range(n):
            s += K[j, k] * g[k]
        if j < q:
            i = active[j]
            b = lower[i] if side[i] > 0 else -upper[i]
            for k in range(j):
                b -= R[k, j] * y[k]
            y[j] = b / R[j, j]
            u[j] = y[j] + s
        else:
            y[j] = -s
    solve_upper(R, u, q)
    for k in range(n):
        x[k] = 0.0
    for j in range(n):
        for k in range(n):
            x[k] += K[j, k] * y[j]


@compiled(error_model="numpy")
def advance(x, K, d, q, step):
    """Move x towards the limit behind `d`, along the active ones."""
    for j in range(q, len(x)):
        for k in range(len(x)):
            x[k] += step * d[j] * K[j, k]


@compiled(error_model="numpy")
def pulling(u, active, lower, upper, q):
    """Return the active constraint, not an equation, with the most negative multiplier, or -1."""
    found, least = -1, 0.0
    for j in range(q):
        least = min(least, -_PULLING * abs(u[j]))
    for j in range(q):
        if u[j] < least and lower[active[j]] < upper[active[j]]:
            found, least = j, u[j]
    return found


@compiled(error_model="numpy")
def first_to_vanish(u, r, active, lower, upper, q):
    """Return which multiplier, falling at the rates `r`, is zero first, or -1, and when."""
    found, when, fastest = -1, math.inf, 0.0
    for j in range(q):
        fastest = max(fastest, abs(r[j]))
    for j in range(q):
        if r[j] > _BLOCKING * fastest and lower[active[j]] < upper[active[j]]:
            ratio = max(u[j], 0.0) / r[j]
            if ratio < when:
                found, when = j, ratio
    return found, when


@compiled(error_model="numpy")
def most_violated(C, lengths, lower, upper, side, x):
    """Return the constraint furthest from being kept, or -1, and the side: 1 lower, -1 upper."""
    n = len(x)
    worst, found, sign = 0.0, -1, 0
    for i in range(len(lower)):
        if side[i] != 0:
            continue
        value = value_of(C, x, i)
        length = lengths[i - n] if i >= n else 1.0
        excess = lower[i] - value
        if excess > _FEASIBLE * length + _ROUNDING * abs(lower[i]) and excess > worst * length:
            worst, found, sign = excess / length, i, 1
        excess = value - upper[i]
        if excess > _FEASIBLE * length + _ROUNDING * abs(upper[i]) and excess > worst * length:
            worst, found, sign = excess / length, i, -1
    return found, sign


@compiled(error_model="numpy")
def settle(x, lower, upper):
    """Take from x what rounding puts outside its own limits; tell whether x is finite."""
    for k in range(len(x)):
        if not math.isfinite(x[k]):
            return False
        x[k] = min(max(x[k], lower[k]), upper[k])
    return True
