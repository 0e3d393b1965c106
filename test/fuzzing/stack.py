# SPDX-License-Identifier: Apache-2.0
"""The real nodes on a wire of the test: what they are sent, and the claims that must hold."""

from __future__ import annotations

import functools
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pinocchio as pin
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fuzzing.edit import Edit
from fuzzing.good_messages import GoodMessages
from fuzzing.message_edits import edited
from fuzzing.stepped_nodes import Delivery, SteppedClock, Wire, stepped_clock
from fuzzing.tally import TAKEN, ClaimBroken, Tally
from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.nodes.bullet_node import BulletNode
from sim_bridge.nodes.fault_node import FaultNode
from sim_bridge.nodes.scenario_node import ScenarioNode
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.safety.handover import PATIENCE, Control
from torque_safety_controller.safety.modes import Mode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.robot_description import build_model, read_urdf
from viability_bounds_pkg.ros.given_parameters import given_parameters, note_arguments
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp, stamp_to_ns
from viability_bounds_pkg.state_estimation.state_check import GAP
from viability_bounds_pkg.testing.ros_harness import config_folder

VARIANTS: dict[str, tuple[str, ...]] = {
    "panda": ("panda",),
    "panda, imperfect": ("panda", "imperfect/panda"),
    "baxter": ("baxter_left_arm",),
}
"""Robots, with the files that describe them."""
KINDS = {
    kind.NAME: kind
    for kind in (BulletNode, BoundsNode, EstimatorNode, ControllerNode, ScenarioNode, FaultNode)
}
STREAMS: dict[str, type] = {
    "joint_states": JointState,
    "estimated_joint_states": JointState,
    "acceleration_limits": JointTrajectory,
    "joint_commands": JointState,
    "ft_wrench": WrenchStamped,
}
"""What nodes send each other."""
GOALS = (
    "target_pose",
    "target_posture",
    "target_trajectory",
    "target_joint_trajectory",
    "jog_hand",
    "jog_joints",
    "target_wrench",
)
WORLD = ("external_wrench", "payload", "obstacles")
TO_FAULTS = tuple(
    f"/bench/before_faults/{name}"
    for name in ("joint_states", "acceleration_limits", "joint_commands")
)
TOPICS = (*STREAMS, *GOALS, *WORLD, "/clock", "/diagnostics", *TO_FAULTS)
"""All that any node subscribes to while it runs."""

_AHEAD = 2.0  # s; a stamp that is farther ahead is forgotten after `state_timeout`
_ROUNDING = 1e-9
_SEEN = {"hand_pose": PoseStamped, "hand_position_error": Vector3Stamped}
"""Topics for tools that cost nothing without a subscriber."""
_GRAPH = 2.0
"""How long the graph may take to change, s."""
_ROW = 20
"""As many periods in a row must be answered then."""
_AGAIN = 2.0
"""Within which the arm must track again, s."""


@functools.cache
def _pinocchio(urdf: str, joints: tuple[str, ...]) -> pin.Model:
    return build_model(read_urdf(urdf), joints)


class Stack:
    """Robot, bounds, estimator where it is used, controller, a recorder and a fault node.

    Args:
        variant: a key of `VARIANTS`.
        real_time: whether the robot goes on without commands, by the clock of the test, or waits.
        clock: of the nodes.
        tally: counts what becomes of messages.
        domain: of ROS.

    Attributes:
        wire: between the nodes.
        trusted: whether nothing was believed or changed since the last reset under which limits
            are not promised.
    """

    def __init__(
        self, variant: str, real_time: bool, clock: SteppedClock, tally: Tally, domain: int
    ) -> None:
        files = [str(config_folder() / f"{name}.yaml") for name in VARIANTS[variant]]
        scenario = config_folder() / "scenarios" / f"{VARIANTS[variant][0]}_demo.yaml"
        self.arguments = ["fuzz", "--ros-args", "--log-level", "warn"]
        for file in files:
            self.arguments += ["--params-file", file]
        for rule in (
            f"clock:={'real_time' if real_time else 'lockstep'}",
            "bullet_node:use_sim_time:=true",  # its stamps begin at zero, each time
            f"scenario:={scenario}",
            f"faults:={config_folder() / 'faults' / 'bad_day.yaml'}",
        ):
            self.arguments += ["-p", rule]
        self.clock, self.tally, self.real_time = clock, tally, real_time
        self.context = rclpy.Context()
        rclpy.init(
            args=self.arguments,
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        note_arguments(self.context, self.arguments)
        self.wire = Wire(clock)
        self.wire.before, self.wire.after = self._before, self._after
        self.values = dict(given_parameters(self.arguments, "/bullet_node"))
        self.own = {name: given_parameters(self.arguments, f"/{name}") for name in KINDS}
        self.joints = list(self.values["joints"])
        self.tau_max = np.array(self.values["torque_max"])
        self.dt = 1.0 / self.values["rate_hz"]
        self.good = GoodMessages(self.values | self.own["controller_node"])
        self.last: dict[str, Any] = {name: kind() for name, kind in STREAMS.items()}
        self.nodes: dict[str, Node] = {}
        self.rivals: dict[str, Node] = {}
        self.away: Counter[str] = Counter()
        self.trusted = True
        self.commands = 0
        self._first: dict[str, dict[str, ParameterValue]] = {}
        self._felt_wrong = False
        self._held: Any = None
        self._true: Any = None
        self._odd = False
        self._counters: dict[Node, list[Counter[str]]] = {}
        for name, look in (
            ("joint_states", self._on_state),
            ("estimated_joint_states", self._on_estimate),
            ("acceleration_limits", self._on_limits),
            ("joint_commands", self._on_command),
            ("ft_wrench", lambda message: self._passing("ft_wrench", message)),
        ):
            self.wire.filters[f"/{name}"] = look
        self.user = Node("user", context=self.context, start_parameter_services=False)
        self._senders: dict[str, Publisher] = {}
        self._of_scenario: set[str] = set()
        for name, kind in _SEEN.items():
            self.user.create_subscription(kind, name, lambda _: None, 1)
        self.user.create_subscription(JointState, "limit_distances", lambda _: None, 1)
        for name in KINDS:
            self.user.create_subscription(Float64MultiArray, f"{name}/values", lambda _: None, 1)
        self.estimated = bool(self.own["bounds_node"].get("use_estimated_states"))
        for name in KINDS:
            if name != "estimator_node" or self.estimated:
                self.start(name)
        self._of_scenario = {each.topic_name for each in self.nodes["scenario_node"].publishers}

    def close(self) -> None:
        """Take everything down."""
        for node in [*self.rivals.values(), *self.nodes.values(), self.user]:
            node.destroy_node()
        rclpy.shutdown(context=self.context)

    # Nodes

    def start(self, name: str) -> None:
        """Start a node."""
        more = {"namespace": "/bench"} if name == "fault_node" else {}
        node = KINDS[name](context=self.context, direct_delivery=self.wire, **more)
        self._felt_wrong &= name != "controller_node"
        self.nodes[name] = node
        self.wire.nodes.append(node)
        values: Mapping[str, Any] = {}
        if hasattr(node, "_report"):
            values = node._report()[2]
        self._counters[node] = [
            value
            for key, value in values.items()
            if isinstance(value, Counter) and "refused" in key
        ]
        self.wire.settle()

    def leave(self, name: str) -> None:
        """End a node."""
        node = self.nodes.pop(name)
        del self._counters[node]
        published = {each.topic_name for each in node.publishers}
        topics = [each for each in STREAMS if f"/{each}" in published]
        counts = {each: self.user.count_publishers(each) for each in topics}
        self.wire.leave(node)
        node.destroy_node()
        for topic, count in counts.items():
            self._wait_for_publishers(topic, count - 1)

    def rival(self, topic: str) -> None:
        """Have another node publish a topic, or end it."""
        before = self.user.count_publishers(topic)
        if topic in self.rivals:
            self.rivals.pop(topic).destroy_node()
            self._wait_for_publishers(topic, before - 1)
            return
        node = Node(
            f"rival_{topic}", context=self.context, start_parameter_services=False, cli_args=[]
        )
        node.create_publisher(STREAMS[topic], topic, 1)
        self.rivals[topic] = node
        self._wait_for_publishers(topic, before + 1)

    def _wait_for_publishers(self, topic: str, count: int) -> None:
        """Wait until the graph, which DDS tells by itself, has so many publishers."""
        deadline = time.monotonic() + _GRAPH
        while self.user.count_publishers(topic) != count and time.monotonic() < deadline:
            time.sleep(0.0)

    # Time

    def period(self) -> None:
        """Let a control period pass."""
        if self.real_time:
            self.wire.pass_time(self.dt)
        state, self._held = self._held, None
        if state is not None and not self._lost("joint_states"):
            self.wire.send("/joint_states", state)
        if not self.real_time:
            self.wire.pass_time(self.dt)

    def run(self, periods: int) -> None:
        """Let control periods pass."""
        for _ in range(periods):
            self.period()

    def _lost(self, name: str) -> bool:
        if not self.away[name]:
            return False
        self.away[name] -= 1
        return True

    # What passes between the nodes

    def _passing(self, name: str, message: Any) -> bool:
        self.last[name] = message
        return not self._lost(name)

    def _on_state(self, message: JointState) -> bool:
        """Keep the newest state of the robot until the next period."""
        self._held = self._true = self.last["joint_states"] = message
        return False

    def _on_estimate(self, message: JointState) -> bool:
        if not np.isfinite(_of_joints(message, self.joints)).all():
            raise ClaimBroken(f"an estimated state is not finite: {message}")
        return self._passing("estimated_joint_states", message)

    def _on_limits(self, message: JointTrajectory) -> bool:
        low, high = (np.array(point.accelerations) for point in message.points)
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
            raise ClaimBroken(f"limits are not finite, or lower above upper: {low}, {high}")
        return self._passing("acceleration_limits", message)

    def _on_command(self, message: JointState) -> bool:
        """Check what is sent to the robot."""
        self.commands += 1
        if list(message.name) != self.joints:
            raise ClaimBroken(f"a command for {message.name}")
        if message.effort:
            tau = np.array(message.effort)
            if not np.isfinite(tau).all():
                raise ClaimBroken(f"a torque is not finite: {tau}")
            if (np.abs(tau) > self.tau_max * (1.0 + _ROUNDING)).any():
                raise ClaimBroken(f"a torque beyond torque_max: {tau}")
        elif not np.isfinite(message.position).all() or len(message.position) != len(self.joints):
            raise ClaimBroken(f"a position command is not finite: {message.position}")
        return self._passing("joint_commands", message)

    # Odd messages

    def inject(
        self, topic: str, changes: Sequence[Edit], seed: int, early: bool, through: bool
    ) -> None:
        """Send a message that is changed, and judge what becomes of it.

        Args:
            topic: one of `TOPICS`.
            changes: of a valid message.
            seed: of the valid message, where it is one of a user.
            early: of streams, whether it comes before the next valid one, with its stamp.
            through: whether it goes through the middleware.
        """
        name = topic.rpartition("/")[2]
        message = edited(self._base(name, seed, early), changes)
        resolved = topic if topic.startswith("/") else f"/{topic}"
        sender = self._sender(topic, type(message)) if through else None
        self.tally.sent[topic] += 1
        self.tally.facts["through DDS"] += sender is not None
        self._odd = True
        try:
            self.wire.send(resolved, message, sender)
        finally:
            self._odd = False

    def _base(self, name: str, seed: int, early: bool) -> Any:
        rng = np.random.default_rng(seed)
        if name in self.good.kinds:
            later = 0 if rng.random() < 0.7 else self._stamp() + int(rng.integers(10**9))
            return self.good.kinds[name](rng, later)
        if name == "clock":
            message = ClockMessage()
            set_stamp(message.clock, max(0, self._stamp()))
            return message
        if name == "diagnostics":
            return self._status(rng)
        message = self.last[name]
        if early and self._held is not None and name != "ft_wrench":
            message.header.stamp = self._held.header.stamp
        return message

    def _status(self, rng: np.random.Generator) -> DiagnosticArray:
        name = ("bullet_node", "controller_node", "bounds_node")[int(rng.integers(3))]
        values = {}
        if name in self.nodes:
            values = self.nodes[name]._report()[2]
        return DiagnosticArray(
            status=[
                DiagnosticStatus(
                    name=name, values=[KeyValue(key=k, value=str(v)) for k, v in values.items()]
                )
            ]
        )

    def _stamp(self) -> int:
        return 0 if self._true is None else stamp_to_ns(self._true.header.stamp)

    def _sender(self, topic: str, kind: type) -> Publisher | None:
        """Return the publisher of those who send a topic; None if they are away."""
        for node in self.nodes.values():
            for publisher in node.publishers:
                if publisher.topic_name == f"/{topic}":
                    return publisher
        if topic not in TO_FAULTS and (
            topic not in (*GOALS, *WORLD) or f"/{topic}" in self._of_scenario
        ):
            return None  # from somebody else it would be a second publisher
        if topic not in self._senders:
            self._senders[topic] = self.user.create_publisher(kind, topic, GOAL_QOS)
        return self._senders[topic]

    def good_goal(self, seed: int) -> None:
        """Send goals of a pose and a posture that can be reached."""
        rng = np.random.default_rng(seed)
        low, high = (np.array(self.values[f"position_{end}"]) for end in ("min", "max"))
        far = rng.uniform(low, high)
        near = np.clip(
            self.values["start_positions"] + rng.uniform(-0.3, 0.3, len(low)), low, high
        )
        q = far if rng.random() < 0.5 else near
        self.wire.send("/target_pose", self._pose_at(q))
        self.wire.send("/target_posture", self.good.posture(q))

    # What becomes of a message

    def _before(self, delivery: Delivery) -> tuple[list[dict[str, int]], Any]:
        counts = [dict(each) for each in self._counters[delivery.node]]
        return counts, self._evidence(delivery)

    def _evidence(self, delivery: Delivery) -> Any:
        """Return what changes when a node takes a message."""
        node, name = delivery.node, delivery.topic.rpartition("/")[2]
        if isinstance(node, ControllerNode):
            if name in GOALS:
                return len(node._goals)
            if name == "ft_wrench":
                sensor = node._controller.interaction.sensor
                return id(sensor._raw)
            if name == "acceleration_limits":
                return id(node._limits.lower)
            return node._states.heard_at
        if isinstance(node, BoundsNode | EstimatorNode):
            return node.commands_heard if name == "joint_commands" else node._reader.heard_at
        if isinstance(node, BulletNode):
            if name == "joint_commands":
                return node._periods, node._commands.latencies._count
            return len(node._world)
        if isinstance(node, FaultNode):
            return node._passed[name]
        return None

    def _after(self, delivery: Delivery, seen: tuple[list[dict[str, int]], Any]) -> None:
        node, topic = delivery.node, delivery.topic
        counts, evidence = seen
        if node not in self._counters:  # ended in this callback
            return
        rose = [
            reason
            for now, then in zip(self._counters[node], counts, strict=True)
            for reason, count in now.items()
            if count > then.get(reason, 0)
        ]
        taken = self._evidence(delivery) != evidence
        name = topic.rpartition("/")[2]
        alone = name not in self.rivals or node.count_publishers(topic) < 2
        if taken and not alone and not isinstance(node, FaultNode | ScenarioNode):
            raise ClaimBroken(f"{node.get_name()} obeys one of several that publish {topic}")
        if self._odd:
            self._judge(delivery, rose, taken)
        elif not (rose or taken):
            self._why_silent(delivery)

    def _judge(self, delivery: Delivery, rose: list[str], taken: bool) -> None:
        """Count what became of an odd message."""
        topic = delivery.topic
        key = topic if topic in TOPICS else topic.rpartition("/")[2]
        outcomes = self.tally.outcomes
        if rose:
            # Goals are counted by topic.
            why = "" if rose[0] in TOPICS else f": {' '.join(rose[0].split()[:4])}"
            outcomes[key, f"refused{why}"] += 1
        if taken:
            outcomes[key, TAKEN] += 1
            self._believe(delivery)
        if not (rose or taken):
            outcomes[key, self._why_silent(delivery)] += 1

    def _why_silent(self, delivery: Delivery) -> str:
        """Return where it is told that a message was neither taken nor counted.

        Raises:
            ClaimBroken: nowhere.
        """
        node, topic, message = delivery
        name = topic.rpartition("/")[2]
        if isinstance(node, ScenarioNode) or name == "clock":
            return "heard"
        if not node.publisher_watch.admits(topic):
            return "of several publishers"
        if isinstance(node, BulletNode) and name == "joint_commands" and node._paused:
            return "while the robot is paused"
        if name == "obstacles" and not message.markers:
            return "empty"
        of_state = isinstance(node, ControllerNode) and name == "joint_states"
        if of_state and stamp_to_ns(message.header.stamp) == node._states._left:
            return "undecided"
        raise ClaimBroken(
            f"{node.get_name()} dropped a message on {topic} without counting it: {message}"
        )

    def _believe(self, delivery: Delivery) -> None:
        """Note that something was believed under which limits are not promised."""
        node, topic, message = delivery
        name = topic.rpartition("/")[2]
        if name in WORLD or (name == "joint_commands" and isinstance(node, BulletNode)):
            self._lose_trust(name)
        elif name == "ft_wrench" and isinstance(node, ControllerNode):
            self._felt_wrong = True  # a filter keeps it, and a tare takes it for the bias
            self._lose_trust(name)
        elif name == "acceleration_limits" and isinstance(node, ControllerNode):
            if stamp_to_ns(message.header.stamp) > node._states.answered_stamp:
                self._lose_trust(name)
        elif name.endswith("joint_states") and not isinstance(node, FaultNode | ScenarioNode):
            reader = node._states if isinstance(node, ControllerNode) else node._reader
            q, v = _of_joints(self._true, self.joints)
            same = (
                np.abs(reader.q - q).max() < _ROUNDING and np.abs(reader.v - v).max() < _ROUNDING
            )
            # The estimator looks at the stamp and at the torques, too.
            other = isinstance(node, EstimatorNode) and message != self._true
            if not same or other or name.startswith("estimated"):
                self._lose_trust(name)
        elif name == "joint_commands" and isinstance(node, EstimatorNode):
            self._lose_trust(name)  # what it expects to act does not

    def _lose_trust(self, why: str) -> None:
        if self.trusted:
            self.tally.facts[f"limits not promised after {why}"] += 1
        self.trusted = False

    # Services

    def reset(self) -> None:
        """Put the robot at its start."""
        robot, controller = self.nodes["bullet_node"], self.nodes.get("controller_node")
        for _ in range(4):
            self.wire.call(robot, "reset", Trigger.Request())
            ahead = -np.inf
            if controller is not None:
                ahead = 1e-9 * (controller._states.stamp - robot._stamp)
            # Where a stamp ahead was believed, the gap in time that tells of a reset is missing;
            # where it is less than 2 s ahead, three more resets make one.
            if not -GAP <= ahead < _AHEAD:
                break
        # Then the controller does not see it, and drives go back to where they held the arm, at
        # speeds that are their own.
        blind = ahead > 0.0 and controller._handover.by_drives
        self.trusted = not (self.rivals or self._felt_wrong or blind)

    def pause(self, on: bool) -> None:
        """Let robot time stop, or go on."""
        self.wire.call(self.nodes["bullet_node"], "pause", SetBool.Request(data=on))

    def enable_torque(self, on: bool) -> None:
        """Ask for torque or position control."""
        if "controller_node" in self.nodes:
            request = SetBool.Request(data=on)
            self.wire.call(self.nodes["controller_node"], "enable_torque", request)

    def tare(self) -> None:
        """Take the wrench that is measured now for the sensor's bias."""
        node = self.nodes.get("controller_node")
        if node is not None and any("tare" in each.srv_name for each in node.services):
            self.wire.call(node, "tare_ft_sensor", Trigger.Request())

    def set_parameters(self, name: str, parameters: list[ParameterMessage]) -> list[bool]:
        """Set parameters of a node; return which were taken. A refusal must say why."""
        node = self.nodes[name]
        had = {
            each.name: node.get_parameter(each.name).get_parameter_value()
            for each in parameters
            if node.has_parameter(each.name)
        }
        request = SetParameters.Request(parameters=parameters)
        results = self.wire.call(node, "set_parameters", request).results
        for parameter, result in zip(parameters, results, strict=True):
            self.tally.sent[f"parameter of {name}"] += 1
            kind = TAKEN if result.successful else "refused"
            self.tally.outcomes[f"parameter of {name}", kind] += 1
            if not result.successful and not result.reason:
                raise ClaimBroken(f"{name} refused {parameter} without a reason")
            if not result.successful:
                continue
            self._first.setdefault(name, {}).setdefault(parameter.name, had[parameter.name])
            if name == "bounds_node" or "friction" in parameter.name:
                self._lose_trust(f"a change of {name}")
        return [result.successful for result in results]

    # Claims

    def check(self) -> None:
        """Check what must hold whatever came."""
        robot = self.nodes["bullet_node"]
        monitor = robot._monitor
        if (
            not (monitor.max_torque_ratio <= 1.0 + _ROUNDING).all()
            and np.isfinite(monitor.max_torque_ratio).any()
        ):
            raise ClaimBroken(f"torques of the motors: {monitor.max_torque_ratio} of torque_max")
        self.tally.facts["checks"] += 1
        if not self.trusted:
            return
        self.tally.facts["checks with limits"] += 1
        if (monitor.max_position_violation > 0.0).any():
            raise ClaimBroken(f"positions passed by {monitor.max_position_violation} rad")
        if (monitor.max_velocity_violation > _ROUNDING).any():
            raise ClaimBroken(f"speed limits passed by {monitor.max_velocity_violation} rad/s")

    def recover(self) -> None:
        """Let all causes go, and check that the arm tracks again by itself."""
        for topic in list(self.rivals):
            self.rival(topic)
        self.away.clear()
        for name in ("bounds_node", "controller_node", *["estimator_node"] * self.estimated):
            if name not in self.nodes:
                self.start(name)
        self._restore()
        self.pause(True)  # or it would pause after the time that was set before
        self.pause(False)
        if self._felt_wrong:
            self.leave("controller_node")
            self.start("controller_node")
        if not self.trusted:
            self.reset()
        self._track(self.nodes["controller_node"])

    def _track(self, controller: Any) -> None:
        q = np.clip(
            np.array(self.values["start_positions"]) + 0.05,
            self.values["position_min"],
            self.values["position_max"],
        )
        self.wire.send("/target_pose", self._pose_at(q))
        self.wire.send("/target_posture", self.good.posture(q))
        row = 0  # of periods that were answered, tracking
        by_drives = controller._handover.control is not Control.TORQUE
        # The torque of the motors has to be known before it is taken over.
        patience = _AGAIN + by_drives * PATIENCE
        for k in range(round(patience / self.dt)):
            before = self.commands
            self.period()
            tracking = controller._modes.mode is Mode.TRACKING and self.commands > before
            row = row + 1 if tracking else 0
            if row == _ROW:
                break
            if controller._handover.control is Control.POSITION and k % 50 == 10:
                self.enable_torque(True)
        else:
            raise ClaimBroken(
                f"not tracking again within {patience} s: {controller._modes.mode.value}, "
                f"{controller._modes.reason}; {self.commands} commands"
            )
        self.tally.facts["recoveries"] += 1

    def _pose_at(self, q: np.ndarray) -> PoseStamped:
        model = _pinocchio(self.values["robot_description"], tuple(self.joints))
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        own = self.own["controller_node"]
        base, hand = (
            data.oMf[model.getFrameId(own[key])] for key in ("base_frame", "end_effector_frame")
        )
        pose = base.actInv(hand)
        message = PoseStamped()
        message.header.frame_id = own["base_frame"]
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = pose.translation.tolist()
        o.x, o.y, o.z, o.w = pin.Quaternion(pose.rotation).normalized().coeffs().tolist()
        return message

    def _restore(self) -> None:
        """Give live parameters their first values, those of a node together."""
        for name, values in self._first.items():
            if name not in self.nodes:
                continue
            if any(value.type == ParameterType.PARAMETER_NOT_SET for value in values.values()):
                self.leave(name)  # no call makes it so
                self.start(name)
                continue
            parameters = [ParameterMessage(name=k, value=value) for k, value in values.items()]
            request = SetParametersAtomically.Request(parameters=parameters)
            result = self.wire.call(self.nodes[name], "set_parameters_atomically", request).result
            if not result.successful:
                raise ClaimBroken(f"{name} refuses its first parameters: {result.reason}")
        self._first.clear()


def _of_joints(message: JointState, joints: Sequence[str]) -> np.ndarray:
    """Return positions and velocities of joints, shape (2, n)."""
    where = [message.name.index(joint) for joint in joints]
    return np.array([message.position, message.velocity])[:, where]


@contextmanager
def running(variant: str, real_time: bool, tally: Tally) -> Iterator[Stack]:
    """Yield a stack, and take it down."""
    with stepped_clock() as clock:
        stack = Stack(variant, real_time, clock, tally, int(os.environ.get("ROS_DOMAIN_ID", "0")))
        try:
            yield stack
        finally:
            stack.close()
