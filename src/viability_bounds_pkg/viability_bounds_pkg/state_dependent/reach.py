# SPDX-License-Identifier: Apache-2.0
"""Braking needed and available in one step, and where the step may end; compiled."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.joint_limits import JointLimits

Array = NDArray[np.float64]


def most_braking(
    limits: JointLimits,
    peak: Array,
    margin: Array,
    least: Array,
    curved: NDArray[np.bool_],
    dt: float,
) -> Array:
    """Return the braking that the kernel may count on at most, shape (n, 2), rad/s^2.

    The acceleration asked for stays within `peak`, and condition (11) holds whatever the other
    side counts on; see `discrete_time_condition`. Never less than `least`, the worst case.

    Args:
        limits: position and velocity limits.
        peak: shape (n,), rad/s^2.
        margin: shape (n,), rad/s^2.
        least: shape (n, 2), rad/s^2.
        curved: limits whose stopping curve is not a parabola, shape (n, 2).
        dt: step, s.
    """
    length = (limits.q_max - limits.q_min)[:, None]
    opposite = least[:, ::-1]
    # The largest x with x + x^2 / B_opposite <= 2 L / dt^2.
    x = np.minimum(
        0.5 * opposite * (np.sqrt(1.0 + 8.0 * length / (dt * dt * opposite)) - 1.0),
        (limits.v_max / dt)[:, None],
    )
    w = margin[:, None]
    most = np.minimum(peak[:, None] - w, x - 2.0 * w)
    return np.where(curved, least, np.maximum(most, least))


@compiled
def available(
    M: Array, h: Array, tau_max: Array, a_min: Array, a_max: Array, peak: Array
) -> tuple[Array, Array, Array]:
    """Return acceleration limits and braking that the torque limits leave in this state.

    Args:
        M: mass matrix, shape (n, n), kg m^2.
        h: bias torques, shape (n,), N m.
        tau_max: torque limits, shape (n,), N m.
        a_min: limits of the worst case, shape (n,), rad/s^2.
        a_max: shape (n,), rad/s^2.
        peak: never exceeded, shape (n,), rad/s^2.

    Returns:
        low, high: every acceleration of joint j that any torque within the limits gives, but
            not beyond `peak` and at least those of the worst case, shape (n,), rad/s^2.
        braking: with the other joints at constant speed, as Algorithm 4 has it, towards the
            upper and the lower limit, shape (n, 2), rad/s^2; may be negative.
    """
    n = h.size
    inverse = np.linalg.inv(M)
    low, high, braking = np.empty(n), np.empty(n), np.empty((n, 2))
    for j in range(n):
        spread = 0.0
        free = 0.0
        for i in range(n):
            spread += abs(inverse[j, i]) * tau_max[i]
            free -= inverse[j, i] * h[i]
        high[j] = min(peak[j], max(a_max[j], free + spread))
        low[j] = -min(peak[j], max(-a_min[j], spread - free))
        braking[j, 0] = (tau_max[j] + h[j]) / M[j, j]
        braking[j, 1] = (tau_max[j] - h[j]) / M[j, j]
    return low, high, braking


@compiled
def _needed_towards(room: float, speed: float, least: float, tolerance: float) -> float:
    """Return the braking with which a joint stops at a limit, but at least that of the worst case.

    Args:
        room: distance to the limit, rad.
        speed: towards it, rad/s.
        least: braking of the worst case, rad/s^2.
        tolerance: position that the margins allow for, rad.
    """
    if speed <= 0.0 or not speed * speed > 2.0 * least * (room + tolerance):
        return least
    return 0.5 * speed * speed / room if room > 0.0 else inf


@compiled
def needed_braking(
    q: Array, v: Array, limits: NDArray[np.void], least: Array, tolerance: Array
) -> Array:
    """Return the braking that each joint needs now, shape (n, 2), rad/s^2.

    Args:
        q: shape (n,), rad.
        v: shape (n,), rad/s.
        limits: of `JointTable`.
        least: braking of the worst case, shape (n, 2), rad/s^2.
        tolerance: position that the margins allow for, shape (n,), rad.
    """
    needed = np.empty((q.size, 2))
    for j in range(q.size):
        above, below = limits[j, 0].position - q[j], limits[j, 1].position + q[j]
        needed[j, 0] = _needed_towards(above, v[j], least[j, 0], tolerance[j])
        needed[j, 1] = _needed_towards(below, -v[j], least[j, 1], tolerance[j])
    return needed


@compiled
def reach_of_step(
    q: Array, v: Array, lower: Array, upper: Array, dt: float, margin: Array, braking: Array
) -> tuple[Array, Array, Array, Array, Array, float]:
    """Return the states in which a step may end and how the joints brake: the fields of `Reach`.

    Args:
        q: shape (n,), rad.
        v: shape (n,), rad/s.
        lower: bounds of the step, shape (n,), rad/s^2.
        upper: shape (n,), rad/s^2.
        dt: control period, s.
        margin: acceleration kept back, shape (n,), rad/s^2.
        braking: of the kernel in which the bounds keep the joints, shape (n, 2), rad/s^2.
    """
    n = q.size
    q_mid, v_mid, dq, dv, rate = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    horizon = 0.0
    for j in range(n):
        v_low, v_high = v[j] + lower[j] * dt, v[j] + upper[j] * dt
        q_low, q_high = q[j] + 0.5 * (v[j] + v_low) * dt, q[j] + 0.5 * (v[j] + v_high) * dt
        q_mid[j], v_mid[j] = 0.5 * (q_low + q_high), 0.5 * (v_low + v_high)
        dq[j] = 0.5 * (q_high - q_low)
        dv[j] = 0.5 * (v_high - v_low) + margin[j] * dt
        rate[j] = margin[j] + braking[j, 0 if v_low + v_high > 0.0 else 1]
        if v_low < 0.0 < v_high:
            # Either way is possible: what both limits need is enough for the one that counts.
            rate[j] = margin[j] + min(braking[j, 0], braking[j, 1])
        horizon = max(horizon, (abs(v_mid[j]) + dv[j]) / rate[j])
    return q_mid, v_mid, dq, dv, rate, horizon
