# SPDX-License-Identifier: Apache-2.0
"""The braking plan of one joint; compiled.

It moves for N control periods more; its deceleration rises in m of them, and falls in the last w.
With a the acceleration of the period before and d the deceleration between,

    a_k = a (1 - r_k) - d p_k,   r_k = min((k+1)/m, 1),   p_k = min((k+1)/m, 1, (N-k)/w),

for k = 0 .. N-1, and d such that the joint stands after them. Within a period the acceleration is
constant. With m = w = 1 that is one constant deceleration from now until the stop.

Arguments: position q, rad, and velocity v, rad/s, at the beginning; acceleration a of the period
before, rad/s^2; N, m, and w, at most N + 1 - m; control period dt, s; lowest and highest position,
q_min and q_max, rad.
"""

from __future__ import annotations

from math import ceil, floor

import numpy as np

from viability_bounds_pkg.compiled import compiled

ROUNDING = 1e-9
"""Of numbers of periods."""


@compiled
def joint_shape(v: float, a: float, N: int, m: int, w: int, dt: float) -> tuple[float, float]:
    """Return d, and the change of the acceleration in each of the first m periods."""
    d = (v / dt + 0.5 * a * (m - 1)) / (N - 0.5 * (m + w) + 1.0)
    return d, -(a + d) / m


@compiled
def after(
    q: float, v: float, count: float, a: float, change: float, dt: float
) -> tuple[float, float]:
    """Return position and velocity after `count` periods.

    `a` is the acceleration in the first of them, `change` that from each to the next, rad/s^2.
    """
    pairs = 0.5 * count * (count - 1.0)
    moved = a * (pairs + 0.5 * count) + change * pairs * ((count - 2.0) / 3.0 + 0.5)
    return q + dt * count * v + dt * dt * moved, v + dt * (a * count + change * pairs)


@compiled
def joint_state(
    q: float, v: float, a: float, N: int, m: int, w: int, dt: float, k: int
) -> tuple[float, float, float]:
    """Return position, velocity and acceleration at the beginning of period k.

    They are linear in (q, v, a).
    """
    d, change = joint_shape(v, a, N, m, w, dt)
    if k < m and k < N:
        q, v = after(q, v, k, a + change, change, dt)
        return q, v, a + (k + 1) * change
    q, v = after(q, v, m, a + change, change, dt)
    falls = max(m, N - w + 1)
    if k < falls and k < N:
        q, v = after(q, v, k - m, -d, 0.0, dt)
        return q, v, -d
    q, v = after(q, v, min(falls, N) - m, -d, 0.0, dt)
    begins, change = -d * (N - falls) / w, d / w
    if k < N:
        q, v = after(q, v, k - falls, begins, change, dt)
        return q, v, begins + (k - falls) * change
    q, _ = after(q, v, max(N - falls, 0), begins, change, dt)
    return q, 0.0, 0.0


@compiled
def joint_excess(
    q: float,
    v: float,
    a: float,
    N: int,
    m: int,
    w: int,
    dt: float,
    q_min: float,
    q_max: float,
    v_max: float,
    change_max: float,
) -> tuple[float, float]:
    """Return by how far the plan, or the present state, passes its limits at worst.

    The excess of position, rad; and that of speed and of the change of acceleration from period to
    period, as a share of their limits `v_max`, rad/s, and `change_max`, rad/s^2.
    """
    end, _, _ = joint_state(q, v, a, N, m, w, dt, N)
    high, low = max(q, end), min(q, end)
    fast = abs(v) / v_max - 1.0
    if m == 1 and w == 1:
        first = abs(-v / (dt * N) - a)
        change = max(first, abs(v) / (dt * N)) / change_max - 1.0
        return max(high - q_max, q_min - low), max(fast, change)
    d, rising = joint_shape(v, a, N, m, w, dt)
    change = max(abs(rising), abs(d) / w)
    # The acceleration changes its sign once at most, while it rises, before the period `turn`.
    # Until then speed grows or the motion turns round; from then on it only slows down.
    begins = a + rising
    if begins * -d < 0.0:
        turn = min(ceil(-begins / rising), m - 1)
        place, speed = after(q, v, turn, begins, rising, dt)
        high, low = max(high, place), min(low, place)
        fast = max(fast, abs(speed) / v_max - 1.0)
        if v * speed < 0.0:
            near, far = 0, turn  # it stands between
            while far - near > 1:
                middle = (near + far) // 2
                _, between = after(q, v, middle, begins, rising, dt)
                if v * between < 0.0:
                    far = middle
                else:
                    near = middle
            place, speed = after(q, v, near, begins, rising, dt)
            beyond = place + 0.5 * speed * dt  # at most: it stands within this period
            high, low = max(high, beyond), min(low, beyond)
    return max(high - q_max, q_min - low), max(fast, change / change_max - 1.0)


@compiled
def joint_course(
    q: float,
    v: float,
    a: float,
    T: float,
    q_min: float,
    q_max: float,
    tolerance: float,
    braking: float,
    gentle: float,
    dt: float,
) -> tuple[int, int, int]:
    """Return N, m and w in the plan of time `T`, s.

    The joint may stand beyond a limit by `tolerance`, rad, where only braking harder than A,
    `braking`, rad/s^2, would help. `gentle` is the change of its acceleration from period to
    period, rad/s^2, inf for any.
    """
    speed = abs(v)
    if gentle == np.inf:
        room = q_max - q if v > 0.0 else q - q_min
        periods = max(ceil(max(T, speed / braking) / dt - ROUNDING), 1)
        if speed > 0.0 and 0.5 * speed * periods * dt > room:
            most = floor(2.0 * max(room, 0.0) / (speed * dt) + ROUNDING)
            beyond = floor(2.0 * max(room + tolerance, 0.0) / (speed * dt) + ROUNDING)
            hardest = ceil(speed / (braking * dt) - ROUNDING)
            periods = max(most, min(hardest, beyond), 1)
        return periods, 1, 1
    wanted = max(ceil(T / dt - ROUNDING), 1)
    best = _gentle_course(v, a, wanted, braking, gentle, dt)
    if passed(q, v, a, best, q_min, q_max, dt) > 0.0:
        least = 1
        best = _gentle_course(v, a, least, braking, gentle, dt)
        # The longest that stands before the limit; the hardest where none does.
        while wanted - least > 1:
            middle = (least + wanted) // 2
            trial = _gentle_course(v, a, middle, braking, gentle, dt)
            if passed(q, v, a, trial, q_min, q_max, dt) > 0.0:
                wanted = middle
            else:
                least, best = middle, trial
    return best


@compiled
def passed(
    q: float,
    v: float,
    a: float,
    course: tuple[int, int, int],
    q_min: float,
    q_max: float,
    dt: float,
) -> float:
    """Return by how far a plan passes the position limits, rad."""
    N, m, w = course
    return joint_excess(q, v, a, N, m, w, dt, q_min, q_max, np.inf, np.inf)[0]


@compiled
def _gentle_course(
    v: float, a: float, wanted: int, braking: float, gentle: float, dt: float
) -> tuple[int, int, int]:
    """Return N, at least as wanted, m and w with which a joint brakes with A at most."""
    N, m, w = wanted, 1, 1
    for _ in range(20):
        impulse = v / dt + 0.5 * a * (m - 1)
        N = max(wanted, ceil(abs(impulse) / braking + 0.5 * (m + w) - 1.0 - ROUNDING), m + w - 1)
        d = impulse / (N - 0.5 * (m + w) + 1.0)
        # They only grow, so it ends; with N they grow less and less.
        rising = max(m, ceil(abs(a + d) / gentle - ROUNDING))
        falling = max(w, ceil(abs(d) / gentle - ROUNDING))
        if rising == m and falling == w:
            break
        m, w = rising, falling
    return N, m, w
