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


class KernelBraking(NamedTuple):
    """Decelerations that the kernel of each joint counts on.

    Attributes:
        deceleration: towards the upper and the lower limit, shape (n, 2), rad/s^2.
        holds: whether (11) holds for the full braking, shape (n,); if not, either the braking
            is reduced or the kernel is not the one of continuous time.
    """

    deceleration: NDArray[np.float64]
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
    dt = checked_step(dt)
    margins = checked_margin(margin, limits)
    return np.array([_holds(_joint(limits, j), dt, w) for j, w in enumerate(margins)])


def kernel_braking(
    limits: JointLimits, dt: float, margins: NDArray[np.float64], exact: bool
) -> KernelBraking:
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
    decelerations, fulfilled = [], []
    for j, w in enumerate(margins.tolist()):
        joint = _joint(limits, j)
        up, lo = joint.braking
        holds = _holds(joint, dt, w)
        pair: tuple[float, float] | None = (up - w, lo - w)
        if not holds and not (exact and w == 0.0):
            pair = _reduced_braking(joint, dt, w)
        if pair is None:
            allowed = f"must be smaller, or the step of {dt:g} s shorter, to leave any kernel"
            raise JointLimitsError("margin", limits.names[j], w, allowed)
        decelerations.append(pair)
        fulfilled.append(holds)
    return KernelBraking(np.array(decelerations), np.array(fulfilled))


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


def checked_margin(margin: ArrayLike | None, limits: JointLimits) -> NDArray[np.float64]:
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


class _Joint(NamedTuple):
    length: float
    v_max: float
    braking: tuple[float, float]
    """Towards the upper and the lower limit."""
    ends: tuple[tuple[float, float], ...]
    """Towards each limit that exists: braking, and braking towards the opposite one."""


def _joint(limits: JointLimits, j: int) -> _Joint:
    up, lo = -float(limits.a_min[j]), float(limits.a_max[j])
    ends = []
    if limits.q_max[j] < math.inf:
        ends.append((up, lo))
    if limits.q_min[j] > -math.inf:
        ends.append((lo, up))
    length = float(limits.q_max[j] - limits.q_min[j])
    return _Joint(length, float(limits.v_max[j]), (up, lo), tuple(ends))


def _holds(joint: _Joint, dt: float, w: float) -> bool:
    if not joint.ends:
        return w * dt <= joint.v_max
    for braking, opposite in joint.ends:
        # Speed at the end of a step whose braking was needed only at its beginning.
        back = (braking + w) * dt
        if back > joint.v_max * (1.0 + ROUNDING):
            return False
        room = 0.5 * dt * back * (1.0 + (braking + w) / (opposite - w))
        if room > joint.length * (1.0 + ROUNDING):
            return False
    return True


def _reduced_braking(joint: _Joint, dt: float, w: float) -> tuple[float, float] | None:
    """Return braking towards the upper and lower limit with which (11) holds, or None.

    First the largest B for both: the position part is B^2 + (3 W - L / dt^2) B + 2 W^2 <= 0.
    Where the weaker side cannot use more, the stronger is then given what (11) leaves it, which
    only makes (11) easier for the weaker one.
    """
    if not joint.ends:
        return None
    fastest = joint.v_max / dt - 2.0 * w
    b = min(*joint.braking, fastest + w) - w
    steps = joint.length / dt / dt
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
    stronger = max(b, min(stronger - 2.0 * w, fastest, max(joint.braking) - w))
    return (stronger, b) if joint.braking[0] > joint.braking[1] else (b, stronger)
