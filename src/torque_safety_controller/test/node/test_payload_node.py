# SPDX-License-Identifier: Apache-2.0
"""A load that the controller is told of is held; others are refused."""

import math

import numpy as np
import pinocchio as pin
from arms import load_arm
from controller_chain import ControllerChain, patient_values
from controllers import pose_at
from geometry_msgs.msg import InertiaStamped, PoseStamped
from rclpy.node import Node

from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.ros.messages import pose_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS

ARM = load_arm("panda")
CENTRE = np.array([0.0, 0.0, 0.1])


def load(mass, link="panda_hand") -> InertiaStamped:
    message = InertiaStamped()
    message.header.frame_id = link
    message.inertia.m = float(mass)
    message.inertia.com.z = CENTRE[2]
    return message


class Carrying(ControllerChain):
    """A Panda that moves as its torques and its load tell it, by forward dynamics.

    Attributes:
        truth: model of the arm with what it really carries.
    """

    def __init__(self, ros) -> None:
        super().__init__(ros, patient_values("panda"))
        self.payloads = ros.talk(InertiaStamped, "payload", GOAL_QOS)
        self.poses = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
        self.truth = ARM.model.copy()
        self.q, self.v, self.stamp = ARM.q_start.copy(), np.zeros(ARM.n), 0
        self.tau = np.zeros(ARM.n)

    def grasp(self, mass) -> None:
        frame = self.truth.frames[frame_id(self.truth, "panda_hand")]
        body = pin.Inertia(mass, CENTRE, np.zeros((3, 3)))
        self.truth.appendBodyToJoint(frame.parentJoint, body, frame.placement)

    def step(self) -> None:
        """Let 2 ms of robot time pass."""
        self.stamp += 2
        command = self.ask(self.stamp, self.q, self.v, tau=self.tau)
        self.tau = np.array(command.effort)
        assert (np.abs(self.tau) <= ARM.tau_max).all()
        a = pin.aba(self.truth, self.truth.createData(), self.q, self.v, self.tau)
        self.q = self.q + 2e-3 * self.v + 2e-6 * a
        self.v = self.v + 2e-3 * a

    def off(self) -> float:
        """Return how far the hand is from where it was at first, m."""
        here, first = (pose_at(ARM, q).translation for q in (self.q, ARM.q_start))
        return float(np.linalg.norm(here - first))

    def until(self, key, value) -> None:
        self.ros.wait_until(lambda: value in self.reported(key), f"{key} {value}", each=self.step)


def test_a_load_is_held_from_the_next_step_on_and_without_its_publisher(ros, capfd):
    arm = Carrying(ros)
    arm.poses.publish(pose_message(pose_at(ARM, ARM.q_start)))
    arm.until("mode", "TRACKING")
    assert arm.reported("payload") == "none"
    before, q = arm.tau, arm.q
    arm.payloads.publish(load(2.0))
    ros.wait_until(lambda: "payload: 2.00 kg at panda_hand" in capfd.readouterr().err, "the load")
    ros.probe.destroy_publisher(arm.payloads)
    arm.grasp(2.0)
    arm.step()
    gravity, bare = (
        pin.computeGeneralizedGravity(each, each.createData(), q)
        for each in (arm.truth, ARM.model)
    )
    np.testing.assert_allclose(arm.tau - before, gravity - bare, atol=0.5)  # N m
    for _ in range(300):
        arm.step()
        assert arm.off() < 2e-3  # m; it would sink by 140 mm
    arm.until("payload", "2.00 kg at panda_hand")
    # The robot starts over, with stamps of long ago.
    arm.stamp, arm.tau = 0, np.zeros(ARM.n)
    for _ in range(20):
        arm.step()
    assert arm.reported("payload") == "2.00 kg at panda_hand"


def test_loads_that_cannot_be_are_refused_and_counted(ros, capfd):
    arm = Carrying(ros)
    arm.step()
    for message, count in (
        (load(-1.0), "mass: 1;"),
        (load(math.nan), "numbers: 1;"),
        (load(2.0, "panda_link0"), "frame_id: 1;"),
        (load(2.0, "moon"), "frame_id: 2;"),
    ):
        arm.payloads.publish(message)
        arm.until("payload_refused", count)
    assert "payload refused: mass is -1 kg" in capfd.readouterr().err
    assert arm.reported("payload") == "none"
    other = Node("other", context=ros.context)
    ros.add(other)
    second = other.create_publisher(InertiaStamped, "payload", GOAL_QOS)
    ros.wait_until(second.get_subscription_count, "the other one is heard")
    ros.wait_until(lambda: arm.node.count_publishers("payload") > 1, "it is known")
    arm.payloads.publish(load(2.0))
    arm.until("payload_refused", "several publishers: 1;")
    assert arm.reported("mode") != "STOPPED"
    ros.stop(other)
    # A load that a joint cannot hold where the arm stands gets a warning.
    arm.payloads.publish(load(15.0))
    arm.until("payload", "15.00 kg at panda_hand")
    assert "payload: too heavy where the arm stands: panda_joint" in capfd.readouterr().err
