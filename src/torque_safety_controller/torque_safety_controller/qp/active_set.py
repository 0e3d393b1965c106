"""The dual active-set method of [Goldfarb1983] for small dense QPs, compiled.

    minimise    x'Hx / 2 + g'x    subject to    lower <= (x, C x) <= upper

It starts from the minimum without constraints, or with those that were active the last time,
and takes in violated ones, the worst first; one whose multiplier would turn negative is let go.
Each point on the way is the minimum under its active constraints, with multipliers of the
right sign, so that the first one without a violation is the solution. When a violated one
depends on active ones none of which may go, there is no solution: that is known for certain,
and after few steps.
"""

from __future__ import annotations

import numpy as np

from torque_safety_controller.qp.active_set_kernels import (
    advance,
    first_to_vanish,
    is_independent,
    let_go,
    minimum_on,
    most_violated,
    prepare,
    pulling,
    settle,
    solve_upper,
    square,
    take_in,
    take_in_all,
    transformed_normal,
    value_of,
)
from viability_bounds_pkg.compiled import compiled

INFEASIBLE = -1
FAILED = -2


@compiled(error_model="numpy")
def minimise(
    H: np.ndarray,
    g: np.ndarray,
    C: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    side: np.ndarray,
    x: np.ndarray,
) -> int:
    """Solve the QP of this module; equal limits make an equation.

    Args:
        H: shape (n, n), positive definite.
        g: shape (n,).
        C: shape (m, n).
        lower: of x, then of C x, shape (n + m,); may be -inf.
        upper: shape (n + m,); may be inf.
        side: which limits to begin with, shape (n + m,): 1 the lower, -1 the upper, 0 none.
            Receives those that are active in the solution.
        x: shape (n,), receives the solution.

    Returns:
        How many changes of the active constraints it took; `INFEASIBLE`; or `FAILED`, when
        something is not finite, limits are crossed or the numbers are too absurd.
    """
    n, m = len(g), len(C)
    K, R = np.empty((n, n)), np.empty((n, n))
    lengths, d, y, r = np.empty(m), np.empty(n), np.empty(n), np.empty(n)
    u, active = np.empty(n), np.empty(n, np.int64)
    if prepare(H, g, C, lower, upper, K, lengths):
        q = take_in_all(C, K, R, active, side, lower, upper, d)
        most = 10 * (n + m) + 50
        changes = 0
        while changes < most:
            # From here on x is the minimum under what is active, without rounding of the way.
            minimum_on(K, R, active, side, g, lower, upper, q, x, u, y)
            leaving = pulling(u, active, lower, upper, q)
            if leaving >= 0:
                side[active[leaving]] = 0.0
                let_go(K, R, active, u, q, leaving)
                q -= 1
                changes += 1
                continue
            i, sign = most_violated(C, lengths, lower, upper, side, x)
            if i < 0:
                if not settle(x, lower, upper):
                    break
                return changes
            while changes < most:
                changes += 1
                transformed_normal(C, K, i, sign, d)
                r[:q] = d[:q]
                solve_upper(R, r, q)
                leaving, step = first_to_vanish(u, r, active, lower, upper, q)
                if q < n and is_independent(d, q):
                    value = value_of(C, x, i)
                    missing = lower[i] - value if sign > 0 else value - upper[i]
                    if missing / square(d, q) <= step:
                        take_in(K, R, d, q)
                        active[q] = i
                        side[i] = sign
                        q += 1
                        break
                    advance(x, K, d, q, step)
                elif leaving < 0:
                    side[:] = 0.0
                    return INFEASIBLE
                for j in range(q):
                    u[j] -= step * r[j]
                side[active[leaving]] = 0.0
                let_go(K, R, active, u, q, leaving)
                q -= 1
    side[:] = 0.0
    return FAILED


@compiled
def write_dynamics(
    C: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    a_lower: np.ndarray,
    a_upper: np.ndarray,
    rho_max: np.ndarray,
    M: np.ndarray,
    B: np.ndarray,
    tau_lower: np.ndarray,
    tau_upper: np.ndarray,
    G: np.ndarray,
    g_lower: np.ndarray,
    g_upper: np.ndarray,
) -> None:
    """Write the constraints on x = (a, rho) with C = (M, -B; G, 0), as `minimise` takes them.

    Args:
        C: shape (n + k, n + r), written; what is zero in it has to be zero already.
        lower: shape (n + r + n + k,), written.
        upper: shape (n + r + n + k,), written.
        a_lower: limits of a, shape (n,).
        a_upper: shape (n,).
        rho_max: upper limits of rho, shape (r,); the lower ones are zero.
        M: shape (n, n).
        B: shape (n, r).
        tau_lower: limits of M a - B rho, shape (n,).
        tau_upper: shape (n,).
        G: shape (k, n).
        g_lower: limits of G a, shape (k,).
        g_upper: shape (k,).
    """
    n, r = B.shape
    for i in range(n):
        lower[i], upper[i] = a_lower[i], a_upper[i]
        lower[n + r + i], upper[n + r + i] = tau_lower[i], tau_upper[i]
        for j in range(n):
            C[i, j] = M[i, j]
        for j in range(r):
            C[i, n + j] = -B[i, j]
    for j in range(r):
        lower[n + j], upper[n + j] = 0.0, rho_max[j]
    for i in range(len(g_lower)):
        lower[n + r + n + i], upper[n + r + n + i] = g_lower[i], g_upper[i]
        for j in range(n):
            C[n + i, j] = G[i, j]
