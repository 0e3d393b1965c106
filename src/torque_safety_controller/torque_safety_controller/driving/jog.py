# SPDX-License-Identifier: Apache-2.0
"""Jogs: velocities of the joints or of the hand that count for a short time.

A jog moves a goal. Its velocity w follows the commanded one u with the time constant `SMOOTHING`,

    T w' = u - w,

so that commands of a keyboard or joystick do not come as steps; w and w' are fed forward. The goal
is ahead of the arm by a largest lead at most: where limits hold the arm back, the goal waits.
Without a new command for `TIMEOUT` u is zero, and the goal comes to rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.controller import Controller
from torque_safety_controller.tasks.pose_task import shorten
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

TIMEOUT = 0.25
"""How long a command counts, s of the robot's time."""

SMOOTHING = 0.1
"""T, s."""

JOINT_LEAD = 0.1
"""Largest distance of the goal of a joint ahead of it, rad."""

HAND_LEAD = (0.05, 0.2)
"""Largest distance of the goal of the hand ahead of it, m and rad."""

JOINT_SPEED_MAX = 10.0
"""Faster commands are shortened to this speed, rad/s."""

HAND_SPEED_MAX = (1.0, 2.0)
"""Faster commands are shortened to these speeds, m/s and rad/s."""

_REST = 1e-4
"""Speed of the goal at which a jog has ended, rad/s and m/s."""


class _Jog:
    """Velocity of a goal, by commands that count for a short time.

    Attributes:
        velocity: w of the goal, shape (k,).
    """

    def __init__(self) -> None:
        self.velocity = self._command = np.zeros(0)
        self._ends = self._stamp = -1

    def command(self, velocity: Array) -> None:
        """Command a velocity, shape (k,), from the next step on."""
        self._command, self._ends = velocity, -1

    def _commanded(self, stamp: int) -> tuple[Array | None, float]:
        """Return u, shape (k,), None when the jog has ended; and the time since the last step, s.

        Args:
            stamp: of the state, ns.
        """
        if self._ends < 0:
            self._ends = stamp + round(1e9 * TIMEOUT)
        elapsed = 1e-9 * (stamp - self._stamp) if self._stamp >= 0 else 0.0
        self._stamp = stamp
        if elapsed >= 0.0 and stamp <= self._ends:
            return self._command, min(elapsed, SMOOTHING)
        self._ends = 0  # also where the robot has restarted
        rests = float(np.abs(self.velocity).max()) <= _REST
        return None if rests else np.zeros_like(self.velocity), min(max(elapsed, 0.0), SMOOTHING)

    def _smooth(self, wanted: Array, elapsed: float) -> Array:
        """Let w follow `wanted`; return w', shape (k,)."""
        share = -math.expm1(-elapsed / SMOOTHING)
        self.velocity = self.velocity + share * (wanted - self.velocity)
        rate: Array = (wanted - self.velocity) / SMOOTHING
        return rate


class JointJog(_Jog):
    """The joints move with given velocities.

    Args:
        q_min: lower position limits, shape (n,), rad.
        q_max: upper ones, shape (n,), rad.
        v_max: speed limits, shape (n,), rad/s; inf for none.
    """

    def __init__(self, q_min: Array, q_max: Array, v_max: Array) -> None:
        super().__init__()
        self._q_min, self._q_max = q_min, q_max
        self._v_max = np.minimum(v_max, JOINT_SPEED_MAX)
        self._q_des: Array | None = None

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step; see `Motion`."""
        if self._q_des is None:
            self._q_des, self.velocity = state.q.copy(), state.v.copy()
        wanted, elapsed = self._commanded(stamp)
        if wanted is None:
            controller.goals.set_posture(self._q_des)
            return False
        # All by the same share: the direction stays.
        wanted = wanted / max(1.0, float((np.abs(wanted) / self._v_max).max()))
        rate = self._smooth(wanted, elapsed)
        ahead = np.clip(self._q_des + elapsed * self.velocity - state.q, -JOINT_LEAD, JOINT_LEAD)
        self._q_des = np.clip(state.q + ahead, self._q_min, self._q_max)
        at_limit = self._q_des != state.q + ahead
        self.velocity[at_limit] = rate[at_limit] = 0.0
        controller.goals.release_pose()
        controller.goals.set_posture(self._q_des, self.velocity, rate)
        return True


class HandJog(_Jog):
    """The hand moves with a given twist.

    Args:
        speed_max: of translation, m/s, and rotation, rad/s; faster commands are shortened.
    """

    def __init__(self, speed_max: Sequence[float] = HAND_SPEED_MAX) -> None:
        super().__init__()
        self._speed_max, self._in_hand = speed_max, False
        self._goal: pin.SE3 | None = None

    def command_twist(self, twist: Array, in_hand: bool) -> None:
        """Command a twist from the next step on.

        Args:
            twist: linear, then angular, shape (6,), m/s and rad/s.
            in_hand: whether its axes are those of the hand; else of the URDF's root frame.
        """
        twist = twist.copy()
        shorten(twist[:3], self._speed_max[0])
        shorten(twist[3:], self._speed_max[1])
        self._in_hand = in_hand
        self.command(twist)

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step; see `Motion`."""
        robot = controller.robot
        if self._goal is None:
            # What the robot's model knows is the last step, or nothing.
            robot.update(state, robot.a_last)
            self._goal, self.velocity = robot.pose.copy(), robot.J @ robot.v
        wanted, elapsed = self._commanded(stamp)
        if wanted is None:
            controller.goals.set_pose(self._goal)
            return False
        R = self._goal.rotation
        if not self._in_hand:
            wanted = (wanted.reshape(2, 3) @ R).ravel()
        rate = self._smooth(wanted, elapsed)
        linear, angular = np.split(self.velocity, 2)
        # The pose of the last step: one period's motion is far less than the lead.
        here = robot.pose
        ahead = self._goal.translation + elapsed * R @ linear - here.translation
        turn = pin.log3(here.rotation.T @ R @ pin.exp3(elapsed * angular))
        shorten(ahead, HAND_LEAD[0])
        shorten(turn, HAND_LEAD[1])
        self._goal = pin.SE3(here.rotation @ pin.exp3(turn), here.translation + ahead)
        controller.goals.set_pose(self._goal, self.velocity.copy(), rate)
        return True
