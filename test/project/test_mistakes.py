# SPDX-License-Identifier: Apache-2.0
"""Each mistake of test/mistakes.yaml gets the line that stands there."""

from __future__ import annotations

import itertools
import re
import shlex
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml
from geometry_msgs.msg import PoseStamped
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosidl_parser.definition import Array, BasicType, NamespacedType, UnboundedSequence
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.node import bullet_node, scenario_node
from sim_bridge.node.bullet_node import BulletNode
from torque_safety_controller.node import controller_node
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.tools import gain_limits, identify_friction
from viability_bounds_pkg.node import bounds_node, estimator_node
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros import arm_node, messages, program, robot_urdf
from viability_bounds_pkg.ros.runtime import CONTROL_QOS, GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import (
    RosHarness,
    joint_state,
    private_domain,
    read_config,
)

ROOT = Path(__file__).resolve().parents[2]
PANDA = read_config("panda", "bounds_node")
JOINTS = PANDA["joints"]
N = len(JOINTS)
REST = PANDA["start_positions"]
ZERO = [0.0] * N
MS = 1_000_000
WORDS = {"JOINTS": JOINTS, "ZEROS": ZERO, "ONES": [1.0] * N, "NANS": [float("nan")] * N}
PROGRAMS = {
    "bounds_node": bounds_node.main,
    "estimator_node": estimator_node.main,
    "controller_node": controller_node.main,
    "bullet_node": bullet_node.main,
    "scenario_node": scenario_node.main,
    "gain_limits": lambda a: gain_limits.main(a[1:]),
    "identify_friction": lambda a: identify_friction.main(a[1:]),
}
ALL = yaml.safe_load((ROOT / "test" / "mistakes.yaml").read_text(encoding="utf-8"))
LOG = re.compile(r"\[[A-Z]+\] \[[\d.]+\] \[[\w.]+\]: ")


def of_kind(*kinds: str) -> list[Any]:
    return [pytest.param(m, id=m["did"]) for m in ALL if set(kinds) & set(m)]


# Command lines


@pytest.mark.parametrize("mistake", of_kind("run"))
def test_on_a_command_line(mistake, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(ROOT / "config")
    for name, content in mistake.get("files", {}).items():
        (tmp_path / name).write_text(content)
    # Of the whole process, so that it may be what another test wanted.
    set_logger_level("", LoggingSeverity.INFO)
    # A node that starts all the same ends at once.
    monkeypatch.setattr(program, "spin", lambda *_: None)
    monkeypatch.setattr(scenario_node, "play", lambda *_: None)
    monkeypatch.setattr(robot_urdf, "_TOPIC_TIMEOUT", 0.1)
    words = shlex.split(mistake["run"])
    while "=" in words[0]:
        monkeypatch.setenv(*words.pop(0).split("=", 1))
    try:
        code = PROGRAMS[words[0]](words)
    except SystemExit as end:
        code = end.code
    lines = capfd.readouterr().err.strip().splitlines()
    texts = [LOG.sub("", line) for line in lines if not line.startswith("[INFO]")]
    texts = [text.replace("for 0.1 s", "for 10 s") for text in texts]
    assert texts == [mistake["line"]]
    assert (code != 0) == texts[0].startswith(("error: ", f"{words[0]}: "))


# Running nodes


class Running:
    """Nodes in this process, and a user."""

    def __init__(self, harness: RosHarness) -> None:
        self.ros = harness
        self.other: RosHarness | None = None
        self.topics: dict[str, Any] = {}

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message as the nodes' subscribers want it."""
        if topic not in self.topics:
            stream = topic in ("joint_states", "joint_commands", "ft_wrench")
            qos = CONTROL_QOS if stream else GOAL_QOS
            self.topics[topic] = self.ros.talk(type(message), topic, qos)
        self.topics[topic].publish(message)

    def start(self, make: Any, **changed: Any) -> None:
        """Start a node of Panda's."""
        self.ros.start(make, read_config("panda", make.NAME) | changed)


@pytest.fixture
def gets(capfd):
    """Wait until nodes have logged a line."""
    logged: list[str] = []

    def look(line: str) -> bool:
        logged.extend(LOG.sub("", each) for each in capfd.readouterr().err.splitlines())
        return line in logged

    def wait(running: Running, line: str, each=None) -> None:
        try:
            running.ros.wait_until(lambda: look(line), each=each)
        except AssertionError:
            assert line in logged

    return wait


@contextmanager
def run_nodes(*kinds, **changes):
    with private_domain() as domain:
        running = Running(RosHarness(domain))
        for kind in kinds:
            running.start(kind, **changes)
        yield running
        running.ros.close()


@pytest.fixture(scope="module")
def nodes():
    """A bounds node and a controller without a robot."""
    with run_nodes(BoundsNode, ControllerNode) as running:
        yield running


@pytest.fixture(scope="module")
def controller():
    """A controller alone, which obeys limits of others."""
    with run_nodes(ControllerNode) as running:
        yield running


@pytest.fixture(scope="module")
def robot():
    """A robot in lockstep that waits for its first command."""
    with run_nodes(BulletNode, clock="lockstep") as running:
        yield running


def imported(name: str) -> Any:
    package, kind, message = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), message)


def filled(message: Any, content: dict[str, Any]) -> Any:
    """Fill a message as ``ros2 topic pub`` does."""
    kinds = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
    for name, value in content.items():
        kind = kinds[name]
        if isinstance(kind, NamespacedType):
            filled(getattr(message, name), value)
            continue
        if isinstance(kind, UnboundedSequence) and isinstance(kind.value_type, NamespacedType):
            element = imported("/".join(kind.value_type.namespaced_name()))
            value = [filled(element(), each) for each in value]
        elif isinstance(kind, Array | UnboundedSequence) and isinstance(
            kind.value_type, BasicType
        ):
            value = list(map(float, value))
        setattr(message, name, value)
    return message


@pytest.mark.parametrize("mistake", of_kind("send"))
def test_in_a_message(mistake, nodes, controller, robot, gets):
    sent = mistake["send"]
    text = sent["message"]
    for word, value in WORDS.items():
        text = text.replace(word, yaml.safe_dump(value, default_flow_style=True).strip())
    message = filled(imported(sent["type"])(), yaml.safe_load(text))
    others = dict.fromkeys(("external_wrench", "obstacles"), robot)
    heard = (others | {"acceleration_limits": controller}).get(sent["topic"], nodes)
    gets(heard, mistake["line"], each=lambda: heard.publish(sent["topic"], message))


@pytest.mark.parametrize("mistake", of_kind("set"))
def test_in_a_parameter_of_a_running_node(mistake, nodes):
    given = mistake["set"]
    assert nodes.ros.refuses(given["node"], **{given["name"]: given["value"]}) == mistake["line"]


@pytest.mark.parametrize("mistake", of_kind("call"))
def test_in_a_call(mistake, nodes):
    given = mistake["call"]
    kind = imported(given["type"])
    request = filled(kind.Request(), yaml.safe_load(given["request"]))
    response = nodes.ros.call(kind, given["service"], request)
    assert not response.success
    assert response.message == mistake["line"]


# What needs more than that


def leaping_position(running):
    running.start(ControllerNode)
    stamps = itertools.count(1000 * MS, 2 * MS)
    leaps = itertools.cycle([0.0, 0.1])  # again, because a busy machine may lose the first

    def send():
        q = [REST[0] + next(leaps), *REST[1:]]
        running.publish("joint_states", joint_state(JOINTS, next(stamps), q, ZERO))

    return send


def other_rate(running):
    running.start(BoundsNode)
    answers = running.ros.listen(JointTrajectory, "acceleration_limits")
    stamps = iter(range(4 * MS, 100_000 * MS, 4 * MS))

    def send():
        for stamp in itertools.islice(stamps, 10):
            state = joint_state(JOINTS, stamp, REST, ZERO)
            # Until it is answered: a lost one would be a longer period.
            running.ros.wait_until(
                lambda stamp=stamp: stamp in answers.stamps[-1:],
                each=lambda state=state: running.publish("joint_states", state),
            )

    return send


def stray_commands(running):
    running.start(BulletNode, clock="lockstep")

    def send():
        for _ in range(10):
            running.publish("joint_commands", joint_state(JOINTS, 7_000 * MS, tau=ZERO))
            running.ros.spin()

    return send


def best_effort_goal(running):
    running.start(ControllerNode)
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    running.ros.probe.create_publisher(PoseStamped, "target_pose", best_effort)


def other_type(running):
    running.start(ControllerNode)
    running.other = RosHarness(running.ros.domain)  # one context cannot have two types of a topic
    running.other.probe.create_publisher(String, "target_pose", GOAL_QOS)


def no_clock(running):
    running.start(BoundsNode, use_sim_time=True)


@pytest.mark.parametrize("mistake", of_kind("scene"))
def test_in_a_scene(mistake, ros, gets, monkeypatch):
    monkeypatch.setattr(arm_node, "CLOCK_TIMEOUT", 0.1)
    monkeypatch.setattr(arm_node, "_TYPE_PERIOD", 0.1)
    # Between two diagnostics, which come ten times as often here, on a slow machine.
    monkeypatch.setattr(messages, "_PERIODS_SEEN", 2)
    running = Running(ros)
    try:
        each = globals()[mistake["scene"]](running)
        gets(running, mistake["line"].replace("for 5 s", "for 0.1 s"), each)
    finally:
        if running.other is not None:
            running.other.close()
