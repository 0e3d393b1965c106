# SPDX-License-Identifier: Apache-2.0
"""The discrete-time condition (11) of [DelPrete2018]: when braking at full rate is safe.

Asymmetric limits, a margin for disturbances, continuous joints and errors of the state are worked
out in `docs/theory/bounds.md`. With B_up, B_lo the decelerations
that the kernel counts on towards the upper and the lower limit, W the margin, E_q and E_v the
largest errors of position and velocity, and

    b = B_up + 2 W + 2 E_v / dt,    L = q_max - q_min - c^2 / d - 2 E_q - E_v dt,

it reads, for both ends,

    b dt <= v_max,    L >= dt^2 / 2 b (1 + 2 c / (d dt) + b / B_lo).

c and d are those of a speed limit that depends on position, c / d = 0 without.

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
        half = 0.5 * (limits.q_max - limits.q_min) - limits.rest_distance
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


def discrete_time(
    limits: JointLimits, dt: float, shortest: float, margins: Margins
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the longest step, and for it the largest braking, for which (11) holds.

    Of each joint the step is `dt`, half of it, half of that and so on, at least `shortest`. If
    (11) holds for none of them, the braking is reduced, as the paper suggests.

    Args:
        limits: of n joints.
        dt: longest step, s.
        shortest: shortest step, s.
        margins: of these joints.

    Returns:
        Steps, shape (n,), s; decelerations that the kernel counts on, towards the upper and the
        lower limit, shape (n, 2), rad/s^2; and whether those are all there is, less the margin,
        shape (n,).

    Raises:
        JointLimitsError: a margin or an error is too large for any kernel of this form.
    """
    step, steps = dt, np.full(len(limits), dt)
    braking, full = _largest_braking(limits, step, margins)
    while step > shortest and not full.all():
        step = max(0.5 * step, shortest)
        with_step, fits = _largest_braking(limits, step, margins)
        steps[~full], braking[~full] = step, with_step[~full]
        full |= fits
    for j in np.flatnonzero(np.isnan(braking).any(axis=1)):
        raise _no_kernel(limits.names[j], float(steps[j]), margins, int(j))
    return steps, braking, full


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
    return replace(limits, q_min=limits.q_min + errors, q_max=limits.q_max - errors)


def _largest_braking(
    limits: JointLimits, dt: float, margins: Margins
) -> tuple[Array, NDArray[np.bool_]]:
    """Return braking with which (11) holds, and whether it is all there is, less the margin.

    What would make a joint too fast is taken off at first. With z = 2 W + 2 E_v / dt, s = 1 + 2 c
    / (d dt), the position part is then, for equal braking B of both sides and for more of the
    stronger one, X,

        (s + 1) B^2 + ((s + 2) z - 2 L / dt^2) B + z^2 <= 0,
        (X + z) (s + (X + z) / B) <= 2 L / dt^2.

    Returns:
        Towards the upper and the lower limit, shape (n, 2), rad/s^2, NaN where there is none; and
        shape (n,).
    """
    inner = without_position_error(limits, margins.position)
    exists = np.isfinite(np.stack([inner.q_max, inner.q_min], axis=1))
    full = np.stack([-limits.a_min, limits.a_max], axis=1) - margins.acceleration[:, None]
    full = np.minimum(full, limits.deceleration_limit[:, None])
    spread = margins.acceleration + margins.velocity / dt
    length = inner.q_max - inner.q_min - 2.0 * limits.rest_distance - dt * margins.velocity
    with np.errstate(all="ignore"):  # steps of any length
        z, room = 2.0 * spread, 2.0 * length * (1.0 + ROUNDING) / dt / dt
        fastest = limits.v_max * (1.0 + ROUNDING) / dt - z
        b = np.where(exists, np.minimum(full, fastest[:, None]), full)
        s = 1.0 + 2.0 * limits.velocity_offset / limits.deceleration_limit / dt
        half = room - (s + 2.0) * z
        most = 0.5 * (half + np.sqrt(half * half - 4.0 * (s + 1.0) * z * z)) / (s + 1.0)
        equal = np.minimum(b.min(axis=1), most)
        possible = (equal > 0.0) & (equal >= z * z / (s + 1.0) / most)
        stronger = 0.5 * equal * (np.sqrt(s * s + 4.0 * room / equal) - s) - z
    continuous = ~exists.any(axis=1)
    possible = np.where(continuous, spread * dt <= limits.v_max, possible)
    stronger = np.where(continuous, np.inf, np.maximum(equal, stronger))
    braking = np.where(possible[:, None], np.minimum(b, stronger[:, None]), np.nan)
    is_full: NDArray[np.bool_] = np.all(braking >= full, axis=1)
    return braking, is_full
