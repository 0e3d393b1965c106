"""The viability kernel when condition (11) of [DelPrete2018] fails.

Braking lasts whole steps: a joint that stops in front of one limit early in a step is thrown
back until the step ends, and may then be too fast, or too close to the other limit. Where (11)
fails this is what decides, and the kernel is smaller than that of continuous time.

`docs/bounds.md` derives the kernel: a state that moves towards a limit at speed v is viable if
and only if its room to that limit is at least U(v), where

    U(v) = v^2 / (2 (u + v))                      for v <= b,
    U(v) = v - b / 2 + U(v - b)                   for v > b,
    u    = max u <= min(v_max, b - v)  with  u^2 / (2 (u + v)) + S(u) <= length,

and S is the same function of the opposite limit: u is the speed at which the joint is thrown
back. All in units of the step, dt = 1: speeds and accelerations are lengths.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

INTERVALS = 1024
"""Pieces of a curve: chords this short cost less than 1e-7 of the acceleration range."""

CONVERGED = 1e-14
"""Largest change of a curve, relative to its length, at which the iteration ends. Each iteration
takes away all but 3 % of the error near the fixed point (17 % for each throw, two throws)."""

MAX_ITERATIONS = 60
BISECTIONS = 50


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

    def __call__(self, v: Array) -> Array:
        """Return the needed room at speeds `v`, shape (k,)."""
        if self.peak == np.inf:
            return np.interp(v, self.speed, self.room)
        whole = np.floor(v / self.braking)
        rest = v - whole * self.braking
        room = np.where(
            rest < self.peak,
            np.interp(rest, self.speed, self.room),
            rest * rest / (2.0 * self.braking),
        )
        return whole * rest + 0.5 * whole * whole * self.braking + room


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
    braking = (min(braking[0], most), min(braking[1], most))
    slow = 0.5 * min(length, v_max, *braking)
    grids = [np.linspace(0.0, min(b, 4.0 * length, v_max), INTERVALS + 1) for b in braking]
    curves: list[Callable[[Array], Array]] = [lambda v: v * (v / (2.0 * slow))] * 2
    rooms = [curves[0](grid) for grid in grids]
    for _ in range(MAX_ITERATIONS):
        backs = [_thrown_back(grids[i], curves[1 - i], length, v_max, braking[i]) for i in (0, 1)]
        updated = [_stopping_room(grids[i], backs[i]) for i in (0, 1)]
        change = max(float(np.max(rooms[i] - updated[i])) for i in (0, 1))
        rooms = updated
        curves = [_curve(grids[i], backs[i], rooms[i], braking[i]) for i in (0, 1)]
        if change <= CONVERGED * slow:
            break
    return curves[0], curves[1]


def _thrown_back(
    v: Array, opposite: Callable[[Array], Array], length: float, v_max: float, braking: float
) -> Array:
    """Return the largest speed at which a step that stops from `v` may end, backwards."""

    def fits(u: Array) -> NDArray[np.bool_]:
        return _stopping_room(u, v) + opposite(u) <= length

    low, high = np.zeros_like(v), np.clip(braking - v, 0.0, v_max)
    low = np.where(fits(high), high, low)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        inside = fits(middle)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return low


def _stopping_room(v: Array, u: Array) -> Array:
    """Return v^2 / (2 (u + v)): the way to rest if one step takes speed v to -u."""
    return v * np.divide(v, 2.0 * (u + v), out=np.zeros_like(v), where=v > 0.0)


def _curve(grid: Array, back: Array, room: Array, braking: float) -> StoppingCurve:
    free = back >= braking - grid
    if not free.any():
        return StoppingCurve(grid, room, braking, np.inf)
    end = int(np.argmax(free))
    return StoppingCurve(grid[: end + 1], room[: end + 1], braking, float(grid[end]))
