# SPDX-License-Identifier: Apache-2.0
"""One step of null-space compliance, compiled; `docs/nullspace_compliance.md` derives it.

The torque is linear in the memory (a, x), where x = a - a_fast is what the fast memory has
forgotten, and the stored energy is quadratic.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import clip, scale_factor
from torque_safety_controller.integral_feedback.action import ArmTerms
from torque_safety_controller.integral_feedback.kernels import gain_matrix
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.settings import WIDENING_TIME, Law
from torque_safety_controller.linalg.generalized_inverse import (
    THRESHOLD,
    dynamically_consistent_inverse,
)
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

FADING_TIME = 0.2
"""Time constant with which that part of an initial torque fades that the memory cannot hold, s."""

_AT_LIMIT = 1.0 - 1e-9

_SINGULAR = 1e-12  # relative; smaller pivots are rounding


class NullspaceMemory(NamedTuple):
    """What lasts from one step to the next; written in place.

    Attributes:
        a: the error that dies away, eq. (16), shape (n,), rad/s.
        s: its part in the null space, (1 - J^+ J) a, shape (n,), rad/s.
        integral: integral(J' s), which is - J a, shape (m,).
        root: ``sqrt(diag M) x``, shape (n,): its square is the fast memory's energy whatever M
            does.
        offset: what is left of an initial torque that the memory cannot hold, shape (n,), N m.
        widening: of the budgets, shape (n,), N m.
        v: velocity, shape (n,), rad/s.
        J: Jacobian of the task, shape (m, n).
    """

    a: Array
    s: Array
    integral: Array
    root: Array
    offset: Array
    widening: Array
    v: Array
    J: Array


@compiled
def step(
    memory: NullspaceMemory,
    law: Law,
    arm: ArmTerms,
    a_ref: Array,
    torque: Array,
    saturated: NDArray[np.bool_],
    dt: float,
    initialise: float,
) -> bool:
    """Take one step; return whether the arguments were usable. If not, the memory is as before.

    `a_ref` is the acceleration commanded in the last step, shape (n,), rad/s^2, and `dt` the time
    since then, s. With `initialise` above 0 the memory is chosen such that the torque is what
    `torque` holds, shape (n,), N m. It receives the torque, and `saturated`, shape (n,), which
    joints are at their budgets.

    Raises:
        LinAlgError: M is singular.
    """
    M, C, J, J_dot, v = arm
    if not usable(arm, a_ref, torque, initialise):
        return False
    J_plus, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, C + C.T, THRESHOLD)
    root_M = np.sqrt(np.diag(M))
    if initialise > 0.0:
        a = initial_memory(law, arm, J_plus, torque)
        x = a if law.fast_leak_rate > law.slow_leak_rate else np.zeros_like(a)
        widening = np.maximum(np.abs(torque) - law.budget, 0.0)
    else:
        a, x = _advance(memory, law, arm, J_plus, root_M, a_ref, dt)
        widening = math.exp(-dt / WIDENING_TIME) * memory.widening
    limit = law.budget + widening
    own = law_torque(law, arm, J_plus, J_plus_dot, a, x)
    limited = scale_factor(own, limit) < 1.0
    if limited:
        H = torque_matrix(law, arm, J_plus, J_plus_dot)
        a, x, own = _limited(law, M, H, limit, a, x, own)
    offset = torque - own if initialise > 0.0 else math.exp(-dt / FADING_TIME) * memory.offset
    result = clip(own + offset, limit)
    integral = -(J @ a)
    if not math.isfinite(result.sum() + a.sum() + x.sum() + integral.sum()):
        return False
    torque[:] = result
    saturated[:] = limited & (np.abs(result) >= _AT_LIMIT * law.budget)
    memory.a[:] = a
    memory.s[:] = a + J_plus @ integral
    memory.integral[:] = integral
    memory.root[:] = root_M * x
    memory.offset[:] = offset
    memory.widening[:] = widening
    memory.v[:] = v
    memory.J[:] = J
    return True


@compiled
def law_torque(
    law: Law, arm: ArmTerms, J_plus: Array, J_plus_dot: Array, a: Array, x: Array
) -> Array:
    """Return the additional torque of eq. (21) with (26), shape (n,)."""
    K = law.gain * np.diag(arm.M)
    Ja = arm.J @ a
    Pa = J_plus @ Ja
    # J^+ J' s + (J^+)' integral, where s = (1 - P) a and integral = - J a.
    inner = J_plus @ (arm.J_dot @ (a - Pa)) - J_plus_dot @ Ja
    slow = arm.J.T @ (J_plus.T @ (K * Pa))
    return arm.C @ a - arm.M @ inner + (1.0 - law.mu) * slow + law.mu * K * (a - x)


@compiled
def torque_matrix(law: Law, arm: ArmTerms, J_plus: Array, J_plus_dot: Array) -> Array:
    """Return how `law_torque` depends on a, shape (n, n)."""
    K = law.gain * np.diag(arm.M)
    P = J_plus @ arm.J
    inner = J_plus @ (arm.J_dot - arm.J_dot @ P) - J_plus_dot @ arm.J
    H = arm.C - arm.M @ inner
    H += (1.0 - law.mu) * (P.T * K) @ P
    for i in range(len(H)):
        H[i, i] += law.mu * K[i]
    return H


@compiled
def energy_product(law: Law, M: Array, a: Array, x: Array, b: Array, y: Array) -> float:
    """Return the inner product of (a, x) and (b, y) whose square is twice the energy, J."""
    weight = 0.0
    if law.fast_leak_rate > law.slow_leak_rate:
        weight = law.mu * law.gain / (law.fast_leak_rate - law.slow_leak_rate)
    return float(a @ (M @ b) + weight * (x @ (np.diag(M) * y)))


@compiled
def _advance(
    memory: NullspaceMemory,
    law: Law,
    arm: ArmTerms,
    J_plus: Array,
    root_M: Array,
    a_ref: Array,
    dt: float,
) -> tuple[Array, Array]:
    """Return a and x after the acceleration error of the last step."""
    slow, slow_gain = leak_factors(law.slow_leak_rate, dt, False)
    fast, fast_gain = leak_factors(law.fast_leak_rate, dt, False)
    ratio = fast_gain / slow_gain
    left = slow * memory.s
    s = left + slow_gain * (a_ref * dt - (arm.v - memory.v))
    # With the middle of s the product rule is exact: J a grows by the middle of J times the
    # increment of s.
    integral = slow * memory.integral + (arm.J - memory.J) @ (0.5 * (left + s))
    a = s - J_plus @ integral
    # The fast memory takes fast_gain of what a gained, of which slow_gain is seen.
    x = (1.0 - ratio) * a + (ratio * slow - fast) * memory.a + fast * memory.root / root_M
    forgotten = -math.expm1((law.slow_leak_rate - law.null_leak_rate) * dt)  # in the null space
    return a - forgotten * (a - J_plus @ (arm.J @ a)), x


@compiled
def usable(arm: ArmTerms, a_ref: Array, torque: Array, initialise: float) -> bool:
    """Return whether the arguments of a step are numbers, and M can be a mass matrix."""
    M, C, J, J_dot, v = arm
    total = M.sum() + C.sum() + J.sum() + J_dot.sum() + v.sum() + a_ref.sum()
    if initialise > 0.0:
        total += torque.sum()
    return math.isfinite(total) and bool((np.diag(M) > 0.0).all())


@compiled
def initial_memory(law: Law, arm: ArmTerms, J_plus: Array, torque: Array) -> Array:
    """Return the a whose slow memory gives what the task feels of `torque`.

    The task feels the force F = J^+^T torque. Where J a = y the slow torque is
    J^T ((1 - mu) J^+^T K J^+ y), which is J^T F for this y.
    """
    B = (1.0 - law.mu) * (J_plus.T @ gain_matrix(law, arm.M)) @ J_plus
    return J_plus @ (np.linalg.pinv(B, _SINGULAR) @ (J_plus.T @ torque))


@compiled
def _limited(
    law: Law, M: Array, H: Array, limit: Array, a: Array, x: Array, torque: Array
) -> tuple[Array, Array, Array]:
    """Return a memory and its torque with |torque| <= limit that stores no more energy.

    Scaling all of the memory by (10) does both, but weakens every joint for the sake of one. So
    a is changed such that only the torques beyond their limits change, to the limits. If that
    stores more energy than before, it is done in part: the memory is the furthest point on the
    way from the scaled one that does not. Both ends are within the limits, and with them the way.

    Args:
        law: settings.
        M: mass matrix, shape (n, n).
        H: of `torque_matrix`.
        limit: shape (n,), >= 0, may be infinite.
        a: shape (n,).
        x: shape (n,).
        torque: that they give, shape (n,).
    """
    scale = scale_factor(torque, limit)
    cut = clip(torque, limit) - torque
    regular = H + _SINGULAR * (np.abs(H).max() + 1e-300) * np.eye(len(H))
    shift, way = np.linalg.solve(regular, cut), 0.0
    if np.abs(H @ shift - cut).max() <= 1e-6 * np.abs(cut).max():
        way = _way(law, M, a, x, scale, shift)
    else:
        shift[:] = 0.0
    keep = scale + way * (1.0 - scale)
    return keep * a + way * shift, keep * x, clip(keep * torque + way * cut, limit)


@compiled
def _way(law: Law, M: Array, a: Array, x: Array, scale: float, shift: Array) -> float:
    """Return how far from (scale a, scale x) to (a + shift, x) the energy is that of (a, x)."""
    da, dx = (1.0 - scale) * a + shift, (1.0 - scale) * x
    spare = (1.0 - scale * scale) * energy_product(law, M, a, x, a, x)
    linear = scale * energy_product(law, M, a, x, da, dx)
    square = energy_product(law, M, da, dx, da, dx)
    if square + 2.0 * linear <= spare:
        return 1.0
    root = math.sqrt(linear * linear + square * spare)
    return spare / (linear + root) if linear > 0.0 else (root - linear) / square
