# SPDX-License-Identifier: Apache-2.0
"""Trajectories from messages: read, refused, followed in the robot's time."""

import math

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from controller_chain import MS, ControllerChain, gains_of, patient_values
from controllers import make, pose_at
from geometry_msgs.msg import Transform, Twist
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from torque_safety_controller.node.goal_messages import GoalRefused, trajectory_from_message
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, circle
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp
from viability_bounds_pkg.state import State

PLANE = [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]  # from the lowest point towards y
BASE = pin.SE3(pin.utils.rotate("z", 0.7), np.array([0.1, 0.2, 0.3]))


def twist_of(values) -> Twist:
    made = Twist()
    for vector, part in ((made.linear, values[:3]), (made.angular, values[3:])):
        vector.x, vector.y, vector.z = map(float, part)
    return made


def message_of(points, stamp=0, frame="base") -> MultiDOFJointTrajectory:
    """Return points, given in the base frame, as a message."""
    message = MultiDOFJointTrajectory()
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    for point in points:
        transform = Transform()
        t, o = transform.translation, transform.rotation
        t.x, t.y, t.z = map(float, point.pose.translation)
        o.x, o.y, o.z, o.w = map(float, pin.Quaternion(point.pose.rotation).coeffs())
        entry = MultiDOFJointTrajectoryPoint(
            transforms=[transform],
            velocities=[twist_of(point.velocity)],
            accelerations=[twist_of(point.acceleration)],
        )
        entry.time_from_start.nanosec = round(1e9 * point.time) % 10**9
        entry.time_from_start.sec = round(1e9 * point.time) // 10**9
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
        (lambda m: setattr(m.points[2].time_from_start, "sec", 0), r"points\[2\].time is"),
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
    values = patient_values("panda", disturbance_time=0.0)
    chain = ControllerChain(ros, values)
    q, v = arm.q_start, np.zeros(arm.n)
    wide = AccelerationRange(np.full(arm.n, -50.0), np.full(arm.n, 50.0))
    core = make(arm, gains=gains_of(values))
    core.reset(q)
    points = circle(pose_at(arm, q), 0.005, PLANE, period=0.02, points_per_turn=8)
    meant = PoseTrajectory(points)
    goals = ros.talk(MultiDOFJointTrajectory, "target_trajectory", GOAL_QOS)
    goals.publish(message_of(points, stamp=20 * MS, frame=""))
    chain.await_goals()
    for stamp in range(20, 50, 2):
        core.goals.set_pose(*meant.sample(1e-3 * (stamp - 20)))
        wanted = core.step(State(q, v), wide).tau
        found = chain.ask(stamp, q, v).effort
        np.testing.assert_allclose(found, wanted, atol=1e-4, err_msg=f"at {stamp} ms")  # N m
    # It ends where it began.
    ros.wait_until(lambda: float(chain.reported("position_error_m") or "nan") < 1e-6)
    # And is not followed a second time when its time has passed.
    chain.ask(1000, q, v)
    goals.publish(message_of(points, stamp=20 * MS, frame=""))
    chain.await_goals()
    chain.ask(1002, q, v)
    ros.wait_until(lambda: "target_trajectory: 1" in chain.reported("goals_refused"))


def test_it_waits_for_the_arm_and_is_given_up_far_away_from_it(ros):
    chain = ControllerChain(ros, patient_values("panda"))
    q, v = load_arm("panda").q_start, np.zeros(7)
    goals = ros.talk(JointTrajectory, "target_joint_trajectory", GOAL_QOS)
    point = JointTrajectoryPoint(positions=(q + 0.3).tolist())
    point.time_from_start.sec = 1
    chain.ask(20, q, v)
    goals.publish(JointTrajectory(joint_names=chain.joints, points=[point]))
    chain.await_goals()
    for stamp in range(40, 2000, 20):
        chain.ask(stamp, q, v)  # it is braked
    told = "target_joint_trajectory waits for the arm"
    ros.wait_until(lambda: told in chain.reported("message"), told)
    for stamp in range(2000, 2500, 20):
        v[0] = -1.0
        q = q + 0.02 * v
        chain.ask(stamp, q, v)  # it is pushed away
    ros.wait_until(lambda: "target_joint_trajectory: 1" in chain.reported("goals_refused"))
    assert told not in chain.reported("message")
