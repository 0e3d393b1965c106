# SPDX-License-Identifier: Apache-2.0
"""Braking plans: every joint slows down at a constant rate until it stands, and stays there.

A joint with position q, rad, and velocity v, rad/s, that stands after N control periods of dt is,
at time t before,

    q(t) = q + v t - v t^2 / (2 N dt),   v(t) = v - v t / (N dt),   a(t) = -v / (N dt).

What is left of a plan after a period is the plan of N - 1 periods from the state then. So a plan
that keeps all limits, once found, is enough for ever.

Periods are whole numbers in float arrays of shape (plans, n), n being the number of joints.
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from viability_bounds_pkg.bounds.kernel import curve_braking

Array = NDArray[np.float64]

UNIFORM = 20
"""Samples at equal distances in time, the first at the beginning."""

RESERVE = 0.03
"""Share of the torque limits that plans leave: for what lies between their samples, for steps of
constant acceleration under held torque, and for small errors of the model."""

_ROUNDING = 1e-9
"""Of numbers of periods."""

_FAR = 1e12
"""Stands for infinite room, in accelerations times period squared."""


class PlanLimits(NamedTuple):
    """What plans of n joints keep to, arrays of shape (n,)."""

    q_min: Array
    """Lowest positions at which joints are to stand, rad."""
    q_max: Array
    """Highest, rad."""
    tolerance: Array
    """By how far they may stand beyond, where only braking harder than `braking` helps, rad."""
    braking: Array
    """Deceleration that plans prefer not to exceed, rad/s^2."""
    dt: float
    """Control period, s."""
    velocity_offset: Array
    """c of speed limits that depend on position, rad/s; 0 for none."""
    deceleration_limit: Array
    """d of them, rad/s^2."""


@njit(cache=True)
def braking_periods(q: Array, v: Array, times: Array, limits: PlanLimits) -> Array:
    """Return in how many periods each joint stands in the plans of given times.

    A joint takes longer where it would have to brake harder than `braking`, and less where it
    would pass a limit of position, or of speed at a position.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        times: shape (plans,), s.
        limits: that the plans keep.

    Returns:
        Periods, at least 1, shape (plans, n).
    """
    q_min, q_max, tolerance, braking, dt, offset, deceleration = limits
    periods = np.empty((times.size, q.size))
    for j in range(q.size):
        speed = abs(v[j])
        hardest = ceil(speed / (braking[j] * dt) - _ROUNDING)
        most = np.inf
        if 0.5 * dt * speed > 0.0:
            room = q_max[j] - q[j] if v[j] > 0.0 else q[j] - q_min[j]
            curve = offset[j], deceleration[j]
            inside = _periods_within(room, speed, dt, curve)
            tolerated = _periods_within(room + tolerance[j], speed, dt, curve)
            most = max(inside, min(hardest, tolerated), 1.0)
        for i in range(times.size):
            wanted = ceil(times[i] / dt - _ROUNDING)
            periods[i, j] = min(max(wanted, hardest, 1.0), most)
    return periods


@njit(cache=True)
def _periods_within(room: float, speed: float, dt: float, curve: tuple[float, float]) -> float:
    """Return the most periods in which a joint may stand; less than 1 where there are none."""
    c, d = curve
    if c == 0.0:
        return float(np.floor(room / (0.5 * dt * speed) + _ROUNDING))
    room -= 0.5 * c * c / d
    if room <= 0.0:
        return 0.0
    return float(np.floor(speed / (dt * curve_braking(room, speed, c, d)) + _ROUNDING))


@njit(cache=True)
def _room_needed(speed: float, deceleration: float, c: float, d: float) -> float:
    """Return the distance to the last place of rest that constant braking needs, c > 0, rad."""
    touch = deceleration * c / (d - deceleration) if deceleration < d else np.inf
    if touch < speed:
        return 0.5 * speed * speed / deceleration + 0.5 * c * touch / d
    return 0.5 * speed * (speed + 2.0 * c) / d


@njit(cache=True)
def narrow(
    q: Array, v: Array, plan: Array, lower: Array, upper: Array, limits: PlanLimits
) -> tuple[Array, Array]:
    """Return acceleration bounds, narrowed to those after which each joint by itself can stop.

    After a period of acceleration a, a joint of speed ``s A dt`` needs ceil(s) more to stop with
    A, `braking`. It stops before a limit at distance r if

        s (1 + ceil(s)) <= c = (2 r - v dt) / (A dt^2),

    so the largest s is ``min(h, c / (h + 1))``, h being the largest number with h^2 - 1 < c. Where
    its speed limit depends on position, it also ends the period below that.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        plan: accelerations of the plan in hand, which are always allowed, shape (n,), rad/s^2.
        lower: bounds, shape (n,), rad/s^2.
        upper: shape (n,), rad/s^2.
        limits: of the plans.

    Returns:
        Lower and upper bounds, shape (n,), rad/s^2; where nothing within those given is possible,
        what is nearest to them.
    """
    q_min, q_max, _, braking, dt, offsets, decelerations = limits
    low, high = np.empty_like(lower), np.empty_like(upper)
    for j in range(q.size):
        A = braking[j]
        for sign in (-1.0, 1.0):
            room = q_max[j] - q[j] if sign > 0.0 else q[j] - q_min[j]
            offset, d = offsets[j], decelerations[j]
            room -= 0.5 * offset * offset / d
            c = min((2.0 * room - sign * v[j] * dt) / (A * dt * dt), _FAR)
            h = max(ceil(np.sqrt(max(1.0 + c, 0.0))) - 1.0, 0.0)
            speed = A * dt * min(h, c / (h + 1.0))
            if offset > 0.0 and c > 0.0:
                k, part = 0.5 * d * dt + offset, A * dt * dt * c * d
                speed = min(speed, part / (k + np.sqrt(k * k + part)))
            most = (speed - sign * v[j]) / dt
            if sign > 0.0:
                high[j] = max(most, plan[j])
            else:
                low[j] = min(-most, plan[j])
        possible = low[j], high[j]
        low[j] = min(max(lower[j], possible[0]), possible[1])
        high[j] = min(max(upper[j], possible[0]), possible[1])
    return low, high


class Samples(NamedTuple):
    """States of plans at samples in time: equally spaced, where joints stop, and at rest.

    Arrays of shape (plans, samples, n), but for `clock`; `AT_REST` is the index of the last.
    """

    clock: Array
    """Periods since the beginning, shape (plans, samples)."""
    q: Array
    """rad."""
    v: Array
    """rad/s."""
    a: Array
    """rad/s^2."""


FIRST, AT_REST = 0, -1
"""Samples at the beginning of a plan and at its end."""


@njit(cache=True)
def sample(
    q: Array, v: Array, periods: Array, limits: PlanLimits
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the states of plans, as in `Samples`, and by how far they pass position limits.

    A speed limit that depends on position is passed by the distance by which it is too near.

    Args:
        q: positions at the beginning, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        periods: in which each joint stands, shape (plans, n).
        limits: of the plans.

    Returns:
        Samples; and the largest excess of a position beyond the tolerance, 0 for none, rad, shape
        (plans,).
    """
    q_min, q_max, tolerance, _, dt, offset, deceleration = limits
    plans, n = periods.shape
    clock = np.empty((plans, UNIFORM + 2 * n + 1))
    positions = np.empty((plans, clock.shape[1], n))
    velocities, accelerations = np.empty_like(positions), np.empty_like(positions)
    beyond = np.zeros(plans)
    for i in range(plans):
        longest = periods[i].max()
        for k in range(UNIFORM):
            clock[i, k] = k * longest / UNIFORM
        for j in range(n):
            clock[i, UNIFORM + j] = periods[i, j] - 1.0
            clock[i, UNIFORM + n + j] = periods[i, j]
        clock[i, AT_REST] = longest
        for j in range(n):
            time = dt * periods[i, j]
            way = 0.5 * v[j] * time
            excess = max(max(q[j], q[j] + way) - q_max[j], q_min[j] - min(q[j], q[j] + way))
            c, d = offset[j], deceleration[j]
            if c > 0.0 and v[j] != 0.0:
                room = q_max[j] - q[j] if v[j] > 0.0 else q[j] - q_min[j]
                needed = _room_needed(abs(v[j]), abs(v[j]) / time, c, d)
                excess = max(excess, needed + 0.5 * c * c / d - room)
            beyond[i] = max(beyond[i], excess - tolerance[j])
            for k in range(clock.shape[1]):
                left = max(1.0 - clock[i, k] / periods[i, j], 0.0)  # share of the time
                positions[i, k, j] = q[j] + way * (1.0 - left * left)
                velocities[i, k, j] = v[j] * left
                accelerations[i, k, j] = -v[j] / time if left > 0.0 else 0.0
    return clock, positions, velocities, accelerations, beyond


class BrakingPlans(NamedTuple):
    """Plans from one state, their torques and what they leave of the limits."""

    periods: Array
    """In which each joint stands, shape (plans, n)."""
    samples: Samples
    """States."""
    tau: Array
    """Torques that are needed, shape (plans, samples, n), N m."""
    loads: Array
    """The same, as shares of what plans may use, without sign."""
    peaks: Array
    """The largest load of each joint, shape (plans, n)."""
    slack: Array
    """Least share that each plan leaves; negative beyond the limit; shape (plans,)."""
    beyond: Array
    """By how far each passes a position limit, less the tolerance, rad; 0 for none."""


class PlanTorques:
    """Computes braking plans and their torques by inverse dynamics, all at once.

    Args:
        model: the arm, n joints with one coordinate each.
        limits: of the plans.
        usable: torque that plans may use, shape (n,), N m.
    """

    def __init__(self, model: pin.Model, limits: PlanLimits, usable: Array) -> None:
        self._limits, self._usable = limits, usable
        self.remodel(model)

    def remodel(self, model: pin.Model) -> None:
        """Go by the masses of `model` as they are now; a pool has copies of them."""
        self._pool = pin.ModelPool(model, 1)

    def evaluate(self, q: Array, v: Array, periods: Array, extra: Array) -> BrakingPlans:
        """Return the plans in which joints stand after `periods`.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            periods: shape (plans, n).
            extra: torque that the motors give besides that of the model, shape (n,), N m.
        """
        *states, beyond = sample(q, v, periods, self._limits)
        samples = Samples(*states)
        n = q.size
        tau = np.empty_like(samples.q)
        # Pinocchio takes a column for each sample.
        columns = [each.reshape(-1, n).T for each in (*samples[1:], tau)]
        pin.rneaInParallel(1, self._pool, *columns)
        tau += extra
        loads = np.abs(tau) / self._usable
        peaks = loads.max(axis=1)
        slack = 1.0 - peaks.max(axis=1)
        return BrakingPlans(periods, samples, tau, loads, peaks, slack, beyond)
