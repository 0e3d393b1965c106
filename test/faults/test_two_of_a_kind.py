# SPDX-License-Identifier: Apache-2.0
"""Two robots, controllers or demos where there may be one: told, refused or kept apart."""

import os
import subprocess
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from chain import load_values
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode, ScenarioRefused, play
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS, stamp_to_ns
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    FT_WRENCH,
    JOINT_COMMANDS,
    JOINT_STATES,
)
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state

ROOT = Path(__file__).resolve().parents[2]

PANDA = load_values("panda") | {"clock": "lockstep", "start_paused": True}
PANDA["scenario"] = str(ROOT / "config" / "scenarios" / "panda_demo.yaml")
BAXTER = load_values("baxter_left_arm") | {"bounds_timeout": 1.0, "state_timeout": 2.0}
BAXTER |= {"posture_kp": 25.0, "posture_kd": 10.0, "posture_weight": 1.0, "pose_weight": 0.0}
JOINTS, START = BAXTER["joints"], np.array(BAXTER["start_positions"])
TURN = np.array([1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # the shoulder is weak
GOAL = START + 0.4 * TURN


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
    ros.start(kind, PANDA)
    usual = ros.add(Node("usual", context=ros.context))  # what the node obeys in any case
    for topic in obeyed:
        topic.publisher(usual)
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
    ros.stop(other)
    ros.wait_until(lambda: ros.reported(kind.NAME, key) == "none", "its end")


class Arm:
    """Baxter's arm, and who sends it about."""

    def __init__(self, ros, clock="lockstep"):
        self.ros = ros
        self.robot = ros.start(BulletNode, BAXTER | {"clock": clock})
        for kind in (BoundsNode, ControllerNode):
            ros.start(kind, BAXTER)
        self.user = ros.talk(JOINT_STATES.message, "target_posture", GOAL_QOS)

    def ask(self, goal):
        self.user.publish(joint_state(JOINTS, 0, goal))

    def off(self, goal):
        return np.abs(self.robot.true_positions - goal).max()

    def mode(self):
        return self.ros.reported("controller_node", "mode")

    def rests(self):
        """Whether it stays where it is for some periods."""
        at, end = self.robot.true_positions, self.periods() + 10
        self.ros.wait_until(lambda: self.periods() >= end, "periods")
        return self.off(at) < 1e-3

    def periods(self):
        return int(self.ros.reported("bullet_node", "periods") or 0)

    def trouble(self):
        nodes = ("bullet_node", "bounds_node", "controller_node")
        return " ".join(self.ros.reported(node, "message") for node in nodes)


def intrude(ros, topic):
    """Answer each joint state at once with what is wrong on a topic, and has the right stamp.

    Returns:
        A function that ends it.
    """
    node = ros.add(Node("driver", context=ros.context, namespace="theirs"))
    publisher = topic.publisher(node, f"/{topic.name}")
    n, sign, present = len(JOINTS), 1.0, True

    def answer(state):
        nonlocal sign
        sign, stamp = -sign, stamp_to_ns(state.header.stamp)
        if topic is JOINT_STATES:
            q = np.array(state.position) + 0.3 * sign
            message = joint_state(state.name, stamp + 1_000_000, q, [0.5 * sign] * len(q))
        elif topic is JOINT_COMMANDS:
            message = joint_state(JOINTS, stamp, tau=BAXTER["torque_max"])
        else:
            message = acceleration_limits(JOINTS, stamp, [-100.0] * n, [100.0] * n)
        if present:
            publisher.publish(message)

    def leave():
        nonlocal present
        present = False
        ros.stop(node)

    node.create_subscription(JOINT_STATES.message, "/joint_states", answer, JOINT_STATES.qos)
    return leave


@pytest.mark.parametrize(
    ("topic", "clock", "node", "key", "value"),
    [
        # Where it gets no commands it stops by itself, in real time only.
        (
            JOINT_STATES,
            "real_time",
            "controller_node",
            "reason",
            "2 publishers of '/joint_states': /bullet_node, /theirs/driver",
        ),
        (JOINT_COMMANDS, "real_time", "bullet_node", "control", "stopped"),
        (ACCELERATION_LIMITS, "lockstep", "controller_node", "mode", "HOLD"),
    ],
    ids=["states", "commands", "limits"],
)
def test_what_an_intruder_publishes_is_not_obeyed_and_the_arm_stops(
    ros, topic, clock, node, key, value
):
    arm = Arm(ros, clock)
    ros.wait_until(lambda: arm.off(START) > 0.05, "motion", each=lambda: arm.ask(GOAL))
    leave = intrude(ros, topic)
    ros.wait_until(lambda: ros.reported(node, key) == value, value)
    ros.wait_until(arm.rests, "rest")
    at = arm.robot.true_positions
    assert f"2 publishers of '/{topic.name}'" in arm.trouble()
    leave()
    ros.wait_until(lambda: arm.off(at) > 0.05, "motion", timeout=120.0)
    ros.assert_limits_kept()


def test_goals_of_several_nodes_are_not_obeyed_and_the_arm_holds(ros):
    arm = Arm(ros)
    first, second, theirs = (START + turn * TURN for turn in (0.1, 0.4, -0.2))
    ros.wait_until(lambda: arm.off(first) < 0.06, "the goal", each=lambda: arm.ask(first))
    other = rival(ros)
    publisher = other.create_publisher(JOINT_STATES.message, "/target_posture", GOAL_QOS)
    ros.wait_until(lambda: "/theirs/driver" in arm.trouble(), "a report")

    def both_ask():
        arm.ask(second)
        publisher.publish(joint_state(JOINTS, 0, theirs))

    ros.wait_until(lambda: arm.mode() == "HOLD", "HOLD", each=both_ask)
    assert ros.reported("controller_node", "reason") == "several nodes publish goals"
    assert arm.off(first) < 0.1
    ros.stop(other)
    ros.wait_until(lambda: arm.mode() == "TRACKING", "the first goal again")
    ros.wait_until(lambda: arm.off(second) < 0.1, "the goal", each=lambda: arm.ask(second))


def test_a_second_node_of_the_same_name_is_detected_too(ros):
    """As by starting a program twice; the robot obeys neither."""
    ros.start(BulletNode, PANDA)
    for _ in range(2):
        ros.start(ControllerNode, PANDA)
    key, told = "topics_with_several_publishers", "2 publishers of '/joint_commands'"
    for node in ("bullet_node", "controller_node"):
        ros.wait_until(lambda node=node: told in ros.reported(node, key), node)


def test_a_run_that_others_mix_into_is_refused(ros):
    rival(ros, JOINT_COMMANDS)
    player = ros.start(ScenarioNode, PANDA)
    ros.start(ControllerNode, PANDA)
    ros.wait_until(lambda: player.ended.done(), "the end of the scenario")
    told = r"^2 publishers of '/joint_commands': /controller_node, /theirs/driver; allowed: one"
    with pytest.raises(ScenarioRefused, match=told):
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


def test_of_two_demos_in_one_domain_the_second_is_refused_in_one_line(ros):
    given = {"ROS_DOMAIN_ID": str(ros.domain)}
    with domain(**given) as first, domain(**given) as second:
        assert first == str(ros.domain)
        assert second == (
            f"error: another demo runs in ROS domain {ros.domain}: stop it, or set another "
            "ROS_DOMAIN_ID or none"
        )
    with domain(**given) as third:
        assert third == str(ros.domain)


def test_demos_without_a_domain_are_kept_apart():
    with domain() as first, domain() as second:
        assert first != second
        assert 1 <= min(int(first), int(second)) <= max(int(first), int(second)) <= 100
