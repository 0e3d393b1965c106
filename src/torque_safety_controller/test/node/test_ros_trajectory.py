# SPDX-License-Identifier: Apache-2.0
"""Trajectories over topics: read, refused, followed in the robot's time."""

import math

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from geometry_msgs.msg import Transform, Twist
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import (
    JointTrajectory,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.node.goal_messages import GoalRefused, trajectory_from_message
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, circle
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state, read_config

MS = 1_000_000
PLANE = [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]  # from the lowest point towards y
BASE = pin.SE3(pin.utils.rotate("z", 0.7), np.array([0.1, 0.2, 0.3]))


def message_of(points, stamp=0, frame="base", joint_names=()) -> MultiDOFJointTrajectory:
    """Return points, given in the base frame, as a message."""
    message = MultiDOFJointTrajectory(joint_names=list(joint_names))
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    for point in points:
        entry = MultiDOFJointTrajectoryPoint(transforms=[Transform()])
        t, o = entry.transforms[0].translation, entry.transforms[0].rotation
        t.x, t.y, t.z = map(float, point.pose.translation)
        o.x, o.y, o.z, o.w = map(float, pin.Quaternion(point.pose.rotation).coeffs())
        for twists, values in (
            (entry.velocities, point.velocity),
            (entry.accelerations, point.acceleration),
        ):
            twist = Twist()
            for vector, part in ((twist.linear, values[:3]), (twist.angular, values[3:])):
                vector.x, vector.y, vector.z = map(float, part)
            twists.append(twist)
        nanoseconds = round(1e9 * point.time)
        entry.time_from_start.sec = nanoseconds // 10**9
        entry.time_from_start.nanosec = nanoseconds % 10**9
        message.points.append(entry)
    return message


def test_what_is_read_is_what_was_sent():
    points = circle(pin.SE3.Random(), 0.2, PLANE, period=2.0, points_per_turn=12)
    read = trajectory_from_message(message_of(points), "base", "hand", BASE)
    meant = PoseTrajectory(points)
    for t in np.linspace(0.0, 2.0, 15):
        pose, twist, rate = meant.sample(t)
        other, other_twist, other_rate = read.sample(t)
        assert np.abs(pin.log6(other.actInv(BASE * pose)).vector).max() < 1e-7
        # In the axes of the pose: the same wherever the base stands.
        np.testing.assert_allclose(other_twist, twist, atol=1e-6)
        np.testing.assert_allclose(other_rate, rate, atol=1e-6)


def changed(edit):
    message = message_of(circle(pin.SE3.Identity(), 0.2, PLANE, period=2.0, points_per_turn=4))
    edit(message)
    return message


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (lambda m: setattr(m.header, "frame_id", "moon"), "frame_id is 'moon'"),
        (lambda m: m.joint_names.append("foot"), "joint_names"),
        (lambda m: m.points[1].transforms.clear(), r"points\[1\] must have one transform"),
        (lambda m: m.points[1].velocities.append(Twist()), r"points\[1\] must have"),
        (lambda m: setattr(m.points[2].velocities[0].linear, "x", math.nan), "not finite"),
        (lambda m: setattr(m.points[2].transforms[0].rotation, "w", 3.0), "norm"),
        (
            lambda m: setattr(m.points[2].time_from_start, "sec", 0),
            r"points\[2\].time is",
        ),
        (lambda m: m.points.clear(), "at least one point"),
    ],
)
def test_what_cannot_be_followed_is_refused(edit, reason):
    with pytest.raises(GoalRefused, match=reason):
        trajectory_from_message(changed(edit), "base", "hand", BASE)


def test_velocities_may_be_left_out():
    message = changed(
        lambda m: [(p.velocities.clear(), p.accelerations.clear()) for p in m.points]
    )
    trajectory = trajectory_from_message(message, "base", "hand", BASE)
    assert trajectory.sample(0.5)[0].translation.shape == (3,)


def test_it_is_followed_in_the_robots_time(ros):
    arm = load_arm("panda")
    values = read_config("panda", "controller_node") | {"state_timeout": 5.0}
    values = {k: v for k, v in values.items() if k not in ("velocity_max", "robot_name")}
    values = {k: v for k, v in values.items() if k != "start_positions"}
    node = ros.start(ControllerNode, values)
    commands = ros.listen(JointState, "joint_commands")
    states = ros.talk(JointState, "joint_states")
    limits = ros.talk(JointTrajectory, "acceleration_limits")
    goals = ros.talk(MultiDOFJointTrajectory, "target_trajectory", GOAL_QOS)
    ros.hears("joint_commands")
    q, v, wide = arm.q_start, np.zeros(arm.n), np.full(arm.n, 50.0)
    joints = values["joints"]
    robot = arm.robot(0.0)
    robot.update(State(q, v), v)
    start = robot.pose.copy()
    points = circle(start, 0.05, PLANE, period=0.02, points_per_turn=8)
    meant = PoseTrajectory(points)
    goals.publish(message_of(points, stamp=20 * MS, frame=""))
    ros.wait_until(lambda: ros.reported("controller_node", "goals_pending") == "1", "the goal")
    for stamp in range(10, 60, 2):

        def send(stamp=stamp):
            limits.publish(acceleration_limits(joints, stamp * MS, -wide, wide))
            states.publish(joint_state(joints, stamp * MS, q, v))

        ros.wait_until(lambda s=stamp: s * MS in commands.stamps, "an answer", each=send)
        if stamp >= 20:
            pose, *_ = meant.sample(1e-3 * (stamp - 20))
            error = pin.log6(pose.actInv(node._controller.goals.pose_des)).vector
            assert np.abs(error).max() < 1e-6
    resting = node._controller.goals.pose_des.translation
    assert resting == pytest.approx(start.translation, abs=1e-9)
