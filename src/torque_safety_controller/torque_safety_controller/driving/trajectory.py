# SPDX-License-Identifier: Apache-2.0
"""Motions along trajectories: of the joints, and of the end effector's pose.

Trajectories of the joints are polynomials: quintics between points with accelerations, cubics
between points with velocities. Points with positions only get the velocities of monotone
interpolation (PCHIP), which does not overshoot, and rest at both ends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator, PPoly

from torque_safety_controller.controller import Controller
from torque_safety_controller.driving.jog import HAND_LEAD, JOINT_LEAD, TIMEOUT
from torque_safety_controller.driving.pace import Pace
from torque_safety_controller.tasks.pose_task import pose_error
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, quintic
from viability_bounds_pkg.state import State, whole_turns

Array = NDArray[np.float64]

ACCELERATION_MAX = 100.0
"""Larger accelerations are not fed forward, rad/s^2: no arm has them."""

SPEED_MAX = 1e3
"""Trajectories that are faster anywhere are no motion of an arm, rad/s."""


class Motion(Protocol):
    """Sets the controller's goal anew in each control step."""

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step; return whether the motion continues.

        Args:
            controller: is given the goal, which stays where it is when the motion has ended.
            state: of the joints now.
            stamp: of the state, ns.
        """


class JointTrajectoryError(ArmSafetyError, ValueError):
    """Points that do not make a trajectory."""


class TrajectoryPassed(ArmSafetyError, ValueError):
    """A trajectory that began long ago, and has ended or is not where the arm is."""

    def __init__(self, late: float, why: str = "has ended") -> None:
        super().__init__(
            f"header.stamp is {late:.3g} s before that of the joint states: the trajectory {why}"
        )


class JointPoint(NamedTuple):
    """Where the joints are at a time."""

    time: float
    """s from the start."""
    q: Array
    """Shape (n,), rad."""
    v: Array | None = None
    """Shape (n,), rad/s; None for all points or for none."""
    a: Array | None = None
    """Shape (n,), rad/s^2; None for all points or for none; only with velocities."""


class JointTrajectory:
    """Interpolates points; before the first and after the last it rests at them.

    Args:
        points: at least one, in order of time.

    Attributes:
        points: as given.
        duration: time of the last point, s.

    Raises:
        JointTrajectoryError: no points, times that do not grow, numbers that are not finite,
            velocities or accelerations of some points only, or a speed above `SPEED_MAX`.
    """

    def __init__(self, points: Sequence[JointPoint]) -> None:
        if not points:
            raise JointTrajectoryError("points is empty; allowed: at least one point")
        kind = points[0].v is None, points[0].a is None
        for k, (_, _, v, a) in enumerate(points):
            if (v is None, a is None) != kind or (v is None and a is not None):
                raise JointTrajectoryError(
                    f"points[{k}] has other parts than points[0]; allowed: positions; with "
                    "velocities; or with velocities and accelerations; the same in all points"
                )
        # At once for all points: this runs beside control steps, and is not to delay them.
        times, *parts = (
            np.array(part) for part in zip(*points, strict=True) if part[0] is not None
        )
        finite = np.isfinite(np.column_stack([times, *parts])).all(axis=1)
        if not finite.all():
            raise JointTrajectoryError(f"points[{int(finite.argmin())}] is not finite")
        grows = np.diff(times, prepend=-math.inf) > 0.0
        if times[0] < 0.0 or not grows.all():
            k = 0 if times[0] < 0.0 else int(grows.argmin())
            allowed = f"more than {times[k - 1]:g}, that of the last one" if k else "at least 0"
            raise JointTrajectoryError(f"points[{k}].time is {times[k]:g}; allowed: {allowed}")
        self.points = tuple(points)
        self.duration = points[-1].time
        with np.errstate(all="ignore"):  # what overflows is too fast
            self._curves = _curves(times, *parts) if len(points) > 1 else None
            fastest = self.fastest()
        if not (fastest <= SPEED_MAX).all():
            raise JointTrajectoryError(f"it is faster than {SPEED_MAX:g} rad/s")

    def from_state(
        self, state: State, continuous: NDArray[np.bool_] | None = None
    ) -> JointTrajectory:
        """Return this trajectory with a first part that begins at a state at time 0.

        Args:
            state: of the joints.
            continuous: whether a joint turns without end, shape (n,): whole turns are added to all
                its positions, so that the first is the nearest; None for no joint.
        """
        first = self.points[0]
        if continuous is not None and (turns := whole_turns(first.q, state.q, continuous)).any():
            points = [each._replace(q=each.q + turns) for each in self.points]
            return JointTrajectory(points).from_state(state)
        if first.time <= 0.0:
            return self
        start = JointPoint(
            0.0,
            state.q.copy(),
            None if first.v is None else state.v.copy(),
            None if first.a is None else np.zeros_like(state.q),
        )
        try:
            return JointTrajectory((start, *self.points))
        except JointTrajectoryError:  # no time to get there
            return self

    def check_late(
        self, late: float, state: State, continuous: NDArray[np.bool_] | None = None
    ) -> None:
        """Raise `TrajectoryPassed` where an arm cannot join it any more.

        Args:
            late: time since it began, s; up to `TIMEOUT` it counts as in time.
            state: of the joints now.
            continuous: see `from_state`.
        """
        if late <= TIMEOUT:
            return
        if late >= self.duration:
            raise TrajectoryPassed(late)
        off = float(np.abs(self.from_state(state, continuous).sample(late)[0] - state.q).max())
        if off > JOINT_LEAD:
            why = f"is {off:.3g} rad away from the arm by now; allowed: {JOINT_LEAD:g} rad"
            raise TrajectoryPassed(late, why)

    def sample(self, t: float) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations at time t, s; shape (n,) each."""
        first, last = self.points[0], self.points[-1]
        if self._curves is None or t < first.time or t >= last.time:
            q = (first if t < first.time else last).q
            return q.copy(), np.zeros_like(q), np.zeros_like(q)
        q, v, a = (curve(t) for curve in self._curves)
        return q, v, a

    def fastest(self) -> Array:
        """Return the largest speed of each joint at 8 instants between points, shape (n,)."""
        if self._curves is None:
            return np.zeros_like(self.points[0].q)
        times = self._curves[0].x
        fine = np.interp(np.arange(8 * len(times) - 7) / 8, np.arange(len(times)), times)
        largest: Array = np.abs(self._curves[1](fine)).max(axis=0)
        return largest


def _curves(
    times: Array, q: Array, v: Array | None = None, a: Array | None = None
) -> tuple[PPoly, PPoly, PPoly]:
    """Return positions, velocities and accelerations as functions of time."""
    if v is None:
        v = PchipInterpolator(times, q).derivative()(times)
        v[0] = v[-1] = 0.0
    if a is None:
        curve = CubicHermiteSpline(times, q, v)
    else:
        T, first, last = np.diff(times)[:, None], slice(None, -1), slice(1, None)
        rows = quintic(T, *((q[part], v[part], a[part]) for part in (first, last)))
        curve = PPoly(rows[::-1], times)
    return curve, curve.derivative(), curve.derivative(2)


class JointMotion:
    """The joints follow a trajectory from where they are.

    Args:
        trajectory: from the time `begin` on.
        begin: its time 0, ns; 0 for the first step.
        dt: control period, s.
        q_min: lower position limits, shape (n,), rad; between points a polynomial may pass them.
        q_max: upper ones, shape (n,), rad.
        v_max: speed limits, shape (n,), rad/s; more is not fed forward.
        continuous: see `JointTrajectory.from_state`.

    Attributes:
        pace: how the trajectory waits for the arm.
    """

    def __init__(
        self,
        trajectory: JointTrajectory,
        begin: int,
        dt: float,
        q_min: Array,
        q_max: Array,
        v_max: Array,
        continuous: NDArray[np.bool_] | None = None,
    ) -> None:
        self._trajectory, self._continuous = trajectory, continuous
        self._q_min, self._q_max, self._v_max = q_min, q_max, v_max
        self._begun = False
        self._off = np.zeros_like(v_max)
        self.pace = Pace(begin, dt)

    def where(self, joints: Sequence[str]) -> str:
        """Return how far the arm is from the trajectory, in words."""
        worst = int(np.abs(self._off).argmax())
        return f"{joints[worst]} is {abs(self._off[worst]):.3g} rad away from it"

    def check_late(self, controller: Controller, state: State, stamp: int) -> None:
        """Raise `TrajectoryPassed` where the arm cannot join it any more."""
        if self.pace.begin:
            late = 1e-9 * (stamp - self.pace.begin)
            self._trajectory.check_late(late, state, self._continuous)

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step; see `Motion`."""
        if not self._begun:
            self._begun = True
            self._trajectory = self._trajectory.from_state(state, self._continuous)
        t = self.pace.time(stamp)
        q, v, a = self._trajectory.sample(t)
        self._off = q - state.q
        self.pace.follow(joints_behind(self._off, v), float(np.abs(self._off).max()) / JOINT_LEAD)
        rate = self.pace.rate
        controller.goals.release_pose()
        controller.goals.set_posture(
            np.clip(q, self._q_min, self._q_max),
            np.clip(rate * v, -self._v_max, self._v_max),
            np.clip(rate**2 * a, -ACCELERATION_MAX, ACCELERATION_MAX),
        )
        return t < self._trajectory.duration


def joints_behind(error: Array, v: Array) -> float:
    """Return how far joints lag behind a moving goal, in times of `JOINT_LEAD`.

    Args:
        error: goal less positions, shape (n,), rad.
        v: velocity of the goal, shape (n,), rad/s; slow joints count less.
    """
    fastest = float(np.abs(v).max())
    return float((error * v).max()) / (fastest * JOINT_LEAD) if fastest > 0.0 else 0.0


class TrajectoryMotion:
    """The end effector follows a trajectory.

    Args:
        trajectory: in the URDF's root frame.
        begin: its time 0, ns; 0 for the first step.
        dt: control period, s.

    Attributes:
        pace: how the trajectory waits for the arm.
    """

    def __init__(self, trajectory: PoseTrajectory, begin: int, dt: float) -> None:
        self._trajectory = trajectory
        self._off = [0.0, 0.0]
        self.pace = Pace(begin, dt)

    def where(self, joints: Sequence[str]) -> str:
        """Return how far the hand is from the trajectory, in words."""
        return "the hand is {:.3g} m and {:.3g} rad away from it".format(*self._off)

    def check_late(self, controller: Controller, state: State, stamp: int) -> None:
        """Raise `TrajectoryPassed` where the hand cannot join it any more."""
        begin = self.pace.begin
        late = 1e-9 * (stamp - begin)
        if not begin or late <= TIMEOUT:
            return
        if late >= self._trajectory.duration:
            raise TrajectoryPassed(late)
        error = pose_error(controller.robot.pose, self._trajectory.sample(late)[0])
        far, turned = (float(np.linalg.norm(part)) for part in np.split(error, 2))
        if far > HAND_LEAD[0] or turned > HAND_LEAD[1]:
            why = f"is {far:.3g} m and {turned:.3g} rad away from the hand by now; allowed: "
            raise TrajectoryPassed(late, why + "{:g} m and {:g} rad".format(*HAND_LEAD))

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step; see `Motion`."""
        t = self.pace.time(stamp)
        pose, twist, twist_rate = self._trajectory.sample(t)
        # The hand of the last step: one period's motion is far less than the lead.
        hand = controller.robot.pose
        error = pose.rotation.T @ (pose.translation - hand.translation)
        turn = pin.log3(hand.rotation.T @ pose.rotation)
        behind = 0.0
        for k, (e, w) in enumerate(((error, twist[:3]), (turn, twist[3:]))):
            self._off[k] = math.sqrt(e.dot(e))
            if (speed := math.sqrt(w.dot(w))) > 0.0:
                behind = max(behind, float(e.dot(w)) / (speed * HAND_LEAD[k]))
        self.pace.follow(behind, max(self._off[0] / HAND_LEAD[0], self._off[1] / HAND_LEAD[1]))
        rate = self.pace.rate
        controller.goals.set_pose(pose, rate * twist, rate**2 * twist_rate)
        return t < self._trajectory.duration
