# SPDX-License-Identifier: Apache-2.0
"""The robot node of a Franka arm: torque control at 1 kHz by libfranka."""

from __future__ import annotations

import sys
import time
from array import array
from collections import Counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from franka_bridge.arm import Behaviour, FrankaArm, FrankaError, NoRealTimeError, flange_pose
from franka_bridge.node.franka_parameters import FrankaConfiguration, check_flange, make_drive
from franka_bridge.node.topics import EXTERNAL_TORQUES, EXTERNAL_WRENCH_ESTIMATE, RECOVER
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.plausible import RESTART_GAP
from viability_bounds_pkg.robot.description import inertia_beyond
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.commands import CommandStream
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import TorqueCommand, wrench_message
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.payload import PayloadSubscriber
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.robot_urdf import warn_of_unusual
from viability_bounds_pkg.ros.runtime import set_stamp, steady_timer
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES, ROBOT_DESCRIPTION

Array = NDArray[np.float64]

_DEADLINE = 0.7
"""Share of a period after which the robot gets its torques without a command."""

_PATIENCE = 0.4
"""The same in lockstep, with a simulated robot that waits for commands a little longer, s."""

_TOOL_ERROR = 0.1
"""By how much the masses of the hand may differ without a word, kg."""

_STOP_TIMEOUT = 2.0
"""How long the arm may take to come to rest at the end of the node, s."""


class FrankaNode(ArmNode):
    """A Franka arm that publishes ``joint_states`` and follows ``joint_commands``.

    One thread does all: it waits in libfranka for a state, publishes it, sends the torques of the
    command that answers it, and runs what else is due before it waits for the next. libfranka's
    Python bindings keep other threads of Python from running while they wait.

    From the start the arm is held where it stands. Commands are torques, which get their effect
    gradually; a command of positions, as of a controller that starts in position control, holds
    the arm as well, wherever these positions are. Without a command in time the last one is held,
    and after ``command_timeout`` periods the arm is brought to rest; both within all limits.

    When the robot stops itself or the connection is lost, the node says why, and does nothing
    until ``~/recover`` is called.
    """

    NAME = "franka_node"
    PARAMETERS = FrankaConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            config = self._config = NodeParameters(self, FrankaConfiguration).configuration
            warn_of_unusual(self, config, config.urdf)
            self._drive = make_drive(config)
            try:
                self._arm = FrankaArm(config.robot_ip, config.real_time)
            except NoRealTimeError as error:
                allowed = f"false, where {error}"
                raise SettingError("real_time", config.real_time, allowed) from error
            except FrankaError as error:
                allowed = f"the address of a robot whose FCI is on ({error})"
                raise SettingError("robot_ip", config.robot_ip, allowed) from error
            state = self._arm.state
            check_flange(config, np.array(state.q), flange_pose(state))
        tool = inertia_beyond(config.urdf, config.flange_frame, config.locked).mass
        if abs(tool - state.m_ee) > _TOOL_ERROR:
            self.get_logger().warning(
                f"the hand has {tool:.2f} kg in the URDF, {state.m_ee:.2f} kg in the robot's "
                "settings: gravity is compensated for the latter; correct one of them"
            )
        self._refused: Counter[str] = Counter()
        self._commands = CommandStream(
            config, self._refused, self.get_logger().warning, lambda tau: self._asked(tau)
        )
        self._periods = self._braked = self._stamp = 0
        self._waits = False  # for the command that answers the last state
        self._fault = ""
        self._set_clock()
        self._make_interface()
        self.announce(config.joints, config.rate_hz, f"a Franka arm at {config.robot_ip}")

    def _make_interface(self) -> None:
        """Create publishers, subscriptions, services and timers."""
        self._states = self.stream(JOINT_STATES)
        self._external_torques = self.stream(EXTERNAL_TORQUES)
        self._external_wrench = self.stream(EXTERNAL_WRENCH_ESTIMATE)
        ROBOT_DESCRIPTION.publisher(self).publish(String(data=self._config.urdf))
        self.listen(JOINT_COMMANDS, self._on_command)
        self._loads = PayloadSubscriber(self, self._drive.payload, self._on_load)
        RECOVER.serve(self, self._on_recover)
        patience = _PATIENCE if self._config.clock == "lockstep" else _DEADLINE * self._config.dt
        self._deadline = steady_timer(self, patience, self._on_deadline)
        self._deadline.cancel()
        self._starter = steady_timer(self, self._config.dt, self._on_start)
        self._diagnostics = Diagnostics(self, self._report, self.publisher_watch)

    # Torque control

    def _on_start(self) -> None:
        """Begin, once the nodes of the process are complete."""
        self._starter.cancel()
        try:
            self._begin()
        except FrankaError as error:
            self._tell(str(error))
        self._next()

    def _begin(self) -> None:
        """Begin torque control, with the arm held.

        Raises:
            FrankaError: the robot refuses.
        """
        arm, config = self._arm, self._config
        if arm.trouble:
            raise FrankaError(arm.trouble)
        load = self._drive.tell_load(config.flange_frame)
        arm.start(
            Behaviour(config.collision_torque, config.collision_force, config.end_effector, load)
        )
        state = arm.read()
        self._drive.start(np.array(state.q), np.array(state.dq), np.array(state.tau_J_d))
        # At once: without torques the arm floats until a controller is there.
        arm.write(self._torque(None, False))
        self._commands.restart()
        self._fault = ""

    def _set_clock(self) -> None:
        """Let stamps follow the robot's time from now on."""
        now = max(self.get_clock().now().nanoseconds, self._stamp + round(1e9 * RESTART_GAP))
        self._since = now - self._robot_time()

    def _robot_time(self) -> int:
        """Return the robot's time of the last state, ns."""
        return 1_000_000 * round(1e3 * self._arm.state.time.to_sec())

    def _next(self) -> None:
        """Read the next state when what is due has been done."""
        if self._arm.connected and self.executor is not None:
            self.executor.create_task(self._read)

    def _read(self) -> None:
        """Wait for a state and publish it; the command that answers it ends the period."""
        try:
            self._arm.read()
        except FrankaError as error:
            self._tell(str(error))
            self._next()
            return
        self._periods += 1
        self._waits = self._arm.controlled
        self._states.in_turn(self._publish)
        if not self._arm.controlled:
            self._next()
        elif self._waits:
            self._deadline.reset()

    def _publish(self) -> None:
        state = self._arm.state
        self._stamp = self._since + self._robot_time()
        message = JointState(
            name=self._config.joints,
            position=array("d", state.q),
            velocity=array("d", state.dq),
            effort=array("d", self._drive.reported(np.array(state.q), np.array(state.tau_J))),
        )
        set_stamp(message.header.stamp, self._stamp)
        self._published_at = time.monotonic()
        self._states.publish(message)

    def _on_command(self, message: JointState) -> None:
        accepted = self._commands.accept(
            message, self._stamp, self._published_at, ended=False, paused=not self._waits
        )
        if accepted:
            self._answer()

    def _on_deadline(self) -> None:
        self._deadline.cancel()
        if self._waits:
            self._answer()

    def _answer(self) -> None:
        """End a period: send the torques of its command, or those of the stop law."""
        self._waits = False
        self._commands.proceed()
        command = self._commands.acting
        self._braked += command is None
        tau = command.tau if isinstance(command, TorqueCommand) else None
        try:
            self._arm.write(self._torque(tau, self._commands.missed_in_row > 0))
        except FrankaError as error:
            self._tell(str(error))
        self._publish_external()
        self._next()

    def _rest(self) -> None:
        """Bring the arm to rest, if it is under torque control, and end that.

        Raises:
            FrankaError: the robot has ended it.
        """
        arm, end = self._arm, time.monotonic() + _STOP_TIMEOUT
        while arm.controlled:
            arm.read()
            torque = self._torque(None, False)
            arm.write(torque, self._drive.stop.at_rest or time.monotonic() > end)

    def _torque(self, command: Array | None, held: bool) -> list[float]:
        """Return the torques to send for the last state."""
        state = self._arm.state
        q, v, applied = map(np.array, (state.q, state.dq, state.tau_J_d))
        return self._drive.torque(q, v, command, held, applied, self._arm.in_turn).tolist()

    def _asked(self, tau: Array) -> Array:
        return self._drive.asked(np.array(self._arm.state.q), tau)

    def _publish_external(self) -> None:
        """Publish what libfranka estimates of forces from outside, where somebody listens."""
        state = self._arm.state
        if self._external_torques.subscribers:
            torques = JointState(
                name=self._config.joints, effort=array("d", state.tau_ext_hat_filtered)
            )
            set_stamp(torques.header.stamp, self._stamp)
            self._external_torques.publish_outside(torques)
        if self._external_wrench.subscribers:
            wrench = state.O_F_ext_hat_K
            base = self._config.base_frame
            self._external_wrench.publish_outside(
                wrench_message(base, wrench[:3], wrench[3:], self._stamp)
            )

    # Errors and loads

    def _tell(self, fault: str) -> None:
        """Say why there is no torque control."""
        self._waits = False
        if fault != self._fault:
            self._fault = fault
            self.get_logger().error(f"no torque control: {fault}; call {self.get_name()}/recover")
            self._diagnostics.publish()

    def _on_recover(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        arm, response.success = self._arm, False
        if arm.controlled and self._drive.load_is_told:
            response.message = "torque control is on already"
            return response
        reading, self._waits = arm.connected and not self._waits, False
        connected = arm.connected
        try:
            self._rest()
            arm.recover()
            if not connected:
                self._set_clock()
            self._begin()
        except FrankaError as error:
            response.message = str(error)
        else:
            response.success, response.message = True, "torque control is on, the arm is held"
        if not reading:
            self._next()
        return response

    def _on_load(self) -> None:
        self.get_logger().info(
            f"payload {self._drive.payload}: its weight is added here until ~/recover brings the "
            "arm to rest and tells the robot, which takes loads only without torque control"
        )

    # Diagnostics

    def _control(self) -> str:
        """Return what moves or holds the robot."""
        if not self._arm.controlled:
            return "off"
        acting = self._commands.acting
        if acting is not None:
            return "torque" if isinstance(acting, TorqueCommand) else "position"
        return "stopped" if self._drive.stop.at_rest else "stopping"

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        commands, state, control = self._commands, self._arm.state, self._control()
        values = {
            "control": control,
            "robot_mode": state.robot_mode.name,
            "robot_errors": str(state.current_errors),
            "fault": self._fault or "none",
            "stamp_ns": self._stamp,
            "period_s": self._config.dt,
            "periods": self._periods,
            "periods_lost": self._arm.lost,
            "control_command_success_rate": float(state.control_command_success_rate),
            "deadline_misses": commands.missed,
            "braked_periods": self._braked,
            "clipped_periods": self._drive.clipped,
            "commands_refused": self._refused,
            "latency_p50_us": 1e6 * commands.latencies.percentile(50),
            "latency_p99_us": 1e6 * commands.latencies.percentile(99),
            "commanded_torque_ratio_max": commands.torque_ratio,
            "payload": str(self._drive.payload),
            "payload_told": str(self._drive.told),
        }
        if control == "off":
            return DiagnosticStatus.ERROR, f"no torque control: {self._fault}", values
        if commands.acting is None:
            return DiagnosticStatus.WARN, f"{control}: no commands", values
        return DiagnosticStatus.OK, "running", values

    def destroy_node(self) -> None:
        """Bring the arm to rest and end the torque control, too."""
        if hasattr(self, "_arm"):
            try:
                self._rest()
            except FrankaError as error:
                self._tell(str(error))
            self._arm.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the robot node until it is shut down."""
    return run(FrankaNode, args)


if __name__ == "__main__":
    sys.exit(main())
