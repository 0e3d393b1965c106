# SPDX-License-Identifier: Apache-2.0
"""The exact viability kernel, and bounds from it, when condition (11) of [DelPrete2018] fails.

A result beside the product, whose bounds reduce the braking there, as the paper advises, and so
allow less than this.

Braking lasts whole steps: a joint that stops in front of one limit early in a step is thrown
back until the step ends, and may then be too fast, or too close to the other limit. Where (11)
fails this is what decides, and the kernel is smaller than that of continuous time.

A state that moves towards a limit at speed v is viable if and only if its room to that limit is at
least U(v), where

    U(v) = v^2 / (2 (u + v))                      for v <= b,
    U(v) = v - b / 2 + U(v - b)                   for v > b,
    u    = max u <= min(v_max, b - v)  with  u^2 / (2 (u + v)) + S(u) <= length,

and S is the same function of the opposite limit: u is the speed at which the joint is thrown
back. All in units of the step, dt = 1: speeds and accelerations are lengths.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits
from viability_bounds_pkg.viability import AccelerationBounds

Array = NDArray[np.float64]

PIECES = (256, 256, 1024)
"""Chords of a curve: coarse twice, to find its kinks, then fine; see `_spread` for their cost."""

CONVERGED = 1e-13
"""Largest change of a curve, relative to its size, at which the iteration ends. One more step
takes away at least 80 % of what is missing."""

MAX_STEPS = 100
NEWTON_STEPS = 60
TINY = float(np.finfo(np.float64).tiny)


class StoppingCurve(NamedTuple):
    """Room that a joint needs to a limit, against its speed towards it: nodes and chords.

    Chords of the convex function U lie above it, so that the kernel they bound is an inner
    approximation; it is a controlled invariant set itself.

    Attributes:
        speed: nodes from 0 to `peak`, shape (m,).
        room: needed room at the nodes, shape (m,).
        braking: deceleration b, by which one step can reduce the speed.
        peak: speed from which on, up to b, the room is the parabola ``v^2 / (2 b)``; inf if no
            speed that the limits allow is that high.
    """

    speed: Array
    room: Array
    braking: float
    peak: float

    def room_and_slope(self, v: Array) -> tuple[Array, Array]:
        """Return the needed room at speeds `v`, shape (k,), and its derivative."""
        whole = np.zeros_like(v) if self.peak == math.inf else np.floor(v / self.braking)
        rest = np.maximum(v - whole * self.braking, 0.0)  # not below, by rounding
        with np.errstate(over="ignore"):  # Beyond the last node, if that is also the last speed.
            room, slope = rest * (rest / (2.0 * self.braking)), rest / self.braking
        (curved,) = np.nonzero(rest < self.peak)
        if curved.size:
            at = rest[curved]
            piece = np.clip(np.searchsorted(self.speed, at, "right"), 1, len(self.speed) - 1)
            slopes = np.diff(self.room) / np.diff(self.speed)
            room[curved] = np.interp(at, self.speed, self.room)
            slope[curved] = slopes[piece - 1]
        # One step of full braking from v takes v - b / 2 and leads to v - b.
        room += whole * rest
        room += 0.5 * whole * (whole * self.braking)
        return room, slope + whole

    def room_at(self, v: float) -> float:
        """Return the needed room at one speed."""
        return float(self.room_and_slope(np.array([v]))[0][0])


def stopping_curves(
    length: float, v_max: float, braking: tuple[float, float]
) -> tuple[StoppingCurve, StoppingCurve]:
    """Return U for the two limits of one joint, in units of the step.

    Args:
        length: distance between the limits; inf if one of them is missing.
        v_max: largest speed.
        braking: largest deceleration towards the first and the second limit.

    The iteration starts from a kernel that is small enough for (11) to hold and applies "one
    more step" until nothing changes, so that it meets the true kernel from inside.
    """
    # More than u + v is never of use, and no viable speed is above 4 times the length.
    most = min(16.0 * length, 4.0 * v_max)
    first, second = (min(b, most) for b in braking)
    joint = _Joint(length, v_max, (first, second))
    grids = [joint.coarse_grid(i) for i in (0, 1)]
    for pieces in PIECES[1:]:
        curves = joint.iterate(grids)
        grids = [joint.grid(i, curves, pieces) for i in (0, 1)]
    return joint.iterate(grids)


class _Joint(NamedTuple):
    """Arguments of `stopping_curves`; its limits are numbered 0 and 1."""

    length: float
    v_max: float
    braking: tuple[float, float]

    def iterate(self, grids: list[Array]) -> tuple[StoppingCurve, StoppingCurve]:
        """Return the fixed point of "one more step" among the chords between given speeds."""
        slow = 0.5 * min(self.length, self.v_max, *self.braking)
        start = StoppingCurve(np.zeros(1), np.zeros(1), slow, 0.0)
        curves = (start, start)
        rooms = [start.room_and_slope(grid)[0] for grid in grids]
        for _ in range(MAX_STEPS):
            backs = [self.thrown_back(i, grids[i], curves[1 - i]) for i in (0, 1)]
            updated = [_stopping_room(grids[i], backs[i]) for i in (0, 1)]
            change = max(float(np.max(rooms[i] - updated[i])) for i in (0, 1))
            rooms = updated
            first, second = (self.curve(i, grids[i], backs[i], rooms[i]) for i in (0, 1))
            curves = (first, second)
            if change <= CONVERGED * slow:
                break
        return curves

    def thrown_back(self, i: int, v: Array, opposite: StoppingCurve) -> Array:
        """Return the highest speed at which a step that stops from `v` may end, backwards.

        Newton's method on a convex increasing function, from above: it falls to the solution.
        """
        u = np.clip(self.braking[i] - v, 0.0, self.v_max)
        for _ in range(NEWTON_STEPS):
            total = np.maximum(u + v, TINY)
            room, slope = opposite.room_and_slope(u)
            excess = u * (u / (2.0 * total)) + room - self.length
            slope += u / total * (u + 2.0 * v) / (2.0 * total)
            step = np.maximum(excess, 0.0) / np.maximum(slope, TINY)
            u = np.maximum(u - step, 0.0)
            if np.all(step <= 1e-16 * u):
                break
        return u

    def curve(self, i: int, grid: Array, back: Array, room: Array) -> StoppingCurve:
        """Return the curve through given nodes, up to where full braking is free."""
        free = back >= self.braking[i] - grid
        if not free.any():
            return StoppingCurve(grid, room, self.braking[i], math.inf)
        end = int(np.argmax(free)) + 1
        return StoppingCurve(grid[:end], room[:end], self.braking[i], float(grid[end - 1]))

    def coarse_grid(self, i: int) -> Array:
        """Return nodes for curve i up to the highest speed that can matter."""
        return _spread(min(self.braking[i], 4.0 * self.length, self.v_max), PIECES[0])

    def grid(self, i: int, curves: tuple[StoppingCurve, StoppingCurve], pieces: int) -> Array:
        """Return nodes for curve i that resolve it, with its kinks among them.

        The coarse nodes beyond its peak stay: on the way to the fixed point it is higher up.
        """
        end = float(curves[i].speed[-1])
        coarse = self.coarse_grid(i)
        kinks = [kink for kink in self.kinks(curves)[i] if kink <= coarse[-1]]
        return np.unique(np.concatenate([_spread(end, pieces), kinks, coarse]))

    def kinks(self, curves: tuple[StoppingCurve, StoppingCurve]) -> list[list[float]]:
        """Return the speeds at which the curves have corners.

        They are where u meets one of its caps, `b - v` or `v_max`, and where u is a speed at
        which the opposite curve has a corner.
        """
        tops = [self.top(i, curves[1 - i]) for i in (0, 1)]
        found: list[list[float]] = [[top] for top in tops]
        # A top that is zero but for rounding is no corner.
        corners = [
            [top] if top > 1e-12 * b else [] for top, b in zip(tops, self.braking, strict=True)
        ]
        fresh = [[self.v_max, *self.repeat(1 - i, corners[1 - i])] for i in (0, 1)]
        for _ in range(MAX_STEPS):
            new = [
                [v for u in fresh[i] if 0.0 < (v := self.thrown_from(u, curves[1 - i])) < tops[i]]
                for i in (0, 1)
            ]
            if not any(new):
                break
            for i in (0, 1):
                found[i].extend(new[i])
            fresh = [self.repeat(1 - i, new[1 - i]) for i in (0, 1)]
        return found

    def repeat(self, i: int, speeds: list[float]) -> list[float]:
        """Return the speeds at which curve i repeats the corners at `speeds`."""
        top = min(self.v_max, self.braking[1 - i], 4.0 * self.length)
        count = int(top / self.braking[i]) + 1
        return [v + n * self.braking[i] for v in speeds for n in range(count)]

    def thrown_from(self, u: float, opposite: StoppingCurve) -> float:
        """Return the speed v at which `thrown_back` is u, or a negative number."""
        left = self.length - opposite.room_at(u)
        return 0.5 * u * u / left - u if left > 0.0 else -1.0

    def top(self, i: int, opposite: StoppingCurve) -> float:
        """Return the speed from which on full braking does not throw the joint too far."""
        b = self.braking[i]
        low, high = 0.0, min(b, self.v_max)
        while True:
            u = 0.5 * (low + high)
            if not low < u < high:
                return b - low
            if 0.5 * u * u / b + opposite.room_at(u) <= self.length:
                low = u
            else:
                high = u


def _spread(end: float, pieces: int) -> Array:
    """Return nodes from 0 to `end`, closer where U is more curved: for small speeds.

    Its second derivative is of the order of ``u^2 / (u + v)^3``, where u may be small, so that
    with squares of equally spaced numbers no chord is off by more than ``end / (13 pieces^2)``.
    """
    return end * np.linspace(0.0, 1.0, pieces + 1) ** 2


def _stopping_room(v: Array, u: Array) -> Array:
    """Return v^2 / (2 (u + v)): the way to rest if one step takes speed v to -u."""
    return v * np.divide(v, 2.0 * (u + v), out=np.zeros_like(v), where=v > 0.0)


def exact_bounds(q: Array, v: Array, limits: JointLimits, dt: float) -> AccelerationBounds:
    """Return the largest interval of accelerations that keeps one joint's limits for ever.

    Args:
        q: shape (m, 1), rad.
        v: shape (m, 1), rad/s.
        limits: of one joint.
        dt: step, s.

    Returns:
        Bounds as of `viability.acceleration_bounds`; of states that are not viable they mean
        nothing.
    """
    (q_min,), (q_max,), (v_max,) = limits.q_min, limits.q_max, limits.v_max
    up, lo = float(-limits.a_min[0]), float(limits.a_max[0])
    curves = stopping_curves(q_max - q_min, v_max * dt, (up * dt * dt, lo * dt * dt))
    sides = ((q_max - q, v, up, lo, curves[0]), (q - q_min, -v, lo, up, curves[1]))
    found = [_towards(*side, v_max, q_max - q_min, dt) for side in sides]
    (upper, below), (lower, above) = found
    viable = below & above & (np.abs(v) <= v_max * (1.0 + ROUNDING))
    return AccelerationBounds(-lower, upper, viable)


def _towards(
    room: Array,
    v: Array,
    braking: float,
    most: float,
    curve: StoppingCurve,
    v_max: float,
    length: float,
    dt: float,
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the largest acceleration towards a limit, and whether the state is viable."""
    table = _inverse(curve, v_max, length, dt)
    budget = room - 0.5 * dt * v
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (_end_speed(budget, table, curve, braking, v_max, dt) - v) / dt
        a = np.where((budget < 0.0) & (v > 0.0), -v * v / (2.0 * room), a)
    fastest = _end_speed(room + 0.5 * dt * v + 1e-12, table, curve, braking, v_max, dt)
    viable = (room >= -1e-12) & ((v <= 0.0) | (v <= fastest * (1.0 + ROUNDING) + 1e-12))
    return np.clip(a, -braking, most), viable


def _inverse(
    curve: StoppingCurve, v_max: float, length: float, dt: float
) -> tuple[Array, Array] | None:
    """Return budgets ``dt w / 2 + U(w)``, rad, and their end-of-step speeds w, rad/s."""
    if len(curve.speed) < 2:
        return None
    budgets, speeds, base = [], [], 0.0
    while base <= v_max * dt and (base == 0.0 or curve.room_at(base) <= length):
        whole = round(base / curve.braking)
        speed = base + curve.speed
        room = whole * curve.speed + 0.5 * whole * base + curve.room
        speeds.append(speed / dt)
        budgets.append(0.5 * speed + room)
        base += curve.braking
    return np.concatenate(budgets), np.concatenate(speeds)


def _end_speed(
    budget: Array,
    table: tuple[Array, Array] | None,
    curve: StoppingCurve,
    braking: float,
    v_max: float,
    dt: float,
) -> Array:
    """Return the largest end-of-step speed w <= v_max with ``dt w / 2 + U(w) <= budget``."""
    free = 0.5 * dt * v_max + curve.room_at(v_max * dt)
    budget = np.clip(budget, 0.0, free)
    k, c = 0.5 * braking * dt, 2.0 * braking * budget
    speed = c / (k + np.sqrt(k * k + c))
    if table is not None:
        curved = np.fmod(speed, curve.braking / dt) < curve.peak / dt
        speed = np.where(curved, np.interp(budget, *table), speed)
    return np.where(budget < free, np.minimum(speed, v_max), v_max)
