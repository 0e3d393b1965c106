# SPDX-License-Identifier: Apache-2.0
"""A controller node with two end effectors: a goal for each."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from controller_chain import NODE, ControllerChain, controller_of, patient_values
from geometry_msgs.msg import PoseStamped
from node_chain import pose_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import read_config

VALUES = patient_values("two_hands/talos_arms", integral_action="none", disturbance_time=0.0)
Q = np.array(read_config("two_hands/talos_arms", "bullet_node")["start_positions"])
FRAMES = VALUES["end_effector_frame"].split()


MODEL = build_model(read_urdf(VALUES["robot_description"]), VALUES["joints"])
MODEL.armature = np.array(VALUES["rotor_inertia"])
DATA = MODEL.createData()


def hands_at_rest():
    """Return the poses of the hands."""
    pin.framesForwardKinematics(MODEL, DATA, Q)
    return [DATA.oMf[MODEL.getFrameId(frame)].copy() for frame in FRAMES]


def accelerations(tau):
    """Return how torques accelerate the hands' origins from rest, shape (2, 3), m/s^2."""
    a = pin.aba(MODEL, DATA, Q, np.zeros(16), tau)
    axes = pin.LOCAL_WORLD_ALIGNED
    ids = map(MODEL.getFrameId, FRAMES)
    return np.array([pin.computeFrameJacobian(MODEL, DATA, Q, each, axes)[:3] @ a for each in ids])


def test_each_hand_goes_to_the_goal_of_its_topic(ros):
    chain = ControllerChain(ros, VALUES)
    first = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
    second = ros.talk(PoseStamped, "target_pose_second", GOAL_QOS)
    ways = np.array([[0.004, 0.0, 0.002], [-0.003, 0.004, 0.0]])  # m
    wanted = 900.0 * ways  # m/s^2, of pose_kp
    goals = hands_at_rest()
    for goal, way in zip(goals, ways, strict=True):
        goal.translation = goal.translation + way

    def found(stamp, pending):
        chain.await_goals(pending)
        command = chain.ask(stamp, Q, np.zeros(16))
        chain.await_goals(0)  # else the next call finds the count of this one
        return accelerations(np.array(command.effort))

    first.publish(pose_message(goals[0], VALUES["base_frame"]))
    moved, _ = found(10, 1)
    assert np.linalg.norm(moved - wanted[0]) < 0.02 * np.linalg.norm(wanted[0])
    second.publish(pose_message(goals[1], VALUES["base_frame"]))
    np.testing.assert_allclose(found(11, 1), wanted, atol=0.05)
    # A frame that is not the base's is refused, by its topic's name, and changes nothing.
    second.publish(pose_message(goals[0], "elsewhere"))
    ros.wait_until(lambda: "target_pose_second" in chain.reported("goals_refused"), "the refusal")
    np.testing.assert_allclose(found(12, 0), wanted, atol=0.05)
    # A motion of the joints releases both hands, and ends with a goal for one of them.
    joints = ros.talk(JointTrajectory, "target_joint_trajectory", GOAL_QOS)
    rests = JointTrajectory(joint_names=VALUES["joints"])
    rests.points = [JointTrajectoryPoint(positions=Q.tolist())]
    rests.points[0].time_from_start.sec = 9
    joints.publish(rests)
    np.testing.assert_allclose(found(13, 1), np.zeros((2, 3)), atol=0.05)
    second.publish(pose_message(goals[1], VALUES["base_frame"]))
    _, moved = found(14, 1)
    assert np.linalg.norm(moved - wanted[1]) < 0.02 * np.linalg.norm(wanted[1])


@pytest.mark.parametrize(
    ("frames", "shown"),
    [
        ([FRAMES[0], FRAMES[0]], "two of them"),
        (["a", "b", "c"], "two of them"),
        ([FRAMES[0], "hand"], "unknown frame 'hand'"),
        ([], "a frame"),
    ],
)
def test_other_end_effectors_are_refused(frames, shown):
    with pytest.raises(SettingError, match=shown) as refused:
        controller_of(VALUES | {"end_effector_frame": " ".join(frames)})
    assert refused.value.name == "end_effector_frame"


def test_a_task_of_both_hands_needs_more_than_12_joints():
    values = read_config("talos_left_arm", NODE) | {
        "end_effector_frame": "wrist_left_ft_tool_link torso_2_link",
        "integral_action": "task",
    }
    with pytest.raises(SettingError, match="9 joints have no null space"):
        controller_of(values)
