# SPDX-License-Identifier: Apache-2.0
"""Plain topics for tools: the hand and the mode."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Vector3Stamped
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header, String

from torque_safety_controller.controller import Controller
from torque_safety_controller.modes import Mode
from torque_safety_controller.node.topics import (
    CONTROLLER_MODE,
    HAND_ORIENTATION_ERROR,
    HAND_POSE,
    HAND_POSITION_ERROR,
)
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.tasks.pose_task import pose_difference
from viability_bounds_pkg.ros.messages import JointStateReader, pose_message

Array = NDArray[np.float64]

_PERIOD = 0.05


class StatePublisher:
    """Publishes the pose of the hand and its errors, by a timer of its own, and the mode.

    Control steps do no work for it, and what has no subscriber costs nothing. The pose is computed
    from the last joint state here, so that it is there in all modes.

    Args:
        node: publishes.
        controller: has the goals.
        config: names the base frame.
        base: placement of the base frame in the URDF's root frame.
        states: has the last joint state.
    """

    def __init__(
        self,
        node: Node,
        controller: Controller,
        config: ControllerConfiguration,
        base: pin.SE3,
        states: JointStateReader,
    ) -> None:
        self._controller, self._states = controller, states
        self._base_frame, self._base = config.base_frame, base
        robot = controller.robot
        self._model, self._data = robot.model, robot.model.createData()
        self._frame = robot.model.getFrameId(robot.frame)
        self._pose = HAND_POSE.publisher(node)
        self._position_error = HAND_POSITION_ERROR.publisher(node)
        self._orientation_error = HAND_ORIENTATION_ERROR.publisher(node)
        self._mode = CONTROLLER_MODE.publisher(node)
        self._last: Mode | None = None
        self.mode(Mode.STOPPED)
        # The steady clock, as with use_sim_time the other one may be slower than the robot.
        node.create_timer(_PERIOD, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def mode(self, mode: Mode) -> None:
        """Publish the mode if it is new; the other topics are silent while it is STOPPED."""
        if mode is not self._last:
            self._last = mode
            self._mode.publish(String(data=mode.value))

    def _publish(self) -> None:
        publishers = self._pose, self._position_error, self._orientation_error
        if self._last is Mode.STOPPED or not any(
            each.get_subscription_count() for each in publishers
        ):
            return
        pin.forwardKinematics(self._model, self._data, self._states.q)
        pose = pin.updateFramePlacement(self._model, self._data, self._frame)
        pose = self._base.actInv(pose)
        message = pose_message(pose, self._base_frame, self._states.stamp)
        self._pose.publish(message)
        goal = self._controller.goals.pose_des
        if goal is None:
            return
        difference = pose_difference(pose, self._base.actInv(goal))
        self._position_error.publish(_vector(message.header, difference.translation))
        self._orientation_error.publish(_vector(message.header, difference.rotation))


def _vector(header: Header, values: Array) -> Vector3Stamped:
    message = Vector3Stamped(header=header)
    message.vector.x, message.vector.y, message.vector.z = values.tolist()
    return message
