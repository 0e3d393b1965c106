"""A trajectory of the end effector: pose, twist and acceleration at any time between its points.

Between two points position and orientation are quintic polynomials that meet pose, velocity and
acceleration at both: of the position, and of the rotation vector phi from the first orientation,

    R(t) = R_0 exp(phi(t)),   omega = Jr(phi) phi',   alpha = Jr(phi) phi'' + Jr' phi',

in body axes, with Jr the right Jacobian of SO(3). What is interpolated is smooth, so that its
twist and acceleration can be fed forward, eq. (7) and (8) of [Benallegue2021].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_STEP = 1e-4
"""Of the difference that stands for Jr', as a share of the segment."""


class TrajectoryError(ArmSafetyError, ValueError):
    """Points that are no trajectory."""


class TrajectoryPoint(NamedTuple):
    """What the end effector is to do at a time, in the base frame's axes."""

    time: float
    """s from the start."""
    pose: pin.SE3
    velocity: Array
    """Linear, then angular, shape (6,), m/s and rad/s."""
    acceleration: Array
    """Linear, then angular, shape (6,), m/s^2 and rad/s^2."""


class PoseTrajectory:
    """Interpolates points; before the first and after the last it rests at them.

    Args:
        points: at least one, in order of time.

    Attributes:
        duration: time of the last point, s.

    Raises:
        TrajectoryError: no points, times that do not grow, numbers that are not finite, or half
            a turn or more between two points.
    """

    def __init__(self, points: Sequence[TrajectoryPoint]) -> None:
        if not points:
            raise TrajectoryError("no points")
        for k, point in enumerate(points):
            values = (
                point.time,
                *point.velocity,
                *point.acceleration,
                *point.pose.homogeneous.flat,
            )
            if not np.isfinite(values).all():
                raise TrajectoryError(f"points[{k}] is not finite")
        self._times = np.array([point.time for point in points])
        if self._times[0] < 0.0 or (np.diff(self._times) <= 0.0).any():
            raise TrajectoryError("times must be >= 0 and grow from point to point")
        self.duration = float(self._times[-1])
        self._points = list(points)
        self._segments = [
            _Segment(first, second) for first, second in zip(points, points[1:], strict=False)
        ]

    def sample(self, t: float) -> tuple[pin.SE3, Array, Array]:
        """Return what is to be done at time t.

        Returns:
            Pose; twist in the axes of that pose, linear then angular, shape (6,), m/s and rad/s;
            and the twist's time derivative, shape (6,), m/s^2 and rad/s^2.
        """
        k = int(np.searchsorted(self._times, t, side="right"))
        if k == 0 or k == len(self._points):
            point = self._points[0 if k == 0 else -1]
            return point.pose.copy(), np.zeros(6), np.zeros(6)
        return self._segments[k - 1].sample(t - self._times[k - 1])


class _Segment:
    """One stretch between two points."""

    def __init__(self, first: TrajectoryPoint, second: TrajectoryPoint) -> None:
        self._duration = T = second.time - first.time
        self._R = first.pose.rotation.copy()
        turn = pin.log3(self._R.T @ second.pose.rotation)
        if np.linalg.norm(turn) > 0.99 * np.pi:
            raise TrajectoryError(
                f"between {first.time:g} s and {second.time:g} s the end effector turns by "
                f"{np.linalg.norm(turn):.2f} rad; give points in between"
            )
        ends = []
        for point, phi in ((first, np.zeros(3)), (second, turn)):
            R = point.pose.rotation
            omega, alpha = R.T @ point.velocity[3:], R.T @ point.acceleration[3:]
            back = np.linalg.inv(pin.Jexp3(phi))
            rate = back @ omega
            ends.append((phi, rate, back @ (alpha - _jacobian_rate(phi, rate) @ rate)))
        self._turning = _quintic(T, *ends)
        self._moving = _quintic(
            T,
            *(
                (point.pose.translation, point.velocity[:3], point.acceleration[:3])
                for point in (first, second)
            ),
        )

    def sample(self, t: float) -> tuple[pin.SE3, Array, Array]:
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


def _quintic(T: float, start: tuple[Array, ...], end: tuple[Array, ...]) -> Array:
    """Return coefficients, shape (6, 3), lowest power first, from values and two derivatives."""
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
    pose: pin.SE3, diameter: float, period: float, turns: int, points: int = 48
) -> list[TrajectoryPoint]:
    """Return points of a closed curve in the y-z plane that begins and ends at rest at `pose`.

    [Benallegue2021], IV-D: a closed shape of 0.4 m diameter, orientation and x kept. The angle
    runs from rest to rest along a quintic over all turns, the arm starts at the lowest point.

    Args:
        pose: where it begins.
        diameter: m.
        period: mean duration of a turn, s.
        turns: how many.
        points: a turn.
    """
    radius, total = 0.5 * diameter, period * turns
    full = 2.0 * np.pi * turns
    zero = np.zeros(3)
    angle = _quintic(total, (zero, zero, zero), (np.full(3, full), zero, zero))
    result = []
    for t in np.linspace(0.0, total, points * turns + 1):
        (s, *_), (s_dot, *_), (s_ddot, *_) = _evaluate(angle, t)
        out = np.array([0.0, np.sin(s), 1.0 - np.cos(s)])
        along = np.array([0.0, np.cos(s), np.sin(s)])
        inward = np.array([0.0, -np.sin(s), np.cos(s)])
        place = pin.SE3(pose.rotation, pose.translation + radius * out)
        velocity = np.concatenate([radius * s_dot * along, zero])
        acceleration = np.concatenate([radius * (s_ddot * along + s_dot**2 * inward), zero])
        result.append(TrajectoryPoint(float(t), place, velocity, acceleration))
    return result
