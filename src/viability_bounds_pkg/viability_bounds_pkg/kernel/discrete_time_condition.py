# SPDX-License-Identifier: Apache-2.0
"""The discrete-time condition (11) of [DelPrete2018]: when braking at full rate is safe.

Asymmetric limits, a margin for disturbances and continuous joints are worked out in
`docs/bounds.md`. With B_up, B_lo the decelerations that the kernel counts on towards the upper
and the lower limit, W the margin and L = q_max - q_min, it reads, for both ends,

    (B_up + 2 W) dt <= v_max,    L >= dt^2 / 2 (B_up + 2 W) (1 + (B_up + 2 W) / B_lo).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import (
    ROUNDING,
    JointLimits,
    JointLimitsError,
    joint_array,
)

Array = NDArray[np.float64]


class KernelBraking(NamedTuple):
    """Decelerations that the kernel of each joint counts on.

    Attributes:
        deceleration: towards the upper and the lower limit, shape (n, 2), rad/s^2.
        holds: whether (11) holds for the full braking, shape (n,); if not, either the braking
            is reduced or the kernel is not the one of continuous time.
    """

    deceleration: Array
    holds: NDArray[np.bool_]


def discrete_time_condition(
    limits: JointLimits, dt: float, margin: ArrayLike | None = None
) -> NDArray[np.bool_]:
    """Return for which joints one braking step at either end stays inside the limits: eq. (11).

    Where it fails, the viability kernel is smaller than that of continuous time, eq. (10), and
    Algorithms 1 to 3 are too permissive.

    Args:
        limits: of n joints.
        dt: step, s.
        margin: shape (n,), rad/s^2, or None for zeros.

    Returns:
        shape (n,), bool.

    Raises:
        JointLimitsError: `dt` or `margin` is unusable in itself.
    """
    return _holds(limits, checked_step(dt), checked_margin(margin, limits))


def kernel_braking(limits: JointLimits, dt: float, margins: Array, exact: bool) -> KernelBraking:
    """Return the decelerations that the kernel of each joint counts on.

    Args:
        limits: of n joints.
        dt: step, s.
        margins: shape (n,), rad/s^2, checked.
        exact: where (11) fails, keep the full braking of a joint without margin, because the
            caller computes the kernel of discrete time. Otherwise reduce it until (11) holds,
            as the paper suggests, which gives a smaller kernel.

    Raises:
        JointLimitsError: a margin is too large for any kernel of this form.
    """
    w = margins[:, None]
    holds = _holds(limits, dt, margins)
    deceleration = np.stack([-limits.a_min, limits.a_max], axis=1) - w
    for j in np.flatnonzero(~holds & ~(exact & (margins == 0.0))):
        reduced = _reduced_braking(limits, int(j), dt, float(margins[j]))
        if reduced is None:
            allowed = f"must be smaller, or the step of {dt:g} s shorter, to leave any kernel"
            raise JointLimitsError("margin", limits.names[j], float(margins[j]), allowed)
        deceleration[j] = reduced
    return KernelBraking(deceleration, holds)


def checked_step(dt: float, field: str = "dt") -> float:
    """Return `dt` as a float.

    Raises:
        JointLimitsError: not finite and positive.
    """
    try:
        value = float(dt)
    except (TypeError, ValueError):
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise JointLimitsError(field, None, dt, "must be finite and positive, in seconds")
    return value


def checked_margin(margin: ArrayLike | None, limits: JointLimits) -> Array:
    """Return the margin of each joint, shape (n,), rad/s^2, zeros for None.

    Raises:
        JointLimitsError: negative, or so large that nothing is left to brake with.
    """
    if margin is None:
        return np.zeros(len(limits))
    margins = joint_array("margin", margin, limits.names)
    for name, w, low, high in zip(
        limits.names, margins.tolist(), limits.a_min, limits.a_max, strict=True
    ):
        most = min(-low, high)
        if not 0.0 <= w < most:
            raise JointLimitsError(
                "margin", name, w, f"must be at least 0 and below min(-a_min, a_max) = {most:g}"
            )
    return margins


def _holds(limits: JointLimits, dt: float, margins: Array) -> NDArray[np.bool_]:
    """Return whether (11) holds for full braking, shape (n,)."""
    w = margins[:, None]
    full = np.stack([-limits.a_min, limits.a_max], axis=1)
    exists = np.isfinite(np.stack([limits.q_max, limits.q_min], axis=1))
    with np.errstate(over="ignore"):  # steps of any length
        # Speed at the end of a step whose braking was needed only at its beginning.
        back = (full + w) * dt
        room = 0.5 * dt * back * (1.0 + (full + w) / (full[:, ::-1] - w))
    v_max, length = limits.v_max, limits.q_max - limits.q_min
    slow = back <= (v_max * (1.0 + ROUNDING))[:, None]
    fits = room <= (length * (1.0 + ROUNDING))[:, None]
    bounded = ((slow & fits) | ~exists).all(axis=1)
    return np.where(exists.any(axis=1), bounded, margins * dt <= v_max)


def _reduced_braking(
    limits: JointLimits, j: int, dt: float, w: float
) -> tuple[float, float] | None:
    """Return braking of joint j towards both limits with which (11) holds, or None.

    First the largest B for both: the position part is B^2 + (3 W - L / dt^2) B + 2 W^2 <= 0.
    Where the weaker side cannot use more, the stronger is then given what (11) leaves it, which
    only makes (11) easier for the weaker one.
    """
    q_min, q_max = float(limits.q_min[j]), float(limits.q_max[j])
    if math.isinf(q_min) and math.isinf(q_max):
        return None
    full = (-float(limits.a_min[j]), float(limits.a_max[j]))
    fastest = float(limits.v_max[j]) / dt - 2.0 * w
    b = min(*full, fastest + w) - w
    steps = (q_max - q_min) / dt / dt
    spare = steps - 3.0 * w
    if spare < math.inf:
        root = spare * spare - 8.0 * w * w
        if spare <= 0.0 or root < 0.0:
            return None
        largest = 0.5 * (spare + math.sqrt(root))
        if b < 2.0 * w * w / largest:
            return None
        b = min(b, largest)
    if b <= 0.0:
        return None
    # (B + 2 W)^2 / b + (B + 2 W) <= 2 L / dt^2 for the stronger side, without a difference.
    stronger = (
        4.0 * steps / (1.0 + math.sqrt(1.0 + 8.0 * steps / b)) if steps < math.inf else steps
    )
    stronger = max(b, min(stronger - 2.0 * w, fastest, max(full) - w))
    return (stronger, b) if full[0] > full[1] else (b, stronger)
