# SPDX-License-Identifier: Apache-2.0
"""Trajectories of the end effector: pose, twist and acceleration between points, and circles.

Between two points position and orientation are quintic polynomials that meet pose, velocity and
acceleration at both: of the position, and of the rotation vector phi from the first orientation,

    R(t) = R_0 exp(phi(t)),   omega = Jr(phi) phi',   alpha = Jr(phi) phi'' + Jr' phi',

in body axes, with Jr the right Jacobian of SO(3). The result is smooth, so that its twist and
acceleration can be fed forward, eq. (7) and (8) of [Benallegue2021].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_FROM_REST_TO_REST = Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""s(x), the quintic from 0 to 1 with zero velocity and acceleration at both ends."""

_TURN_MAX = 0.99 * math.pi
"""Between two points, rad; the rotation vector jumps at half a turn."""

_STEP = 1e-4
"""Of the difference that stands for Jr', as a share of the segment."""


class TrajectoryError(ArmSafetyError, ValueError):
    """Points that do not make a trajectory."""


class TrajectoryPoint(NamedTuple):
    """Pose, velocity and acceleration of the end effector at a time, in the base frame's axes."""

    time: float
    """s from the start."""
    pose: pin.SE3
    velocity: Array = np.zeros(6)
    """Linear, then angular, shape (6,), m/s and rad/s."""
    acceleration: Array = np.zeros(6)
    """Linear, then angular, shape (6,), m/s^2 and rad/s^2."""


class PoseTrajectory:
    """Interpolates points; before the first and after the last it rests at them.

    Args:
        points: at least one, in order of time.

    Attributes:
        points: as given.
        duration: time of the last point, s.

    Raises:
        TrajectoryError: no points, times that do not grow, numbers that are not finite, or half
            a turn or more between two points.
    """

    def __init__(self, points: Sequence[TrajectoryPoint]) -> None:
        if not points:
            raise TrajectoryError("points is empty; allowed: at least one point")
        before = -math.inf
        for k, (time, pose, velocity, acceleration) in enumerate(points):
            if not np.isfinite((time, *velocity, *acceleration, *pose.homogeneous.flat)).all():
                raise TrajectoryError(f"points[{k}] is not finite")
            if time < 0.0 or time <= before:
                allowed = "at least 0" if k == 0 else f"more than {before:g}, that of the last one"
                raise TrajectoryError(f"points[{k}].time is {time:g}; allowed: {allowed}")
            before = time
        self.points = tuple(points)
        self.duration = points[-1].time
        self._times = np.array([point.time for point in points])
        self._segments = [_Segment(points, k) for k in range(1, len(points))]

    def sample(self, t: float) -> tuple[pin.SE3, Array, Array]:
        """Return the motion at time t, s.

        Returns:
            Pose; twist in the axes of that pose, linear then angular, shape (6,), m/s and rad/s;
            and the twist's time derivative, shape (6,), m/s^2 and rad/s^2.
        """
        k = int(np.searchsorted(self._times, t, side="right"))
        if k == 0 or k == len(self.points):
            point = self.points[0 if k == 0 else -1]
            return point.pose.copy(), np.zeros(6), np.zeros(6)
        return self._segments[k - 1].sample(t - self._times[k - 1])


class _Segment:
    """The motion from a point to the next, `points[k]`."""

    def __init__(self, points: Sequence[TrajectoryPoint], k: int) -> None:
        first, second = points[k - 1 : k + 1]
        T = second.time - first.time
        self._R = first.pose.rotation.copy()
        turn = pin.log3(self._R.T @ second.pose.rotation)
        angle = float(np.linalg.norm(turn))
        if angle > _TURN_MAX:
            raise TrajectoryError(
                f"points[{k}] is turned by {angle:.2f} rad from the last one; allowed: at most "
                f"{_TURN_MAX:.2f} rad, by points in between"
            )
        ends = []
        for point, phi in ((first, np.zeros(3)), (second, turn)):
            R = point.pose.rotation
            omega, alpha = R.T @ point.velocity[3:], R.T @ point.acceleration[3:]
            back = np.linalg.inv(pin.Jexp3(phi))
            rate = back @ omega
            ends.append((phi, rate, back @ (alpha - _jacobian_rate(phi, rate) @ rate)))
        self._turning = quintic(T, *ends)
        self._moving = quintic(
            T,
            *(
                (point.pose.translation, point.velocity[:3], point.acceleration[:3])
                for point in (first, second)
            ),
        )

    def sample(self, t: float) -> tuple[pin.SE3, Array, Array]:
        """Return pose, twist and its derivative at `t` after the first point, s."""
        p, p_dot, p_ddot = _evaluate(self._moving, t)
        phi, phi_dot, phi_ddot = _evaluate(self._turning, t)
        R = self._R @ pin.exp3(phi)
        J = pin.Jexp3(phi)
        omega = J @ phi_dot
        linear = R.T @ p_dot
        twist = np.concatenate([linear, omega])
        # Derivative of the components in moving axes: less omega x linear.
        rate = np.concatenate(
            [
                R.T @ p_ddot - np.cross(omega, linear),
                J @ phi_ddot + _jacobian_rate(phi, phi_dot) @ phi_dot,
            ]
        )
        return pin.SE3(R, p), twist, rate


def _jacobian_rate(phi: Array, phi_dot: Array) -> Array:
    """Return the time derivative of Jr(phi), shape (3, 3), by a central difference."""
    h = _STEP / (1.0 + float(np.linalg.norm(phi_dot)))
    rate: Array = (pin.Jexp3(phi + h * phi_dot) - pin.Jexp3(phi - h * phi_dot)) / (2.0 * h)
    return rate


def quintic(T: float | Array, start: tuple[Array, ...], end: tuple[Array, ...]) -> Array:
    """Return coefficients of polynomials, lowest power first, shape (6, ...).

    Args:
        T: duration, s.
        start: values at time 0 and their first two derivatives, shape (...) each.
        end: likewise at `T`.
    """
    (x0, v0, a0), (x1, v1, a1) = start, end
    dx = x1 - (x0 + v0 * T + 0.5 * a0 * T * T)
    dv, da = v1 - (v0 + a0 * T), a1 - a0
    return np.array(
        [
            x0,
            v0,
            0.5 * a0,
            (10.0 * dx - 4.0 * dv * T + 0.5 * da * T**2) / T**3,
            (-15.0 * dx + 7.0 * dv * T - da * T**2) / T**4,
            (6.0 * dx - 3.0 * dv * T + 0.5 * da * T**2) / T**5,
        ]
    )


def _evaluate(coefficients: Array, t: float) -> tuple[Array, Array, Array]:
    """Return the polynomial and its first two derivatives, shape (3,) each."""
    powers = np.array([1.0, t, t**2, t**3, t**4, t**5])
    first = np.array([0.0, 1.0, 2.0 * t, 3.0 * t**2, 4.0 * t**3, 5.0 * t**4])
    second = np.array([0.0, 0.0, 2.0, 6.0 * t, 12.0 * t**2, 20.0 * t**3])
    return powers @ coefficients, first @ coefficients, second @ coefficients


def circle(
    start: pin.SE3,
    radius: float,
    axes: tuple[ArrayLike, ArrayLike],
    *,
    period: float,
    turns: float = 1.0,
    points_per_turn: int = 48,
) -> list[TrajectoryPoint]:
    """Return points of a circle at constant orientation, from rest to rest by a quintic angle.

    At angle th from the start the end effector is at  centre + radius (cos(th) e_1 + sin(th) e_2),

        p'  = radius th' (-sin(th) e_1 + cos(th) e_2),
        p'' = radius (th'' (-sin(th) e_1 + cos(th) e_2) - th'^2 (cos(th) e_1 + sin(th) e_2)).

    With 48 points a turn, the quintics between them differ from a circle of 0.4 m diameter by less
    than 0.1 um.

    Args:
        start: pose at the start.
        radius: m.
        axes: e_1, from the centre to the start, and e_2, in which it begins to move; shape (3,)
            each, unit, at right angles.
        period: mean duration of a turn, s.
        turns: their number.
        points_per_turn: of the result.
    """
    e_1, e_2 = map(np.asarray, axes)
    centre = start.translation - radius * e_1
    duration, whole = turns * period, 2.0 * math.pi * turns
    angle = [whole * _FROM_REST_TO_REST.deriv(k) / duration**k for k in range(3)]
    points = []
    count = math.ceil(points_per_turn * turns) + 1
    for t in np.linspace(0.0, duration, count).tolist():
        th, rate, rate_dot = (float(each(t / duration)) for each in angle)
        outward = math.cos(th) * e_1 + math.sin(th) * e_2
        along = math.cos(th) * e_2 - math.sin(th) * e_1
        pose = pin.SE3(start.rotation, centre + radius * outward)
        velocity, acceleration = np.zeros((2, 6))
        velocity[:3] = radius * rate * along
        acceleration[:3] = radius * (rate_dot * along - rate**2 * outward)
        points.append(TrajectoryPoint(t, pose, velocity, acceleration))
    return points
