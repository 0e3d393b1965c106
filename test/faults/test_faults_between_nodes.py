# SPDX-License-Identifier: Apache-2.0
"""The fault node between a robot and its controller, in real time."""

import numpy as np
import pytest
from chain import load_values

from sim_bridge.nodes.bullet_node import BulletNode
from sim_bridge.nodes.fault_node import BEFORE, FaultNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.ros.topics import JOINT_STATES
from viability_bounds_pkg.testing.ros_harness import joint_state, overrides

ROBOT = "baxter_left_arm"
VALUES = load_values(ROBOT) | {"start_paused": False}
VALUES |= {"posture_kp": 25.0, "posture_kd": 10.0, "posture_weight": 1.0, "pose_weight": 0.0}
START = np.array(VALUES["start_positions"])
OTHER = START + [0.4, 0.0, 0.4, 0.4, 0.4, 0.4, 0.4]
CHAIN = {"joint_states": BulletNode, "acceleration_limits": BoundsNode}
CHAIN |= {"joint_commands": ControllerNode}


def start(ros, path, text):
    """Run arm, bounds, controller and faults; return the arm and the fault node."""
    path = path / "faults.yaml"
    path.write_text(f"topics: [{', '.join(CHAIN)}]\nfaults:\n{text}")
    arm = None
    for topic, kind in CHAIN.items():
        arguments = ["--ros-args", "-r", f"{topic}:={BEFORE}{topic}"]
        more = {"parameter_overrides": overrides(VALUES), "cli_args": arguments}
        node = ros.add(kind(context=ros.context, **more))
        arm = arm or node
    return arm, ros.start(FaultNode, {"faults": str(path), "fault_seed": 1})


def wander(ros, arm):
    """Send the arm to and fro; return a function that does, to be called often."""
    user = ros.talk(JOINT_STATES.message, "target_posture", GOAL_QOS)
    goals = [START, OTHER]

    def on():
        if np.abs(arm._robot.state().q - goals[0]).max() < 0.1:
            goals.reverse()
        user.publish(joint_state(VALUES["joints"], 0, goals[0]))

    return on


FAULTS = {
    "lost states": ("joint_states", "drop: ", "controller_node"),
    "lost limits": ("acceleration_limits", "drop: ", "controller_node"),
    "lost commands": ("joint_commands", "drop: ", "bullet_node"),
    "burst of commands": ("joint_commands", "burst: ", "bullet_node"),
    "states that are no numbers": ("joint_states", "corrupt: {how: nan}", "controller_node"),
    "commands that are no numbers": ("joint_commands", "corrupt: {how: nan}", "bullet_node"),
    "names of another robot": ("joint_states", "corrupt: {how: names}", "controller_node"),
    "stamps of the past": ("joint_states", "stamp: {offset: -0.3}", "controller_node"),
    "degrees for radians": ("joint_states", "scale: {factor: 57.3}", "controller_node"),
    "positions that froze": (
        "joint_states",
        "freeze: {field: position}",
        "controller_node",
    ),
    "joints that are swapped": (
        "joint_states",
        "swap: {joints: [left_s0, left_e1]}",
        "controller_node",
    ),
    "positions with a bias": (
        "joint_states",
        "bias: {offset: 0.3, field: position}",
        "controller_node",
    ),
    "another controller": ("joint_commands", "rival: {offset: 20}", "bullet_node"),
    "another robot": ("joint_states", "rival: {offset: 0.5}", "controller_node"),
}


@pytest.mark.parametrize(("topic", "what", "node"), FAULTS.values(), ids=FAULTS)
def test_limits_are_kept_and_the_arm_goes_on_afterwards(ros, tmp_path, topic, what, node):
    arm, faults = start(
        ros, tmp_path, f"  - {{time: 0.5, duration: 0.4, topic: {topic}, {what}}}\n"
    )
    on = wander(ros, arm)

    def speed():
        return np.abs(arm._robot.state().v).max()

    ros.wait_until(lambda: faults.streams[topic].acting, "the fault", each=on)
    ros.wait_until(lambda: not faults.streams[topic].acting, "its end", each=on)
    assert sum(faults.streams[topic].touched.values()) > 10
    ros.wait_until(lambda: ros.reported("controller_node", "mode") == "TRACKING", each=on)
    ros.wait_until(lambda: speed() > 0.1, "motion again", each=on)
    assert not arm._monitor.violated


def test_delays_are_kept_and_a_rival_is_another_node_for_its_time(ros, tmp_path):
    path = tmp_path / "faults.yaml"
    path.write_text(
        """
topics: [joint_states]
faults:
  - {time: 0.0, duration: 1.0, topic: joint_states, delay: {delay: 0.05}}
  - {time: 2.0, duration: 1.0, topic: joint_states, rival: {offset: 1.0}}
"""
    )
    ros.start(FaultNode, {"faults": str(path)})
    robot = ros.talk(JOINT_STATES.message, f"{BEFORE}joint_states", JOINT_STATES.qos)
    heard = ros.listen(JOINT_STATES.message, "joint_states", JOINT_STATES.qos)

    def send(time):
        robot.publish(joint_state(["a"], round(1e9 * time) + 10**9, [0.0]))

    send(0.0)
    ros.run_for(0.03)
    assert not heard
    ros.wait_until(lambda: len(heard) == 1, "the message")
    ros.wait_until(lambda: len(heard) > 1, each=lambda: send(1.5))

    def publishers():
        infos = ros.probe.get_publishers_info_by_topic("/joint_states")
        return sorted(info.node_name for info in infos)

    assert publishers() == ["fault_node"]
    ros.wait_until(
        lambda: publishers() == ["fault_node", "rival_of_joint_states"], each=lambda: send(2.5)
    )
    ros.wait_until(lambda: any(message.position[0] == 1.0 for message in heard))
    ros.wait_until(lambda: publishers() == ["fault_node"], each=lambda: send(3.5))


def test_a_file_that_is_wrong_stops_the_node(ros, tmp_path):
    ros.refuses_to_start(FaultNode, {"faults": str(tmp_path / "none.yaml")}, "faults")
    path = tmp_path / "faults.yaml"
    path.write_text("topics: [joint_state]")
    ros.refuses_to_start(FaultNode, {"faults": str(path)}, "faults", "did you mean 'joint_states'")


def test_joints_that_messages_do_not_have_are_told(ros, tmp_path, capfd):
    path = tmp_path / "faults.yaml"
    path.write_text(
        "topics: [joint_states]\nfaults:\n  - {time: 1, duration: 1, topic: joint_states, "
        "bias: {offset: 1, joints: [elbow]}}\n"
    )
    ros.start(FaultNode, {"faults": str(path)})
    robot = ros.talk(JOINT_STATES.message, f"{BEFORE}joint_states", JOINT_STATES.qos)
    heard = ros.listen(JOINT_STATES.message, "joint_states", JOINT_STATES.qos)
    ros.wait_until(lambda: heard, each=lambda: robot.publish(joint_state(["a"], 0, [0.0])))
    assert "'joint_states' has no elbow" in capfd.readouterr().err
