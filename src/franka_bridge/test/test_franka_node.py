# SPDX-License-Identifier: Apache-2.0
"""The node with libfranka and a simulated FR3 that speaks its protocol."""

import numpy as np
import pytest
from geometry_msgs.msg import InertiaStamped
from sensor_msgs.msg import JointState
from simulated_fr3 import INSTALLED, START, VALUES, simulated_fr3
from std_srvs.srv import Trigger

if not INSTALLED:
    pytest.skip("source scripts/setup.sh --franka", allow_module_level=True)

from franka_bridge.node.franka_node import FrankaNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import joint_state

JOINTS = VALUES["joints"]
MS = 1_000_000  # ns


@pytest.fixture(scope="module")
def robot():
    with simulated_fr3() as started:
        yield started


class Probe:
    """A node for the robot, and what a controller sees and sends."""

    def __init__(self, ros, robot, **changes):
        self.ros = ros
        self.states = ros.listen(JointState, "joint_states")
        self.node = ros.start(FrankaNode, VALUES | {"robot_ip": robot.address} | changes)
        self.commands = ros.talk(JointState, "joint_commands")
        ros.wait_until(lambda: self.states, "a state")

    @property
    def control(self):
        return self.ros.reported("franka_node", "control")

    @property
    def q(self):
        return np.array(self.states[-1].position)

    def awaits(self, control):
        self.ros.wait_until(lambda: self.control == control, control)

    def answer(self, tau=(), q=()):
        """Send a command for the newest state; it is too late now and then."""
        self.commands.publish(joint_state(JOINTS, self.states.stamps[-1], q=q, tau=tau))

    def keeps_answering(self, until, what, **command):
        answered = 0

        def answer_and_look():
            nonlocal answered
            if len(self.states) > answered:
                answered = len(self.states)
                self.answer(**command)
            return until()

        self.ros.wait_until(answer_and_look, what)


@pytest.fixture
def probe(ros, robot):
    return Probe(ros, robot)


def test_states_are_those_of_the_robot_and_it_stands(probe):
    probe.ros.wait_until(lambda: len(probe.states) > 200)
    probe.awaits("stopped")
    stamps = np.diff(probe.states.stamps)
    assert (stamps > 0).all() and not (stamps % MS).any()
    assert list(probe.states[-1].name) == JOINTS
    np.testing.assert_allclose(probe.q, START, atol=2e-3)  # rad
    assert probe.states[-1].effort[3] > 15.0, "measured torques contain gravity"
    assert probe.ros.reported("franka_node", "robot_mode") == "Move"


def test_the_arm_is_held_before_a_controller_is_there(ros, robot):
    """Also in lockstep, where the node waits for the command of the first state."""
    probe = Probe(ros, robot, clock="lockstep")
    assert probe.node._drive.stop.at_rest


def test_commands_act_and_the_arm_stops_without_them(probe):
    probe.awaits("stopped")
    begin = probe.q[0]
    push = [10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    probe.keeps_answering(lambda: probe.q[0] > begin + 0.003, "joint 1 turns", tau=push)
    assert probe.control in ("torque", "stopping", "stopped")
    assert float(probe.ros.reported("franka_node", "periods")) > 0
    probe.awaits("stopped")
    there = probe.q
    seen = len(probe.states)
    probe.ros.wait_until(lambda: len(probe.states) > seen + 100)
    np.testing.assert_allclose(probe.q, there, atol=1e-3)  # rad


def test_position_commands_hold_the_arm_where_it_stands(probe):
    probe.awaits("stopped")
    there = probe.q
    elsewhere = there + 0.5
    probe.keeps_answering(lambda: probe.control == "position", "position", q=elsewhere)
    np.testing.assert_allclose(probe.q, there, atol=1e-3)  # rad


def test_a_load_is_told_the_robot_between_motions(probe):
    ros = probe.ros
    message = InertiaStamped()
    message.header.frame_id, message.inertia.m = "fr3_hand", 0.1
    ros.talk(InertiaStamped, "payload", GOAL_QOS).publish(message)
    ros.wait_until(lambda: ros.reported("franka_node", "payload") == "0.10 kg at fr3_hand")
    assert ros.reported("franka_node", "payload_told") == "none"
    there = probe.q
    assert ros.call(Trigger, "franka_node/recover", Trigger.Request()).success
    ros.wait_until(lambda: ros.reported("franka_node", "payload_told") == "0.10 kg at fr3_hand")
    probe.awaits("stopped")
    # The simulated hand is empty, so that torques against the load push it until it is held.
    np.testing.assert_allclose(probe.q, there, atol=0.02)  # rad
    seen = len(probe.states)
    ros.wait_until(lambda: len(probe.states) > seen + 20)


def test_a_control_that_the_robot_ends_is_told_and_begins_by_the_service_only(probe, capfd):
    probe.awaits("stopped")
    probe.node._arm._robot.stop()
    probe.awaits("off")
    seen = len(probe.states)
    probe.ros.wait_until(lambda: len(probe.states) > seen + 20, "states of a robot that stopped")
    assert probe.control == "off"
    told = [line for line in capfd.readouterr().err.splitlines() if "no torque control" in line]
    assert len(told) == 1 and "preempted" in told[0]
    assert probe.ros.call(Trigger, "franka_node/recover", Trigger.Request()).success
    probe.awaits("stopped")


def test_a_robot_that_went_is_told_and_comes_back_by_the_service(ros, robot, capfd):
    probe = Probe(ros, robot)
    probe.awaits("stopped")
    stamp = probe.states.stamps[-1]
    robot.switch_off()
    probe.awaits("off")
    told = [line for line in capfd.readouterr().err.splitlines() if "no torque control" in line]
    assert len(told) == 1 and "franka_node/recover" in told[0]
    failed = ros.call(Trigger, "franka_node/recover", Trigger.Request())
    assert not failed.success and "refused" in failed.message
    robot.switch_on()
    ros.run_for(0.3)
    assert probe.control == "off", "never by itself"
    recovered = ros.call(Trigger, "franka_node/recover", Trigger.Request())
    assert recovered.success, recovered.message
    probe.awaits("stopped")
    assert probe.states.stamps[-1] > stamp + 1000 * MS
    again = ros.call(Trigger, "franka_node/recover", Trigger.Request())
    assert not again.success and again.message == "torque control is on already"


XARM = {
    "robot_description": "package://example-robot-data/robots/xarm_description/urdf/xarm7.urdf",
    "joints": [f"joint{j}" for j in range(1, 8)],
    "end_effector_frame": "link_eef",
    "flange_frame": "link_eef",
}
SIX = {"acceleration_min": [-10.0] * 6, "acceleration_max": [10.0] * 6}


@pytest.mark.parametrize(
    ("name", "changes", "shown"),
    [
        ("robot_ip", {"robot_ip": "127.255.0.1"}, "FCI is on ([Errno 111] Connection refused)"),
        ("robot_ip", {"robot_ip": "no such robot"}, "the address of a robot"),
        ("real_time", {"real_time": True}, "false"),
        ("joints", {"joints": JOINTS[:6]} | SIX, "the 7 joints"),
        ("joints", {"joints": [*JOINTS[:6], "fr3_joint9"]}, "did you mean"),
        ("robot_description", XARM, "the robot's: this one has link_eef at"),
        ("rate_hz", {"rate_hz": 500.0}, "1000"),
        ("flange_frame", {"flange_frame": "fr3_link9"}, "did you mean"),
        ("end_effector_frame", {"end_effector_frame": "fr3_link3"}, "fr3_joint7 moves"),
        ("torque_rate_max", {"torque_rate_max": [2000.0] * 7}, "1000"),
        ("collision_force", {"collision_force": [1.0] * 3}, "6"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(shared_ros, robot, name, changes, shown):
    values = VALUES | {"robot_ip": robot.address} | changes
    shared_ros.refuses_to_start(FrankaNode, values, name, shown)
