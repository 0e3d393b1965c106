# SPDX-License-Identifier: Apache-2.0
"""The discrete-time condition (11) of [DelPrete2018]: when braking at full rate is safe.

Asymmetric limits, a margin for disturbances and continuous joints are worked out in
`docs/bounds.md`, errors of the state in `docs/uncertainty.md`. With B_up, B_lo the decelerations
that the kernel counts on towards the upper and the lower limit, W the margin, E_q and E_v the
largest errors of position and velocity, and

    b = B_up + 2 W + 2 E_v / dt,    L = q_max - q_min - 2 E_q - E_v dt,

it reads, for both ends,

    b dt <= v_max,    L >= dt^2 / 2 b (1 + b / B_lo).

Where it fails, the step is shortened, and then the braking reduced, until it holds.
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


class Margins(NamedTuple):
    """What bounds of n joints must hold for; each of shape (n,).

    Attributes:
        acceleration: W, by which the acceleration may differ from the commanded one, rad/s^2.
        position: E_q, by which the position may differ from the one told, rad.
        velocity: E_v, the same of the velocity, rad/s.
    """

    acceleration: Array
    position: Array
    velocity: Array

    @classmethod
    def of(
        cls,
        limits: JointLimits,
        margin: ArrayLike | None,
        position_error: ArrayLike | None,
        velocity_error: ArrayLike | None,
    ) -> Margins:
        """Return checked margins; None stands for zeros.

        Raises:
            JointLimitsError: one is negative, or leaves nothing of the limits.
        """
        braking = np.minimum(-limits.a_min, limits.a_max)
        half = 0.5 * (limits.q_max - limits.q_min)
        any_size = np.full(len(limits), np.inf)
        return cls(
            _checked("margin", margin, limits, braking, "min(-a_min, a_max), {:g} rad/s^2"),
            _checked("position_error", position_error, limits, half, "half the range, {:g} rad"),
            _checked("velocity_error", velocity_error, limits, any_size, ""),
        )


def _checked(
    field: str, values: ArrayLike | None, limits: JointLimits, most: Array, what: str
) -> Array:
    if values is None:
        return np.zeros(len(limits))
    array = joint_array(field, values, limits.names)
    for name, value, end in zip(limits.names, array.tolist(), most.tolist(), strict=True):
        if not 0.0 <= value < end:
            below = f"below {what.format(end)}" if end < math.inf else "finite"
            raise JointLimitsError(field, name, value, f"must be at least 0 and {below}")
    return array


class DiscreteTime(NamedTuple):
    """Steps and decelerations of n joints for which condition (11) holds.

    Attributes:
        steps: shape (n,), s.
        braking: that the kernel counts on, towards the upper and the lower limit, shape (n, 2),
            rad/s^2.
        full: whether that is all there is, less the margin, shape (n,), bool.
    """

    steps: Array
    braking: Array
    full: NDArray[np.bool_]


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
    return _holds(limits, dt, Margins.of(limits, margin, position_error, velocity_error))


def discrete_time(
    limits: JointLimits, dt: float, shortest: float, margins: Margins
) -> DiscreteTime:
    """Return the longest step, and for it the largest braking, for which (11) holds.

    Of each joint the step is `dt`, half of it, half of that and so on, at least `shortest`. If
    (11) holds for none of them, the braking is reduced, as the paper suggests.

    Args:
        limits: of n joints.
        dt: longest step, s.
        shortest: shortest step, s.
        margins: of these joints.

    Raises:
        JointLimitsError: a margin or an error is too large for any kernel of this form.
    """
    step, steps = dt, np.full(len(limits), dt)
    found = _holds(limits, step, margins)
    while step > shortest and not found.all():
        step = max(0.5 * step, shortest)
        steps[~found] = step
        found |= _holds(limits, step, margins)
    braking = np.stack([-limits.a_min, limits.a_max], axis=1) - margins.acceleration[:, None]
    for j in np.flatnonzero(~found):
        reduced = _reduced_braking(limits, int(j), float(steps[j]), margins)
        if reduced is None:
            raise _no_kernel(limits.names[j], float(steps[j]), margins, int(j))
        braking[j] = reduced
    return DiscreteTime(steps, braking, found)


def _no_kernel(joint: str, step: float, margins: Margins, j: int) -> JointLimitsError:
    margin, _, error = (float(each[j]) for each in margins)
    if margin == error == 0.0:
        return JointLimitsError("dt", joint, step, "must be shorter to leave any kernel")
    field, value = ("velocity_error", error) if error > 0.0 else ("margin", margin)
    allowed = f"must be smaller, or the step of {step:g} s shorter, to leave any kernel"
    return JointLimitsError(field, joint, value, allowed)


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


def without_position_error(limits: JointLimits, errors: Array) -> JointLimits:
    """Return the limits in which a reported position must be for the true one to be in `limits`.

    Args:
        limits: of n joints.
        errors: of reported positions, shape (n,), rad.
    """
    if not errors.any():
        return limits
    return replace(limits, q_min=limits.q_min + errors, q_max=limits.q_max - errors)


def _holds(limits: JointLimits, dt: float, margins: Margins) -> NDArray[np.bool_]:
    """Return whether (11) holds for full braking, shape (n,)."""
    limits = without_position_error(limits, margins.position)
    w, error = margins.acceleration[:, None], margins.velocity[:, None]
    spread = margins.acceleration + margins.velocity / dt
    full = np.stack([-limits.a_min, limits.a_max], axis=1)
    exists = np.isfinite(np.stack([limits.q_max, limits.q_min], axis=1))
    with np.errstate(over="ignore"):  # steps of any length
        # Speed at the end of a step whose braking was needed only at its beginning.
        hardest = full + w + 2.0 * error / dt
        back = hardest * dt
        room = 0.5 * dt * back * (1.0 + hardest / (full[:, ::-1] - w))
    v_max, length = limits.v_max, limits.q_max - limits.q_min - dt * margins.velocity
    slow = back <= (v_max * (1.0 + ROUNDING))[:, None]
    fits = room <= (length * (1.0 + ROUNDING))[:, None]
    bounded = ((slow & fits) | ~exists).all(axis=1)
    return np.where(exists.any(axis=1), bounded, spread * dt <= v_max)


def _reduced_braking(
    limits: JointLimits, j: int, dt: float, margins: Margins
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
    margin, off, error = (float(each[j]) for each in margins)
    full = (-float(limits.a_min[j]), float(limits.a_max[j]))
    w = margin + error / dt
    fastest = float(limits.v_max[j]) / dt - 2.0 * w
    b = min(*full, fastest + margin) - margin
    steps = ((q_max - off) - (q_min + off) - dt * error) / dt / dt
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
