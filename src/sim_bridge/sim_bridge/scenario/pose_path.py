"""A path of the end effector over time, from point to point or round a circle.

Between two points the position is the quintic polynomial that meets position, velocity and
acceleration at both; the orientation turns about one axis, from rest to rest, by a share of

    s(x) = 10 x^3 - 15 x^4 + 6 x^5,   x = (t - t_0) / (t_1 - t_0).

The controller that follows the points interpolates them in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

POINTS_PER_TURN = 48
"""Of a circle: between them the quintic leaves a circle of 0.4 m by less than 0.1 um."""


class PathPoint(NamedTuple):
    """Where the end effector is to be at a time, in the base frame; it does not turn there."""

    time: float
    """s from the start of the path."""
    position: tuple[float, ...]
    """x, y, z, m."""
    orientation: tuple[float, ...]
    """Unit quaternion x, y, z, w."""
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
    """m/s."""
    acceleration: tuple[float, ...] = (0.0, 0.0, 0.0)
    """m/s^2."""


def angle_between(first: ArrayLike, second: ArrayLike) -> float:
    """Return the angle between two orientations, unit quaternions, rad, 0 to pi."""
    a, b = np.asarray(first), np.asarray(second)
    return 4.0 * math.atan2(*sorted((np.linalg.norm(a - b), np.linalg.norm(a + b))))


def sample(points: Sequence[PathPoint], t: float) -> tuple[Array, Array]:
    """Return where the path is at time t, s: position, shape (3,), and quaternion, shape (4,).

    Before the first point it is there, after the last at that.
    """
    times = [point.time for point in points]
    k = int(np.searchsorted(times, t, side="right"))
    if k == 0 or k == len(points):
        end = points[0 if k == 0 else -1]
        return np.array(end.position), np.array(end.orientation)
    first, second = points[k - 1], points[k]
    T = second.time - first.time
    x = (t - first.time) / T
    return _quintic(first, second, T, x), _turned(first.orientation, second.orientation, x)


def _quintic(first: PathPoint, second: PathPoint, T: float, x: float) -> Array:
    """Return the position a share x of the time T between two points, shape (3,), m."""
    p0, p1 = np.array(first.position), np.array(second.position)
    v0, v1 = T * np.array(first.velocity), T * np.array(second.velocity)
    a0, a1 = T**2 * np.array(first.acceleration), T**2 * np.array(second.acceleration)
    s = _smooth(x)[0]
    # The basis of quintic Hermite interpolation, for velocities and accelerations per T.
    return (
        p0 + (p1 - p0) * s
        + v0 * (x - 6 * x**3 + 8 * x**4 - 3 * x**5) + v1 * (-4 * x**3 + 7 * x**4 - 3 * x**5)
        + a0 * (x**2 - 3 * x**3 + 3 * x**4 - x**5) / 2 + a1 * (x**3 - 2 * x**4 + x**5) / 2
    )  # fmt: skip


def _turned(first: Sequence[float], second: Sequence[float], x: float) -> Array:
    """Return the orientation a share x of the time between two, shape (4,)."""
    a, b = np.array(first) / np.linalg.norm(first), np.array(second) / np.linalg.norm(second)
    b = b if a @ b >= 0.0 else -b
    half = 0.5 * angle_between(a, b)
    if half < 1e-9:
        return a
    s = _smooth(x)[0]
    return (math.sin((1.0 - s) * half) * a + math.sin(s * half) * b) / math.sin(half)


def _smooth(x: float) -> tuple[float, float, float]:
    """Return s(x), which goes from 0 to 1 from rest to rest, and its first two derivatives."""
    return (
        x**3 * (10.0 - 15.0 * x + 6.0 * x**2),
        30.0 * x**2 * (1.0 - x) ** 2,
        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x),
    )


def circle(
    centre: ArrayLike,
    radius: float,
    axes: tuple[ArrayLike, ArrayLike],
    orientation: Sequence[float],
    *,
    period: float,
    turns: float = 1.0,
    phase: float = 0.0,
    ramp: float | None = None,
) -> tuple[PathPoint, ...]:
    """Return points round a circle at constant orientation, from rest to rest.

    At angle th the end effector is at  centre + radius (cos(th) e_1 + sin(th) e_2),  with

        p'  = radius th' (-sin(th) e_1 + cos(th) e_2),
        p'' = radius (th'' (-sin(th) e_1 + cos(th) e_2) - th'^2 (cos(th) e_1 + sin(th) e_2)).

    Args:
        centre: shape (3,), m.
        radius: m.
        axes: e_1 and e_2, shape (3,) each, unit, at right angles.
        orientation: unit quaternion x, y, z, w.
        period: duration of a turn, s.
        turns: how many.
        phase: th at the start, rad.
        ramp: time in which it gets up to speed, and down again at the end, s, at most `turns`
            periods; it is added to the duration. None: the angle follows s(x) from beginning to
            end, and a turn takes `period` on average.
    """
    centre, e_1, e_2 = np.asarray(centre), *map(np.asarray, axes)
    duration = turns * period + (ramp or 0.0)
    points = []
    for t in np.linspace(0.0, duration, math.ceil(POINTS_PER_TURN * duration / period) + 1):
        th, rate, acceleration = _angle(float(t), duration, period, turns, ramp)
        out = math.cos(phase + th) * e_1 + math.sin(phase + th) * e_2
        along = math.cos(phase + th) * e_2 - math.sin(phase + th) * e_1
        points.append(
            PathPoint(
                float(t),
                tuple((centre + radius * out).tolist()),
                tuple(orientation),
                tuple((radius * rate * along).tolist()),
                tuple((radius * (acceleration * along - rate**2 * out)).tolist()),
            )
        )
    return tuple(points)


def _angle(
    t: float, duration: float, period: float, turns: float, ramp: float | None
) -> tuple[float, float, float]:
    """Return the angle from the start and its first two derivatives: rad, rad/s, rad/s^2."""
    full, top = 2.0 * math.pi * turns, 2.0 * math.pi / period
    if ramp is None:
        s, s_dot, s_ddot = _smooth(t / duration)
        return full * s, full * s_dot / duration, full * s_ddot / duration**2
    if t > 0.5 * duration:  # it ends as it began
        th, rate, acceleration = _angle(max(duration - t, 0.0), duration, period, turns, ramp)
        return full - th, rate, -acceleration
    if t >= ramp:
        return top * (t - 0.5 * ramp), top, 0.0
    # The rate grows by s(x), whose integral is x^4 (5/2 - 3 x + x^2).
    x = t / ramp
    s, s_dot, _ = _smooth(x)
    return top * ramp * x**4 * (2.5 - 3.0 * x + x**2), top * s, top * s_dot / ramp
