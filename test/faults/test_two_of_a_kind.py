# SPDX-License-Identifier: Apache-2.0
"""Two robots, controllers or demos where there may be one: told, refused or kept apart."""

import os
import socket
import subprocess
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from chain import load_values
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode, ScenarioRefused, play
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.parts.contact.interaction import Interaction
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS, stamp_to_ns
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    FT_WRENCH,
    JOINT_COMMANDS,
    JOINT_STATES,
)
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state, overrides

ROOT = Path(__file__).resolve().parents[2]

VALUES = load_values("panda") | {"clock": "lockstep", "start_paused": True}
VALUES["scenario"] = str(ROOT / "config" / "scenarios" / "panda_demo.yaml")


def rival(ros, *topics):
    """A node of somebody else that takes part in nothing but the ROS graph."""
    node = ros.add(Node("driver", context=ros.context, namespace="theirs"))
    for topic in topics:
        topic.publisher(node, f"/{topic.name}")
    return node


@pytest.mark.parametrize(
    ("kind", "own", "obeyed"),
    [
        (BoundsNode, [ACCELERATION_LIMITS], [JOINT_STATES]),
        (ControllerNode, [JOINT_COMMANDS], [JOINT_STATES, ACCELERATION_LIMITS, FT_WRENCH]),
        (BulletNode, [JOINT_STATES, FT_WRENCH], [JOINT_COMMANDS]),
    ],
)
def test_each_node_reports_a_second_publisher_of_what_it_publishes_and_obeys(
    ros, kind, own, obeyed
):
    node = ros.start(kind, VALUES)
    usual = Node("usual", context=ros.context)  # what the node obeys in any case
    for topic in obeyed:
        topic.publisher(usual)
    ros.add(usual)
    other = rival(ros, *own, *obeyed)
    key = "topics_with_several_publishers"
    topics = [f"'/{topic.name}'" for topic in (*own, *obeyed)]

    def told():
        return all(topic in ros.reported(kind.NAME, key) for topic in topics)

    ros.wait_until(told, "a report")
    status = ros.diagnostics[kind.NAME]
    assert status["level"] >= DiagnosticStatus.WARN
    assert status["message"].endswith(status[key])
    assert "/theirs/driver" in status[key]
    assert sorted(node.publisher_watch.rivals) == sorted(topic.strip("'") for topic in topics)
    ros.stop(other)
    ros.wait_until(lambda: ros.reported(kind.NAME, key) == "none", "its end")


class Intruder:
    """Answers each joint state at once with what is wrong on a topic, and has the right stamp."""

    def __init__(self, ros, topic, values):
        self._topic, self._values = topic, values
        self.node = ros.add(Node("driver", context=ros.context, namespace="theirs"))
        self._publisher = topic.publisher(self.node, f"/{topic.name}")
        self.node.create_subscription(
            JOINT_STATES.message, "/joint_states", self._answer, JOINT_STATES.qos
        )
        self._sign, self._ended = 1.0, False

    def end(self, ros):
        """Leave."""
        self._ended = True
        ros.stop(self.node)

    def _answer(self, state):
        if self._ended:
            return
        joints, n = list(state.name), len(state.name)
        stamp = stamp_to_ns(state.header.stamp)
        self._sign = -self._sign
        if self._topic is JOINT_STATES:
            q = np.array(state.position) + 0.3 * self._sign
            message = joint_state(joints, stamp + 1_000_000, q, [0.5 * self._sign] * n)
        elif self._topic is JOINT_COMMANDS:
            joints = self._values["joints"]
            message = joint_state(joints, stamp, tau=self._values["torque_max"])
        else:
            message = acceleration_limits(joints, stamp, [-100.0] * n, [100.0] * n)
        self._publisher.publish(message)


@pytest.mark.parametrize(
    ("topic", "node", "key", "value"),
    [
        (
            JOINT_STATES,
            "controller_node",
            "reason",
            "2 publishers of '/joint_states': /bullet_node, /theirs/driver",
        ),
        (ACCELERATION_LIMITS, "controller_node", "mode", "HOLD"),
        (JOINT_COMMANDS, "bullet_node", "control", "stopped"),
    ],
    ids=["states", "limits", "commands"],
)
def test_what_an_intruder_publishes_is_not_obeyed_and_the_arm_stops(ros, topic, node, key, value):
    values = load_values("baxter_left_arm") | {"start_paused": False}
    values |= {"posture_kp": 25.0, "posture_kd": 10.0, "posture_weight": 1.0, "pose_weight": 0.0}
    arm = ros.start(BulletNode, values)
    for kind in (BoundsNode, ControllerNode):
        ros.start(kind, values)
    user = ros.talk(JOINT_STATES.message, "target_posture", GOAL_QOS)
    goal = np.array(values["start_positions"]) + [0.4, 0.0, 0.4, 0.4, 0.4, 0.4, 0.4]

    def moves():
        return np.abs(arm._robot.state().v).max() > 0.1

    ros.wait_until(
        moves, "motion", each=lambda: user.publish(joint_state(values["joints"], 0, goal))
    )
    intruder = Intruder(ros, topic, values)
    ros.wait_until(lambda: ros.reported(node, key) == value, value)
    ros.wait_until(lambda: np.abs(arm._robot.state().v).max() < 0.01, "rest")
    for _ in range(10):
        ros.run_for(0.05)
        assert np.abs(arm._robot.state().v).max() < 0.02
    assert not arm._monitor.violated
    told = f"2 publishers of '/{topic.name}'"
    nodes = "bullet_node", "bounds_node", "controller_node"
    assert any(told in ros.diagnostics[node]["message"] for node in nodes)
    intruder.end(ros)
    ros.wait_until(lambda: np.abs(arm._robot.state().q - goal).max() < 0.05, "the goal")
    assert not arm._monitor.violated


def test_goals_of_several_nodes_are_not_obeyed_and_the_arm_holds(ros):
    values = load_values("baxter_left_arm") | {"start_paused": False}
    for kind in (BulletNode, BoundsNode):
        ros.start(kind, values)
    controller = ros.start(ControllerNode, values)
    start = np.array(values["start_positions"])
    user = ros.talk(JOINT_STATES.message, "target_posture", GOAL_QOS)

    def ask(change):
        user.publish(joint_state(values["joints"], 0, start + change))

    def mode():
        return ros.reported("controller_node", "mode")

    ros.wait_until(lambda: mode() == "TRACKING", "motion", each=lambda: ask(0.1))
    other = rival(ros)
    theirs = other.create_publisher(JOINT_STATES.message, "/target_posture", GOAL_QOS)
    ros.wait_until(lambda: "/target_posture" in controller.publisher_watch.rivals)
    assert mode() == "TRACKING"  # that there is another is told; nothing was asked for
    goal = controller._controller.goals.q_des.copy()

    def both_ask():
        ask(0.2)
        theirs.publish(joint_state(values["joints"], 0, start - 0.1))

    ros.wait_until(lambda: mode() == "HOLD", "HOLD", each=both_ask)
    assert ros.reported("controller_node", "reason") == "several nodes publish goals"
    assert "/theirs/driver" in ros.diagnostics["controller_node"]["message"]
    assert np.array_equal(controller._controller.goals.q_des, goal)
    ros.stop(other)
    ros.wait_until(lambda: mode() == "TRACKING", "the first goal again")
    ros.wait_until(
        lambda: np.array_equal(controller._controller.goals.q_des, start + 0.2),
        "a goal",
        each=lambda: ask(0.2),
    )


def test_a_topic_of_ros2_control_is_watched_where_there_is_one(ros):
    node = ros.start(ControllerNode, VALUES | {"ros2_control_topic": "/effort/commands"})
    other = ros.add(Node("forward", context=ros.context))
    other.create_publisher(Float64MultiArray, "/effort/commands", 1)
    ros.wait_until(lambda: "/effort/commands" in node.publisher_watch.rivals)


def test_a_second_node_of_the_same_name_is_detected_too(ros):
    """As by starting a program twice; the robot obeys neither."""
    robot = ros.start(BulletNode, VALUES)
    ros.start(ControllerNode, VALUES)
    other = ros.start(ControllerNode, VALUES)
    ros.wait_until(
        lambda: (
            "/joint_commands" in robot.publisher_watch.rivals
            and "/joint_commands" in other.publisher_watch.rivals
        )
    )


def test_wrenches_of_several_nodes_count_as_silence(ros, monkeypatch):
    node = ros.start(ControllerNode, load_values("panda") | {"start_paused": False})
    felt = []
    monkeypatch.setattr(node._controller.find(Interaction).sensor, "receive", felt.append)
    sensor = FT_WRENCH.publisher(ros.add(Node("sensor", context=ros.context)))
    ros.wait_until(lambda: felt, each=lambda: sensor.publish(FT_WRENCH.message()))
    rival(ros, FT_WRENCH)
    ros.wait_until(lambda: "/ft_wrench" in node.publisher_watch.rivals)
    felt.clear()
    ros.run_for(0.2, each=lambda: sensor.publish(FT_WRENCH.message()))
    assert not felt


def test_a_run_that_others_mix_into_is_refused(ros):
    rival(ros, JOINT_COMMANDS)
    player = ros.start(ScenarioNode, VALUES)
    ros.add(ControllerNode(context=ros.context, parameter_overrides=overrides(VALUES)))
    ros.hears("/joint_commands", 2)
    expected = (
        r"^2 publishers of '/joint_commands': /controller_node, /theirs/driver; allowed: one"
    )
    ros.wait_until(lambda: player.ended.done(), "the end of the scenario")
    with pytest.raises(ScenarioRefused, match=expected):
        play(player, quiet=True)


# The domain of a demo


@contextmanager
def domain(**environment):
    """The domain that scripts/domain.sh sets, in a shell that lives on; or its error."""
    given = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
    script = ROOT / "scripts" / "domain.sh"
    with subprocess.Popen(
        ["bash", "-euc", f"source {script} || exit 2; echo $ROS_DOMAIN_ID; read -r"],
        env=given | environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as shell:
        yield shell.stdout.readline().strip()
        shell.communicate("\n")
    refused = shell.returncode == 2
    assert refused or shell.returncode == 0


def refusal(domain_id):
    return (
        f"error: another demo runs in ROS domain {domain_id}: stop it, or set another "
        "ROS_DOMAIN_ID or none"
    )


def test_of_two_demos_in_one_domain_the_second_is_refused_in_one_line(ros):
    given = {"ROS_DOMAIN_ID": str(ros.domain)}
    with domain(**given) as first, domain(**given) as second:
        assert first == str(ros.domain)
        assert second == refusal(ros.domain)
    with domain(**given) as third:
        assert third == str(ros.domain)


def test_demos_without_a_domain_are_kept_apart():
    with domain() as first, domain() as second, domain() as third:
        chosen = {int(first), int(second), int(third)}
    assert len(chosen) == 3
    assert min(chosen) >= 1
    assert max(chosen) <= 100


def test_a_domain_that_others_use_is_not_chosen():
    with domain() as first:
        pass
    script = ROOT / "scripts" / "domain.sh"
    port = 7410 + 250 * int(first)
    with socket.socket(type=socket.SOCK_DGRAM) as used:
        used.bind(("", port))
        told = subprocess.run(
            ["bash", "-c", f"source {script}; _is_used {first} && echo used"],
            env=os.environ | {"ROS_DOMAIN_ID": first},
            capture_output=True,
            text=True,
            check=True,
        )
    assert told.stdout.strip() == "used"
