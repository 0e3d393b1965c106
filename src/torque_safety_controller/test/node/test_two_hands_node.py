# SPDX-License-Identifier: Apache-2.0
"""A controller node with two end effectors: a goal for each."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from controller_chain import NODE, ControllerChain, controller_of
from geometry_msgs.msg import PoseStamped
from node_chain import pose_message

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import read_config

VALUES = read_config("two_hands/talos_arms", NODE) | {
    "bounds_timeout": 20.0,
    "state_timeout": 40.0,
    "integral_action": "none",
    "disturbance_time": 0.0,
}
Q = np.array(read_config("two_hands/talos_arms", "bullet_node")["start_positions"])
FRAMES = VALUES["end_effector_frame"].split()
H = 1e-3  # s


class RobotInMotion:
    """The dynamics, and where the hands are."""

    def __init__(self) -> None:
        self.model = build_model(read_urdf(VALUES["robot_description"]), VALUES["joints"])
        self.model.armature = np.array(VALUES["rotor_inertia"])
        self.data = self.model.createData()

    def hands(self, q):
        pin.framesForwardKinematics(self.model, self.data, q)
        return [self.data.oMf[self.model.getFrameId(frame)].copy() for frame in FRAMES]

    def accelerated(self, tau):
        """Return how the hands' origins are accelerated from rest, shape (2, 3), m/s^2."""
        a = pin.aba(self.model, self.data, Q, np.zeros(16), tau)
        now, then = self.hands(Q), self.hands(Q + 0.5 * H * H * a)
        return np.array(
            [2.0 * (b.translation - a.translation) / H**2 for a, b in zip(now, then, strict=True)]
        )


def test_each_hand_goes_to_the_goal_of_its_topic(ros):
    robot = RobotInMotion()
    chain = ControllerChain(ros, VALUES)
    first = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
    second = ros.talk(PoseStamped, "target_pose_second", GOAL_QOS)
    ways = np.array([[0.004, 0.0, 0.002], [-0.003, 0.004, 0.0]])  # m
    goals = robot.hands(Q)
    for goal, way in zip(goals, ways, strict=True):
        goal.translation = goal.translation + way
    wide = np.full(16, 50.0)

    def answer(stamp, pending):
        chain.await_goals(pending)

        def both():
            chain.send_limits(stamp, -wide, wide)
            chain.send_state(stamp, Q, np.zeros(16))

        return np.array(chain.await_command(stamp, both).effort)

    first.publish(pose_message(goals[0], VALUES["base_frame"]))
    found = robot.accelerated(answer(10, 1))
    assert np.linalg.norm(found[0] - 900.0 * ways[0]) < 0.02 * np.linalg.norm(900.0 * ways[0])
    second.publish(pose_message(goals[1], VALUES["base_frame"]))
    found = robot.accelerated(answer(11, 1))
    np.testing.assert_allclose(found, 900.0 * ways, atol=0.05)  # m/s^2
    # A frame that is not the base's is refused, by its topic's name, and changes nothing.
    second.publish(pose_message(goals[0], "elsewhere"))
    ros.wait_until(lambda: "target_pose_second" in chain.reported("goals_refused"), "the refusal")
    np.testing.assert_allclose(robot.accelerated(answer(12, 0)), 900.0 * ways, atol=0.05)


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
