"""Numbers of one step of `state_dependent_limits`, compiled: who needs how much braking."""

from __future__ import annotations

from math import inf

import numpy as np

from viability_bounds_pkg.compiled import compiled


def most_braking(limits, peak, margin, least, sides, dt):
    """Return the braking that the kernel may count on at most, shape (n, 2), rad/s^2.

    The acceleration asked for stays within `peak`, and condition (11) holds whatever the other
    side counts on; see `condition_11`. Never less than `least`, the worst case.

    Args:
        limits: position and velocity limits.
        peak: shape (n,), rad/s^2.
        margin: shape (n,), rad/s^2.
        least: shape (n, 2), rad/s^2.
        sides: of `bounds_kernel.Table`.
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
    has_curve = sides[:, :, 12] > 0
    return np.where(has_curve, least, np.maximum(most, least))


@compiled
def available(M, h, tau_max, a_min, a_max, peak):
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
        drift = 0.0
        for i in range(n):
            spread += abs(inverse[j, i]) * tau_max[i]
            drift -= inverse[j, i] * h[i]
        high[j] = min(peak[j], max(a_max[j], drift + spread))
        low[j] = -min(peak[j], max(-a_min[j], spread - drift))
        braking[j, 0] = (tau_max[j] + h[j]) / M[j, j]
        braking[j, 1] = (tau_max[j] - h[j]) / M[j, j]
    return low, high, braking


@compiled
def needed_towards(room, speed, least, tolerance):
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
def needed_braking(q, v, ranges, least, tolerance, needed):
    """Fill in what each joint needs now, shape (n, 2), and return whether any needs more."""
    urgent = False
    for j in range(q.size):
        above, below = ranges[j, 1] - q[j], q[j] - ranges[j, 0]
        needed[j, 0] = needed_towards(above, v[j], least[j, 0], tolerance[j])
        needed[j, 1] = needed_towards(below, -v[j], least[j, 1], tolerance[j])
        urgent |= needed[j, 0] > least[j, 0] or needed[j, 1] > least[j, 1]
    return urgent


@compiled
def set_sides(sides, braking, v_max, low, high, dt):
    """Make the rows of `bounds_kernel.Table.sides` those of other brakings and input limits.

    Args:
        sides: shape (n, 2, 15), changed in place.
        braking: of the kernel, shape (n, 2), rad/s^2.
        v_max: shape (n,), rad/s.
        low: input limits, shape (n,), rad/s^2.
        high: shape (n,), rad/s^2.
        dt: step, s.
    """
    for j in range(v_max.size):
        for s in range(2):
            b = braking[j, s]
            row = sides[j, s]
            if row[12] == 0.0:  # else the braking is as it was, and belongs to a stopping curve
                k = 0.5 * b * dt
                row[2], row[3], row[4] = 2.0 * b, k, max(k * k, 1e-300)
                row[5] = 0.5 * dt * v_max[j] + 0.5 * v_max[j] * v_max[j] / b
            row[7] = low[j] if s == 0 else -high[j]
            row[8] = high[j] if s == 0 else -low[j]


@compiled
def reach_of_step(q, v, lower, upper, dt, margin, ranges, braking, reach):
    """Fill in where a step may end and how the joints brake from there.

    Args:
        q: shape (n,), rad.
        v: shape (n,), rad/s.
        lower: bounds of the step, shape (n,), rad/s^2.
        upper: shape (n,), rad/s^2.
        dt: control period, s.
        margin: acceleration kept back, shape (n,), rad/s^2.
        ranges: of `bounds_kernel.Table`.
        braking: of the kernel in which the bounds keep the joints, shape (n, 2), rad/s^2.
        reach: shape (5, n), receives middle and deviation of q and v, and the braking, as in
            `braking_certificate.Reach`.

    Returns:
        Time until all joints stand still, s.
    """
    horizon = 0.0
    for j in range(q.size):
        v_low, v_high = v[j] + lower[j] * dt, v[j] + upper[j] * dt
        q_low, q_high = q[j] + 0.5 * (v[j] + v_low) * dt, q[j] + 0.5 * (v[j] + v_high) * dt
        reach[0, j], reach[1, j] = 0.5 * (q_low + q_high), 0.5 * (v_low + v_high)
        reach[2, j] = 0.5 * (q_high - q_low)
        reach[3, j] = 0.5 * (v_high - v_low) + margin[j] * dt
        reach[4, j] = margin[j] + braking[j, 0 if v_low + v_high > 0.0 else 1]
        if v_low < 0.0 < v_high:
            # Either way is possible: what both limits need is enough for the one that counts.
            reach[4, j] = margin[j] + min(braking[j, 0], braking[j, 1])
        horizon = max(horizon, (abs(reach[1, j]) + reach[3, j]) / reach[4, j])
    return horizon


@compiled
def stopping_acceleration(v, braking, dt, lower, upper):
    """Return the acceleration along the braking path, inside the bounds, shape (n,), rad/s^2."""
    a = np.empty(v.size)
    for j in range(v.size):
        rate = min(braking[j], abs(v[j]) / dt)
        a[j] = min(max(-rate if v[j] > 0.0 else rate, lower[j]), upper[j])
    return a
