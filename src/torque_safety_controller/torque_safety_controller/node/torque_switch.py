# SPDX-License-Identifier: Apache-2.0
"""The service that switches between torque control and the robot's own position control."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from std_srvs.srv import SetBool

from torque_safety_controller.node.limits import LimitsReader
from torque_safety_controller.node.topics import ENABLE_TORQUE
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.safety.handover import Handover, HandoverRefused
from viability_bounds_pkg.ros.messages import JointStateReader


class TorqueSwitch:
    """Serves ``~/enable_torque``: starts handovers, or says why not.

    Args:
        node: offers the service and logs refusals.
        config: has the timeouts.
        handover: between position control and torque.
        states: newest joint state.
        limits: newest acceleration limits.
        silence: returns the time since the newest joint state, s.
        on_torque: called when torque control will begin.
    """

    def __init__(
        self,
        node: Node,
        config: ControllerConfiguration,
        handover: Handover,
        states: JointStateReader,
        limits: LimitsReader,
        silence: Callable[[], float],
        on_torque: Callable[[], None],
    ) -> None:
        self._logger = node.get_logger()
        self._config, self._handover = config, handover
        self._states, self._limits = states, limits
        self._silence, self._on_torque = silence, on_torque
        ENABLE_TORQUE.serve(node, self._on_request)

    def _on_request(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        states, config, silence = self._states, self._config, self._silence()
        try:
            if request.data:
                fresh = silence < config.bounds_timeout
                self._handover.to_torque(states.q, states.effort(), fresh, self._limits_follow())
                self._on_torque()
                response.message = "torque control begins with the next state"
            else:
                self._handover.to_position(states.q, states.v, silence < config.state_timeout)
                response.message = "position control begins when the arm is at rest"
            response.success = True
        except HandoverRefused as error:
            response.message = str(error)
            self._logger.warning(f"enable_torque refused: {error}")
        return response

    def _limits_follow(self) -> bool:
        """Return whether acceleration limits keep up with the joint states."""
        # After a restart of the robot, earlier limits may have later stamps.
        apart = 1e-9 * abs(self._states.stamp - self._limits.stamp)
        return self._limits.stamp >= 0 and apart <= self._config.bounds_timeout
