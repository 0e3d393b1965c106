"""The scenario node: plays a scenario over the topics, shows it live, records and judges it."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from enum import Enum, auto
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.recording import Recorder, Run
from sim_bridge.scenario import PoseGoal, PostureGoal, Push
from sim_bridge.scenario_parameters import TABLE, make_configuration
from viability_bounds_pkg.ros_parameters import (
    NodeParameters,
    ParameterError,
)
from viability_bounds_pkg.ros_runtime import (
    GOAL_QOS,
    make_executor,
    report_refusal,
    set_stamp,
    stamp_to_ns,
)

_RECORDING_QOS = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)
_SHOW_PERIOD = 0.5
_POLL_PERIOD = 0.02


class Phase(Enum):
    """How far the scenario has come."""

    GETTING_READY = auto()
    """The robot is paused; the chain does not answer yet."""
    LOADING = auto()
    """Goals are sent; the controller does not report them yet."""
    PLAYING = auto()
    DONE = auto()


class ScenarioNode(Node):
    """Starts a paused robot with the goals of a scenario in place, and follows the run.

    Goals are sent ahead with the stamps at which they take effect, so that a run in lockstep
    is the same each time.

    Attributes:
        phase: how far it has come.
        stamp: of the last state, ns.
        robot: the robot's last diagnostics, by key.
        controller: the controller's.
        bounds: the bounds node's.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("scenario_node", **node_arguments)
        try:
            config = NodeParameters(self, TABLE, make_configuration).configuration
        except ParameterError:
            self.destroy_node()
            raise
        self.config = config
        self.phase = Phase.GETTING_READY
        self.robot: dict[str, str] = {}
        self.controller: dict[str, str] = {}
        self.bounds: dict[str, str] = {}
        self._recorder = Recorder(config.joints)
        self._state: JointState | None = None
        self.stamp = self._first = 0
        self._last = math.inf
        self._plan = None
        self._answered = False
        # Stamp from which on, ns; link; force; torque.
        self._pushes: list[tuple[int, str, tuple[float, ...], tuple[float, ...]]] = []
        self._wrench: WrenchStamped | None = None
        self._index: list[int] | None = None
        self._poses = self.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
        self._postures = self.create_publisher(JointState, "target_posture", GOAL_QOS)
        self._wrenches = self.create_publisher(WrenchStamped, "external_wrench", GOAL_QOS)
        self._pause = self.create_client(SetBool, "bullet_node/pause")
        self._settings = self.create_client(SetParameters, "bullet_node/set_parameters")
        self.create_subscription(JointState, "joint_states", self._on_state, _RECORDING_QOS)
        self.create_subscription(
            JointTrajectory, "acceleration_limits", self._on_limits, _RECORDING_QOS
        )
        self.create_subscription(JointState, "joint_commands", self._on_command, _RECORDING_QOS)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_POLL_PERIOD, self._proceed, clock=steady)

    def recorded_run(self) -> Run:
        """Return what was recorded since the robot began to move."""
        return self._recorder.run(self._first)

    # What comes in

    def _on_state(self, message: JointState) -> None:
        if self._index is None:
            where = {name: i for i, name in enumerate(message.name)}
            if any(joint not in where for joint in self.config.joints):
                return
            self._index = [where[joint] for joint in self.config.joints]
        self._state = message
        self.stamp = stamp_to_ns(message.header.stamp)
        self._recorder.add_state(self.stamp, *self._arrays(message.position, message.velocity))

    def _arrays(self, *sequences) -> list[list[float]]:
        return [[sequence[i] for i in self._index] for sequence in sequences]

    def _on_limits(self, message: JointTrajectory) -> None:
        lower, upper = (point.accelerations for point in message.points)
        self._recorder.add_limits(stamp_to_ns(message.header.stamp), lower, upper)

    def _on_command(self, message: JointState) -> None:
        self._answered = True
        self._recorder.add_torque(stamp_to_ns(message.header.stamp), message.effort)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            if status.name == "controller_node":
                self.controller = values
            elif status.name == "bullet_node":
                self.robot = values
            elif status.name == "bounds_node":
                self.bounds = values

    # What happens when

    def _proceed(self) -> None:
        if self.phase is Phase.GETTING_READY and self._chain_is_up():
            self.phase = Phase.LOADING
            self._send_goals()
        elif self.phase is Phase.LOADING and self._goals_are_in():
            self.phase = Phase.PLAYING
            self._pause.call_async(SetBool.Request(data=False))
        elif self.phase is Phase.PLAYING:
            self._push()
            # It pauses by itself, and what it reports then is final.
            over = int(self.robot["stamp_ns"]) >= self._last
            if over and self.robot["paused"] == "True":
                self.phase = Phase.DONE

    def _chain_is_up(self) -> bool:
        return (
            self._answered
            and self.robot.get("paused") == "True"
            and self._pause.service_is_ready()
            and self._settings.service_is_ready()
            and self._poses.get_subscription_count() > 0
            and self._postures.get_subscription_count() > 0
        )

    def _goals_are_in(self) -> bool:
        goals = [event for event in self.config.scenario.events if not isinstance(event, Push)]
        planned = self._plan is not None and self._plan.done()
        return planned and self.controller.get("goals_pending") == str(len(goals))

    def _send_goals(self) -> None:
        # Resuming begins a period of its own: the first state that moves is the next.
        period = round(1e9 * float(self.robot["period_s"]))
        self._first = self.stamp + period
        duration = self.config.scenario.duration
        self._last = self._first + round(duration * 1e9 / period) * period - period
        end = RosParameter("pause_after", value=duration).to_parameter_msg()
        self._plan = self._settings.call_async(SetParameters.Request(parameters=[end]))
        for event in self.config.scenario.events:
            stamp = self._first + round(1e9 * event.time)
            if isinstance(event, PoseGoal):
                message = PoseStamped()
                message.header.frame_id = self.config.base_frame
                set_stamp(message.header.stamp, stamp)
                p, o = message.pose.position, message.pose.orientation
                p.x, p.y, p.z = event.position
                o.x, o.y, o.z, o.w = event.orientation
                self._poses.publish(message)
            elif isinstance(event, PostureGoal):
                message = JointState(
                    name=list(event.positions), position=list(event.positions.values())
                )
                set_stamp(message.header.stamp, stamp)
                self._postures.publish(message)
            else:
                release = stamp + round(1e9 * event.duration)
                self._pushes.append((stamp, event.link, event.force, event.torque))
                self._pushes.append((release, event.link, (0.0,) * 3, (0.0,) * 3))
        self._pushes.sort(key=lambda entry: entry[0])

    def _push(self) -> None:
        while self._pushes and self.stamp >= self._pushes[0][0]:
            _, link, force, torque = self._pushes.pop(0)
            self._wrench = message = WrenchStamped()
            message.header.frame_id = link
            f, t = message.wrench.force, message.wrench.torque
            f.x, f.y, f.z = force
            t.x, t.y, t.z = torque
        # Again and again: the robot lets go of a push that it hears no more of.
        if self._wrench is not None:
            self._wrenches.publish(self._wrench)

    # What is shown

    def live_line(self) -> str:
        """Return the state of the run in one line."""
        if self.phase is Phase.GETTING_READY or self._state is None:
            return "waiting for the nodes"
        q = np.array(self._arrays(self._state.position)[0])
        distance = np.minimum(q - self.config.q_min, self.config.q_max - q)
        nearest = int(np.argmin(distance))
        error = float(self.controller.get("position_error_m", "nan"))
        return (
            f"{max(0.0, (self.stamp - self._first) * 1e-9):6.2f} s  "
            f"{self.controller.get('mode', '?'):<8}  "
            f"nearest limit {self.config.joints[nearest]} {distance[nearest]:+.4f} rad  "
            f"pose error {1e3 * error:7.2f} mm  "
            f"{float(self.robot.get('rate_hz', 'nan')):5.0f} Hz"
        )


def play(node: ScenarioNode, others: Sequence[Node] = (), *, quiet: bool = False) -> None:
    """Run the scenario to its end, showing a live line.

    Args:
        node: the scenario.
        others: nodes to run in the same process.
        quiet: show nothing.

    Raises:
        TimeoutError: the other nodes did not come up, or stopped answering.
        ExternalShutdownException: told to stop before the end.
    """
    executor = make_executor(node.context)
    for each in (node, *others):
        executor.add_node(each)
    terminal = sys.stdout.isatty()
    shown_at = -math.inf
    progress, moved_at = None, time.monotonic()
    while node.phase is not Phase.DONE and rclpy.ok(context=node.context):
        executor.spin_once(timeout_sec=0.1)
        now = time.monotonic()
        if (node.stamp, node.phase) != progress:
            progress, moved_at = (node.stamp, node.phase), now
        elif now - moved_at > node.config.ready_timeout:
            phase = node.phase.name.lower().replace("_", " ")
            raise TimeoutError(f"nothing has moved for {node.config.ready_timeout:g} s ({phase})")
        if not quiet and now - shown_at > _SHOW_PERIOD:
            shown_at = now
            print(node.live_line(), end="\r" if terminal else "\n", flush=True)
    if node.phase is not Phase.DONE:
        raise ExternalShutdownException
    if not quiet:
        print(node.live_line(), flush=True)


def main(args: list[str] | None = None) -> int:
    """Play a scenario; with ``--out DIRECTORY`` also record and judge it.

    Returns:
        0 when no limit was broken, 1 when one was, 2 when the scenario could not be played.
    """
    argv = rclpy.utilities.remove_ros_args(args=sys.argv if args is None else args)
    try:
        out = _output_directory(argv)
        rclpy.init(args=args)
        node = ScenarioNode()
    except Exception as error:
        rclpy.try_shutdown()
        report_refusal(error)
        return 2
    try:
        play(node)
        if out is None:
            return 0
        from sim_bridge.report import write_report  # matplotlib takes a second to import

        return (
            0
            if write_report(out, node.config, node.recorded_run(), node.robot, node.bounds)
            else 1
        )
    except TimeoutError as error:
        report_refusal(error)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _output_directory(argv: list[str]) -> Path | None:
    """Return the value of ``--out``, or None without it."""
    if "--out" not in argv:
        return None
    value = argv[argv.index("--out") + 1 :][:1]
    if not value:
        raise ValueError("--out needs a directory")
    return Path(value[0])


if __name__ == "__main__":
    sys.exit(main())
