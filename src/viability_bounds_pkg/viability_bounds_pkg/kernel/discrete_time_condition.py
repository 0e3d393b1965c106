# SPDX-License-Identifier: Apache-2.0
"""The discrete-time condition (11) of [DelPrete2018]: when braking at full rate is safe.

Asymmetric limits, a margin for disturbances and continuous joints are worked out in
`docs/bounds.md`, errors of the state in `docs/uncertainty.md`. With B_up, B_lo the decelerations
that the kernel counts on towards the upper and the lower limit, W the margin, E_q and E_v the
largest errors of position and velocity, and

    b = B_up + 2 W + 2 E_v / dt,    L = q_max - q_min - 2 E_q - E_v dt,

it reads, for both ends,

    b dt <= v_max,    L >= dt^2 / 2 b (1 + b / B_lo).
"""

from __future__ import annotations

import math
from dataclasses import replace
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
    limits: JointLimits,
    dt: float,
    margin: ArrayLike | None = None,
    *,
    position_error: ArrayLike | None = None,
    velocity_error: ArrayLike | None = None,
) -> NDArray[np.bool_]:
    """Return for which joints one braking step at either end stays inside the limits: eq. (11).

    Where it fails, the viability kernel is smaller than that of continuous time, eq. (10), and
    Algorithms 1 to 3 are too permissive.

    Args:
        limits: of n joints.
        dt: step, s.
        margin: shape (n,), rad/s^2, or None for zeros.
        position_error: shape (n,), rad, or None for zeros.
        velocity_error: shape (n,), rad/s, or None for zeros.

    Returns:
        shape (n,), bool.

    Raises:
        JointLimitsError: an argument is unusable in itself.
    """
    dt = checked_step(dt)
    errors = checked_errors("velocity_error", velocity_error, limits)
    off = checked_errors("position_error", position_error, limits)
    inner = without_position_error(limits, off)
    return _holds(inner, dt, checked_margin(margin, limits), errors)


def kernel_braking(
    limits: JointLimits,
    dt: float,
    margins: Array,
    velocity_errors: Array,
    exact: NDArray[np.bool_],
) -> KernelBraking:
    """Return the decelerations that the kernel of each joint counts on.

    Args:
        limits: of n joints, those of position without the errors of position.
        dt: step, s.
        margins: shape (n,), rad/s^2, checked.
        velocity_errors: shape (n,), rad/s, checked.
        exact: shape (n,), bool: where (11) fails, keep the full braking, because the caller
            computes the kernel of discrete time. Otherwise reduce it until (11) holds, as the
            paper suggests, which gives a smaller kernel.

    Raises:
        JointLimitsError: a margin or an error is too large for any kernel of this form.
    """
    w = margins[:, None]
    holds = _holds(limits, dt, margins, velocity_errors)
    deceleration = np.stack([-limits.a_min, limits.a_max], axis=1) - w
    for j in np.flatnonzero(~holds & ~exact):
        margin, error = float(margins[j]), float(velocity_errors[j])
        reduced = _reduced_braking(limits, int(j), dt, margin, error)
        if reduced is None:
            allowed = f"must be smaller, or the step of {dt:g} s shorter, to leave any kernel"
            field, value = ("velocity_error", error) if error > 0.0 else ("margin", margin)
            raise JointLimitsError(field, limits.names[j], value, allowed)
        deceleration[j] = reduced
    return KernelBraking(deceleration, holds)


def longest_steps(
    limits: JointLimits, dt: float, held: float, margins: Array, velocity_errors: Array
) -> Array:
    """Return a step of each joint for which (11) holds: `dt`, half of it, half of that, and so on.

    Args:
        limits: of n joints, those of position without the errors of position.
        dt: longest step, s.
        held: shortest step, s.
        margins: shape (n,), rad/s^2, checked.
        velocity_errors: shape (n,), rad/s, checked.

    Returns:
        shape (n,), s, from `held` to `dt`; `dt` where (11) fails for all of them.
    """
    steps = np.full(len(limits), dt)
    found = _holds(limits, dt, margins, velocity_errors)
    step = dt
    while step > held and not found.all():
        step = max(0.5 * step, held)
        now = ~found & _holds(limits, step, margins, velocity_errors)
        steps[now] = step
        found |= now
    return steps


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


def checked_errors(field: str, errors: ArrayLike | None, limits: JointLimits) -> Array:
    """Return the largest error of each joint's position or velocity, shape (n,), zeros for None.

    Raises:
        JointLimitsError: negative or infinite.
    """
    if errors is None:
        return np.zeros(len(limits))
    checked = joint_array(field, errors, limits.names)
    for name, error in zip(limits.names, checked.tolist(), strict=True):
        if not 0.0 <= error < math.inf:
            raise JointLimitsError(field, name, error, "must be finite and at least 0")
    return checked


def without_position_error(limits: JointLimits, errors: Array) -> JointLimits:
    """Return the limits in which a reported position must be for the true one to be in `limits`.

    Args:
        limits: of n joints.
        errors: of reported positions, shape (n,), rad, checked.

    Raises:
        JointLimitsError: nothing is left of the range.
    """
    if not errors.any():
        return limits
    half = 0.5 * (limits.q_max - limits.q_min)
    for name, error, most in zip(limits.names, errors.tolist(), half.tolist(), strict=True):
        if not error < most:
            allowed = f"must be below half of the range, {most:g} rad"
            raise JointLimitsError("position_error", name, error, allowed)
    return replace(limits, q_min=limits.q_min + errors, q_max=limits.q_max - errors)


def _holds(
    limits: JointLimits, dt: float, margins: Array, velocity_errors: Array
) -> NDArray[np.bool_]:
    """Return whether (11) holds for full braking, shape (n,)."""
    w = margins[:, None]
    spread = margins + velocity_errors / dt
    full = np.stack([-limits.a_min, limits.a_max], axis=1)
    exists = np.isfinite(np.stack([limits.q_max, limits.q_min], axis=1))
    with np.errstate(over="ignore"):  # steps of any length
        # Speed at the end of a step whose braking was needed only at its beginning.
        hardest = full + w + 2.0 * velocity_errors[:, None] / dt
        back = hardest * dt
        room = 0.5 * dt * back * (1.0 + hardest / (full[:, ::-1] - w))
    v_max, length = limits.v_max, limits.q_max - limits.q_min - dt * velocity_errors
    slow = back <= (v_max * (1.0 + ROUNDING))[:, None]
    fits = room <= (length * (1.0 + ROUNDING))[:, None]
    bounded = ((slow & fits) | ~exists).all(axis=1)
    return np.where(exists.any(axis=1), bounded, spread * dt <= v_max)


def _reduced_braking(
    limits: JointLimits, j: int, dt: float, margin: float, velocity_error: float
) -> tuple[float, float] | None:
    """Return braking of joint j towards both limits with which (11) holds, or None.

    First the largest B for both: the position part is B^2 + (3 w - L / dt^2) B + 2 w^2 <= 0 with
    w = W + E_v / dt.
    Where the weaker side cannot use more, the stronger is then given what (11) leaves it, which
    only makes (11) easier for the weaker one.
    """
    q_min, q_max = float(limits.q_min[j]), float(limits.q_max[j])
    if math.isinf(q_min) and math.isinf(q_max):
        return None
    full = (-float(limits.a_min[j]), float(limits.a_max[j]))
    w = margin + velocity_error / dt
    fastest = float(limits.v_max[j]) / dt - 2.0 * w
    b = min(*full, fastest + margin) - margin
    steps = (q_max - q_min - dt * velocity_error) / dt / dt
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
    # (B + 2 w)^2 / b + (B + 2 w) <= 2 L / dt^2 for the stronger side, without a difference.
    stronger = (
        4.0 * steps / (1.0 + math.sqrt(1.0 + 8.0 * steps / b)) if steps < math.inf else steps
    )
    stronger = max(b, min(stronger - 2.0 * w, fastest, max(full) - margin))
    return (stronger, b) if full[0] > full[1] else (b, stronger)
