# SPDX-License-Identifier: Apache-2.0
"""The robot node: simulates an arm with torque- and position-controlled motors."""

from __future__ import annotations

import math
import sys
import time
from array import array
from collections import Counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool, Trigger

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.sensor import ForceTorqueReading
from sim_bridge.hardware import Sensing
from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from sim_bridge.node.drives import Drives
from sim_bridge.node.topics import CLOCK, PAUSE, RECORDED, RESET
from sim_bridge.node.world_subscriber import WorldSubscriber
from sim_bridge.pace import Pace
from viability_bounds_pkg.plausible import RESTART_GAP
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import wrench_message
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.robot_urdf import warn_of_unusual
from viability_bounds_pkg.ros.runtime import set_stamp, stamp_to_ns, steady_timer
from viability_bounds_pkg.ros.topics import (
    FT_WRENCH,
    JOINT_COMMANDS,
    JOINT_STATES,
    ROBOT_DESCRIPTION,
)

Array = NDArray[np.float64]

RETRY_PERIOD = 0.03
"""Twice it is shorter than the 75 ms after which a controller counts the robot as silent, s."""

AHEAD = 20
"""Periods that a robot in lockstep goes on without its recorder; a socket's buffer keeps more."""


class BulletNode(ArmNode):
    """An arm that publishes ``joint_states`` and follows ``joint_commands``.

    A command with efforts sets the torques of the motors. One without efforts sets the positions,
    and optionally the velocities, that the motors' own drives control. Each command may be of
    either kind.

    With ``clock: real_time`` each control period has its duration on the wall clock. A command
    that comes within the period of the state with its stamp acts during that period, or, with
    ``command_delay``, so many periods later, when it also may come so much later; without one the
    last command is held, and after ``command_timeout`` periods the robot stops itself. Where
    acceleration limits are given, both keep all limits, and commands that return get their effect
    back gradually; where not, the brakes stop it. With ``clock:
    lockstep`` a period ends when the command with its stamp has come, without a limit of time;
    likewise the robot waits for a recorder that tells what it has, so that no state is lost.

    The robot's brakes are on until the first command.

    Imperfections that parameters switch on stand between the messages and the robot: states are
    reported by `Sensing`, commands arrive by a `CommandPath`, torques are those of `Motors`.
    """

    NAME = "bullet_node"
    PARAMETERS = BulletConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            self._node_parameters = NodeParameters(self, BulletConfiguration)
            config = self._node_parameters.configuration
            warn_of_unusual(self, config, config.urdf)
            self._robot = make_robot(config)
            self._refused: Counter[str] = Counter()
            self._drives = Drives(config, self._robot, self._refused, self.get_logger().warning)
        self._config, self._commands = config, self._drives.commands
        self._monitor = LimitMonitor.of(config)
        self._robot.monitor = self._monitor
        self._dt_ns = round(1e9 * config.dt)
        self._paused = config.start_paused
        # In lockstep robot time starts at one period: a stamp of zero means "no stamp".
        self._stamp = 0 if config.lockstep else self.get_clock().now().nanoseconds
        self._has_moved = False
        self._advanced = True
        self._world = WorldSubscriber(
            self,
            self._robot,
            lambda: self._stamp,
            config.external_wrench_timeout,
            self._refused,
        )
        self._ft_wrench = WrenchStamped()
        self._ft_publisher = self.stream(FT_WRENCH) if self._robot.sensor else None
        self._pace = Pace(config.rate_hz)
        self._sensing = Sensing(config.imperfections, config.torque_max, config.dt)
        self._restart()
        self._make_interface()
        self.announce(config.joints, config.rate_hz, f"simulated, clock {config.clock}")
        self._next_state()

    def _make_interface(self) -> None:
        """Create publishers, subscriptions, services and timers."""
        config = self._config
        # Joints that are locked, too: robot_state_publisher places no link without its joint.
        locked = self._robot.locked
        self._locked_at = array("d", locked.values())
        self._at_rest = array("d", [0.0] * len(locked))
        self._names = [*config.joints, *locked]
        self._state_publisher = self.stream(JOINT_STATES)
        self._clock_publisher = CLOCK.publisher(self) if config.publish_clock else None
        description = ROBOT_DESCRIPTION.publisher(self)
        description.publish(String(data=config.urdf))
        self.listen(JOINT_COMMANDS, self._on_command)
        if config.lockstep:
            RECORDED.subscription(self, self._on_recorded)
        RESET.serve(self, self._on_reset)
        PAUSE.serve(self, self._on_pause)
        if not config.lockstep:
            steady_timer(self, config.dt, lambda: self._state_publisher.in_turn(self._tick))
        steady_timer(self, RETRY_PERIOD, self._retry)
        if self._clock_publisher is not None:
            self.publisher_watch.add(self._clock_publisher.topic_name)
        self._diagnostics = Diagnostics(self, self._report, self.publisher_watch)

    def _restart(self) -> None:
        """Reset the robot and all counts; robot time continues."""
        config = self._config
        n = len(config.joints)
        self._world.clear()
        self._robot.reset(config.start_positions, np.zeros(n))
        self._reading = self._sensing.reset(*self._true_state())
        sensor = self._robot.sensor
        seed = config.imperfections.imperfection_seed
        self._sensor = ForceTorqueReading(sensor, config.sensor, seed) if sensor else None
        self._monitor.reset()
        self._drives.restart()
        self._pace.restart()
        self._plan_pause()
        self._refused.clear()
        self._recorded: float = math.inf  # stamp, ns; no recorder has told one yet

    def _plan_pause(self) -> None:
        """Compute the period at which to pause, `pause_after` from now."""
        periods = round(self._node_parameters.configuration.pause_after / self._config.dt)
        self._pause_at: float = self._pace.periods + periods if periods else math.inf

    @property
    def true_positions(self) -> NDArray[np.float64]:
        """Positions of the joints as they are, whatever is reported, shape (n,), rad."""
        return self._robot.state().q

    # Control periods

    def _next_state(self) -> None:
        """Start a control period and publish its state."""
        self._stamp += self._dt_ns
        self._advanced = False
        q, v, tau = self._reading
        tau = self._drives.reported(q, tau)
        # New messages: nodes of this process may keep the last ones, and others get theirs later.
        state = self._state = JointState(
            name=self._names,
            position=array("d", q.tobytes()) + self._locked_at,
            velocity=array("d", v.tobytes()) + self._at_rest,
            effort=array("d", tau.tobytes()) + self._at_rest,
        )
        set_stamp(state.header.stamp, self._stamp)
        if self._clock_publisher is not None:
            self._clock_publisher.publish(ClockMessage(clock=state.header.stamp))
        if self._ft_publisher and self._sensor:  # first: subscribers use it with the state
            wrench = self._sensor.read()
            frame = self._config.sensor.ft_frame
            self._ft_wrench = wrench_message(frame, wrench[:3], wrench[3:], self._stamp)
            self._ft_publisher.publish(self._ft_wrench)
        self._published_at = time.monotonic()
        self._state_publisher.publish(state)

    def _true_state(self) -> tuple[Array, Array, Array]:
        """Return the state of the joints, and the torques that the drives believe to give."""
        q, v, _ = self._robot.state()
        return q, v, self._robot.believed_torque

    def _advance(self) -> None:
        """Simulate the current period under the last command, or the robot's own law."""
        self._world.apply_due(self._stamp)
        self._drives.advance(self._pace.periods)
        self._reading = self._sensing.read(*self._true_state())
        self._pace.periods += 1
        self._has_moved = True
        self._advanced = True
        if self._pace.periods >= self._pause_at:
            self._pause_at = math.inf
            self._pause()

    def _tick(self) -> None:
        """End a period in real time and begin the next."""
        self._pace.tick(self._paused)
        if self._paused:
            return
        if not self._advanced:
            self._advance()
        self._next_state()

    def _pause(self) -> None:
        self._paused = True
        self._diagnostics.publish()

    def _retry(self) -> None:
        """Publish the state again: it may have been lost, or there was no subscriber yet."""
        waiting = self._paused or self._config.lockstep
        if waiting and time.monotonic() - self._published_at > RETRY_PERIOD:
            if self._ft_publisher is not None:
                self._ft_publisher.publish(self._ft_wrench)
            self._state_publisher.publish(self._state)

    # Commands

    def _on_command(self, message: JointState) -> None:
        if not self._commands.accept(
            message,
            self._stamp,
            self._published_at,
            ended=self._advanced,
            paused=self._paused or self._awaits_recorder(),
        ):
            return
        self._advance()
        # After a pause by itself the next state is not published: time stops for all nodes.
        if self._config.lockstep and not self._paused and not self._awaits_recorder():
            self._next_state()

    def _on_recorded(self, message: Header) -> None:
        waited = self._awaits_recorder()
        self._recorded = stamp_to_ns(message.stamp)
        if waited and not self._awaits_recorder():
            self._next_state()

    def _awaits_recorder(self) -> bool:
        """Return whether the next period does not begin until states of before are recorded."""
        ahead = self._stamp - self._recorded
        return self._advanced and not self._paused and ahead >= AHEAD * self._dt_ns

    # Services

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._has_moved:
            # As robots that start again: else the leap is taken for a state that cannot be. Also
            # where it is at its start already: the controller may not have seen the last reset.
            self._stamp += round(1e9 * RESTART_GAP)
        self._restart()
        self._next_state()
        response.success = True
        response.message = "at the start configuration, at rest"
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._paused and not request.data:
            self._paused = False
            self._pace.resume()
            self._plan_pause()
            # A new stamp: commands that answer what was sent during the pause are for old goals,
            # also those still on their way. In real time it comes with the next tick, so that
            # the first period is a whole one.
            self._commands.resume(self._stamp)
            self._advanced = True
            if self._config.lockstep:
                self._next_state()
        elif request.data:
            self._pause()
        response.success = True
        response.message = "paused" if self._paused else "running"
        return response

    # Diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        monitor, commands = self._monitor, self._commands
        latencies, obstacles, control = (
            commands.latencies,
            self._robot.obstacles,
            self._drives.control,
        )
        values = {
            "clock": "lockstep" if self._config.lockstep else "real_time",
            "paused": self._paused,
            "control": control,
            "stamp_ns": self._stamp,
            "period_s": self._config.dt,
            **self._pace.values(),
            "physics_steps_per_period": self._config.substeps,
            "deadline_misses": commands.missed,
            "missed_deadlines_injected": commands.path.missed,
            "imperfections": ", ".join(self._config.imperfections.names) or "none",
            "braked_periods": self._drives.braked,
            "commands_refused": self._refused,
            "world_changes_pending": len(self._world),
            "contact_force_n": obstacles.force,
            "contact_force_max_n": obstacles.force_max,
            "latency_p50_us": 1e6 * latencies.percentile(50),
            "latency_p99_us": 1e6 * latencies.percentile(99),
            "commanded_torque_ratio_max": commands.torque_ratio,
            "position_violation_rad": monitor.max_position_violation,
            "velocity_violation_rad_s": monitor.max_velocity_violation,
            "torque_ratio": monitor.max_torque_ratio,
            "lower_clearance_rad": monitor.closest_to_q_min,
            "upper_clearance_rad": monitor.closest_to_q_max,
        }
        if too_slow := self._pace.too_slow():
            self.get_logger().warning(too_slow)
        if monitor.violated:
            return DiagnosticStatus.ERROR, "a limit was broken", values
        if self._paused:
            return DiagnosticStatus.OK, "paused", values
        if self._awaits_recorder():
            return DiagnosticStatus.OK, "waiting for the recorder", values
        if commands.acting is None:
            doing = "braking" if control == "brakes" else control
            return DiagnosticStatus.WARN, f"{doing}: no commands", values
        return DiagnosticStatus.OK, "running", values

    def destroy_node(self) -> None:
        """Disconnect from the physics engine too."""
        if hasattr(self, "_robot"):
            self._robot.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the robot node until it is shut down."""
    return run(BulletNode, args)


if __name__ == "__main__":
    sys.exit(main())
