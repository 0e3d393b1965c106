# SPDX-License-Identifier: Apache-2.0
"""Jogs and trajectories of the joints, through the real nodes in lockstep."""

import itertools
import math

import numpy as np
import pytest
from arms import load_arm
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sim_bridge.node.bullet_node import BulletNode
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.remote.teleop import Teleop
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp, stamp_to_ns
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

KINDS = {"bounds_node": BoundsNode, "controller_node": ControllerNode, "bullet_node": BulletNode}
PATIENT = {"clock": "lockstep", "bounds_timeout": 5.0, "state_timeout": 10.0, "rate_hz": 200.0}


class Driven:
    """A Panda in lockstep, and a user who sends something at instants of the robot's time."""

    def __init__(self, ros) -> None:
        self.ros = ros
        values = read_config("panda", *KINDS) | PATIENT
        self.joints = values["joints"]
        self.low, self.high = np.array(values["position_min"]), np.array(values["position_max"])
        # Not before the robot runs: publishers are found by then.
        ros.start(ControllerNode, values)
        ros.start(BoundsNode, values)
        self.hand = ros.talk(TwistStamped, "jog_hand", GOAL_QOS)
        self.jog = ros.talk(JointState, "jog_joints", GOAL_QOS)
        self.trajectory = ros.talk(JointTrajectory, "target_joint_trajectory", GOAL_QOS)
        self.states = ros.listen(JointState, "joint_states")
        ros.start(BulletNode, values)
        ros.wait_until(lambda: len(self.states) > 2)

    @property
    def q(self) -> np.ndarray:
        return np.array(self.states[-1].position[: len(self.joints)])

    def refused(self) -> str:
        return self.ros.reported("controller_node", "goals_refused")

    def positions(self, begin=0) -> np.ndarray:
        return np.array([state.position[: len(self.joints)] for state in self.states[begin:]])

    def run(self, duration: float, send=lambda: None, every: float = 0.05) -> None:
        """Let robot time pass; call `send` again and again meanwhile."""
        now, due = stamp_to_ns(self.states[-1].header.stamp), 0
        end = now + round(1e9 * duration)
        while now < end:
            if now >= due:
                send()
                due = now + round(1e9 * every)
            self.ros.spin(0.1)
            now = stamp_to_ns(self.states[-1].header.stamp)


@pytest.fixture
def arm(ros):
    return Driven(ros)


def hand_at(q) -> np.ndarray:
    """Return where the hand is, shape (3,), m."""
    model = load_arm("panda").robot(0.0)
    model.update(State(q, np.zeros(7)), np.zeros(7))
    return model.pose.translation.copy()


def points(*rows, step=0.5):
    """Return points of (positions, velocities, accelerations) `step` apart, s."""
    made = []
    for k, parts in enumerate(rows, 1):
        point = JointTrajectoryPoint()
        for what, values in zip(("positions", "velocities", "accelerations"), parts, strict=False):
            setattr(point, what, [float(value) for value in values])
        ns = round(1e9 * k * step)
        point.time_from_start.sec, point.time_from_start.nanosec = ns // 10**9, ns % 10**9
        made.append(point)
    return made


def test_a_trajectory_is_followed_and_then_held(arm):
    start = arm.q
    arm.run(0.02)
    goal = start + np.array([0.3, 0.2, -0.3, 0.2, 0.2, 0.2, 0.4])
    names = arm.joints[::-1]  # matched by name
    begin = stamp_to_ns(arm.states[-1].header.stamp) + 100_000_000
    message = JointTrajectory(joint_names=names, points=points([(goal)[::-1]], step=2.0))
    set_stamp(message.header.stamp, begin)
    arm.trajectory.publish(message)
    arm.run(2.6)
    arm.ros.assert_limits_kept()
    t = (np.array(arm.states.stamps) - begin) * 1e-9 / 2.0
    x = np.clip(t, 0.0, 1.0)[:, None]
    meant = start + (goal - start) * (3 * x**2 - 2 * x**3)  # the cubic from rest to rest
    assert np.abs(arm.positions() - meant).max() < 0.02  # rad; its acceleration begins with a step
    assert np.abs(arm.q - goal).max() < 1e-3


def test_a_jogged_joint_stops_when_no_jog_comes(arm):
    before = arm.q
    jog = JointState(name=[arm.joints[3]], velocity=[0.4])
    arm.run(1.0, lambda: arm.jog.publish(jog))
    moved = arm.q - before
    assert 0.3 < moved[3] < 0.45
    assert np.abs(np.delete(moved, 3)).max() < 0.01
    arm.run(1.5)
    stopped = arm.q
    assert moved[3] < stopped[3] - before[3] < moved[3] + 0.4 * (0.25 + 0.1) + 0.02
    arm.run(0.5)
    assert np.abs(arm.q - stopped).max() < 2e-3
    arm.ros.assert_limits_kept()


@pytest.mark.parametrize(("frame", "up"), [("panda_link0", 1.0), ("panda_hand", -1.0)])
def test_a_jogged_hand_moves_along_the_axis_asked_for(arm, frame, up):
    jog = TwistStamped()
    jog.header.frame_id = frame
    jog.twist.linear.z = 0.1  # of the hand: downwards in this posture
    arm.run(0.1)
    before = hand_at(arm.q)
    arm.run(1.0, lambda: arm.hand.publish(jog))
    arm.run(1.0)
    moved = hand_at(arm.q) - before
    assert np.abs(moved[:2]).max() < 0.01
    assert 0.08 < up * moved[2] < 0.16
    arm.ros.assert_limits_kept()


def test_whatever_is_asked_for_limits_are_kept(arm):
    rng = np.random.default_rng(5)
    n = len(arm.joints)

    def wild():
        kind = rng.integers(5)
        huge = 10.0 ** rng.uniform(-1.0, 300.0 if rng.random() < 0.2 else 2.0)
        if kind == 0:
            jog = TwistStamped()
            for part in (jog.twist.linear, jog.twist.angular):
                part.x, part.y, part.z = (huge * rng.normal(size=3)).tolist()
            arm.hand.publish(jog)
        elif kind == 1:
            arm.jog.publish(JointState(name=arm.joints, velocity=list(huge * rng.normal(size=n))))
        elif kind == 2:
            goals = [rng.uniform(arm.low, arm.high) for _ in range(4)]
            speeds = [(q, min(huge, 50.0) * rng.normal(size=n)) for q in goals]
            step = 10.0 ** rng.uniform(-9.0, -0.5)
            arm.trajectory.publish(
                JointTrajectory(joint_names=arm.joints, points=points(*speeds, step=step))
            )
        elif kind == 3:
            arm.trajectory.publish(JointTrajectory())
        else:
            arm.jog.publish(JointState(name=arm.joints, velocity=[math.nan] * n))

    arm.run(4.0, wild, every=0.1)
    arm.ros.assert_limits_kept()
    assert np.ptp(arm.positions(), axis=0).max() > 0.5, "the arm was hardly driven"
    arm.ros.wait_until(lambda: "jog_joints" in arm.refused(), "a report")
    assert arm.ros.reported("controller_node", "mode") == "TRACKING"


def test_keys_jog_the_arm(arm):
    before, node = arm.q, arm.ros.add(Node("teleop", context=arm.ros.context))
    arm.ros.probe.destroy_publisher(arm.jog)  # else there are two
    arm.ros.probe.destroy_publisher(arm.hand)
    arm.ros.wait_until(lambda: arm.ros.probe.count_publishers("jog_joints") == 0)
    teleop = Teleop(node, arm.joints, ("panda_link0", "panda_hand"), (0.1, 0.5, 0.3))
    arm.ros.wait_until(
        lambda: node.count_subscribers("jog_joints") and node.count_publishers("jog_joints") == 1
    )
    clock = itertools.count()
    teleop.press("-", 0.0)
    teleop.press("4", 0.0)  # held for 0.5 s
    arm.run(2.0, lambda: teleop.tick(0.05 * next(clock)))
    moved = arm.q - before
    assert -0.25 < moved[3] < -0.1
    assert np.abs(np.delete(moved, 3)).max() < 0.01
    assert teleop.press("t", 0.0) == "axes of panda_hand"
    arm.ros.assert_limits_kept()


def refusals(arm):
    """Return wrong messages: publisher, message."""
    start = list(arm.q)
    turned = TwistStamped()
    turned.header.frame_id = "panda_link5"
    late = TwistStamped()
    set_stamp(late.header.stamp, 10**18)
    return [
        (arm.hand, turned),
        (arm.hand, late),
        (arm.jog, JointState(name=["panda_joint9"], velocity=[0.1])),
        (arm.jog, JointState(name=arm.joints, velocity=[0.1])),
        (arm.trajectory, JointTrajectory(joint_names=arm.joints[1:], points=points([start]))),
        (arm.trajectory, JointTrajectory(joint_names=arm.joints, points=points([[9.0] * 7]))),
        (arm.trajectory, JointTrajectory(joint_names=arm.joints, points=points([[math.nan] * 7]))),
    ]


def test_what_cannot_be_followed_is_refused_and_counted(arm):
    before = arm.q
    for publisher, message in refusals(arm):
        publisher.publish(message)
    for count in ("jog_hand: 2", "jog_joints: 2", "target_joint_trajectory: 3"):
        arm.ros.wait_until(lambda count=count: count in arm.refused(), count)
    assert np.abs(arm.q - before).max() < 1e-3
