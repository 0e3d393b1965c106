# SPDX-License-Identifier: Apache-2.0
"""Handover of simulated robots, with all nodes: it is not felt."""

from __future__ import annotations

import numpy as np
import pytest
from controller_chain import NODE
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from sim_bridge.node.bullet_node import BulletNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.messages import wrench_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import read_config

pytestmark = pytest.mark.long


class HandoverArm:
    """A robot in lockstep with bounds and controller, all of them real; recorded."""

    def __init__(self, ros, robot) -> None:
        values = read_config(robot, "bounds_node", NODE, "bullet_node") | {
            "clock": "lockstep",
            "bounds_timeout": 20.0,
            "state_timeout": 40.0,
            "start_control": "position",
        }
        values = {key: value for key, value in values.items() if value != []}
        self.ros = ros
        self.tau_max = np.array(values["torque_max"])
        self.states = ros.listen(JointState, "joint_states")
        self.commands = ros.listen(JointState, "joint_commands")
        ros.start(ControllerNode, values)
        ros.start(BoundsNode, values)
        self.wrenches = ros.probe.create_publisher(WrenchStamped, "external_wrench", GOAL_QOS)
        ros.hears("joint_commands")
        ros.start(BulletNode, values)

    def run(self, periods: int) -> None:
        """Let the robot move on by at least as many control periods."""
        goal = len(self.states) + periods
        self.ros.wait_until(lambda: len(self.states) >= goal, f"{periods} periods", timeout=120.0)

    def enable(self, torque: bool) -> None:
        response = self.ros.call(SetBool, f"{NODE}/enable_torque", SetBool.Request(data=torque))
        assert response.success, response.message

    def recorded(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, torques of the motors, and which periods torque commands began."""
        states = dict(zip(self.states.stamps, self.states, strict=True))
        commands = dict(zip(self.commands.stamps, self.commands, strict=True))
        stamps = sorted(states)[:-1]
        n = len(self.tau_max)  # locked joints follow
        q = np.array([states[s].position[:n] for s in stamps])
        tau = np.array([states[s].effort[:n] for s in stamps])
        return q, tau, np.array([len(commands[s].effort) > 0 for s in stamps])


@pytest.mark.parametrize(
    ("robot", "load"),
    [("talos_left_arm", "friction"), ("talos_left_arm", "push"), ("panda", "")],
)
def test_the_handover_is_not_felt(ros, robot, load):
    arm = HandoverArm(ros, robot)
    arm.run(100)
    if load:
        arm.wrenches.publish(wrench_message("arm_left_5_link", (30.0, -40.0, 50.0)))  # for 0.5 s
        arm.run(750 if load == "friction" else 180)  # in friction the arm sticks thereafter
    arm.enable(True)
    arm.run(200)
    arm.enable(False)
    arm.run(300)
    q, tau, by_torque = arm.recorded()
    first, last = np.flatnonzero(by_torque)[[0, -1]]
    assert by_torque[first:last].all()
    assert last - first > 150
    # In the state after the one first answered with torque, the effort is that torque.
    steps = np.abs(np.diff(tau, axis=0)) / arm.tau_max
    if load:
        assert np.ptp(tau[50:first] / arm.tau_max, axis=0).max() > 0.05, "hardly a load"
    ordinary = steps[first - 50 : first].max(axis=0)
    assert (steps[first] < ordinary + 0.01).all()
    assert (steps[first + 1 : first + 50] < 0.01).all()
    if load != "push":
        # Nothing is to be seen of it either, nor of the way back.
        assert np.abs(q[first:last] - q[first]).max() < 1e-3
        assert np.abs(q[last:] - q[last]).max() < 1e-3
        assert (steps[last : last + 2] < 0.01).all()


def test_an_arm_in_motion_is_brought_to_rest_before_its_drives_take_it(ros):
    arm = HandoverArm(ros, "talos_left_arm")
    arm.run(50)
    arm.enable(True)
    arm.run(50)
    joints = list(arm.states[0].name)
    goal = np.array(arm.states[0].position) + 0.25
    goals = ros.talk(JointState, "target_posture", GOAL_QOS)
    ros.set_parameters(NODE, posture_kp=20.0, pose_weight=0.0)
    goals.publish(JointState(name=joints, position=goal.tolist()))
    ros.wait_until(lambda: np.abs(arm.states[-1].velocity).max() > 0.3, "motion")
    arm.enable(False)
    ros.wait_until(lambda: ros.reported(NODE, "control") == "position", "the drives")
    arm.run(300)
    q, tau, by_torque = arm.recorded()
    last = np.flatnonzero(by_torque)[-1]
    steps = np.abs(np.diff(tau, axis=0)) / arm.tau_max
    # Taken in motion, drives brake it with the whole of their torque in one step.
    assert steps[last : last + 50].max() < 0.1
    assert np.abs(q[last:] - q[last]).max() < 2e-3
