# SPDX-License-Identifier: Apache-2.0
"""The action FollowJointTrajectory, through the real nodes in lockstep."""

import re
from pathlib import Path

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs_build import CompilerMissingError, import_control_msgs
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectoryPoint

from sim_bridge.node.bullet_node import BulletNode
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.ramp import RISE_TIME
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp, stamp_to_ns
from viability_bounds_pkg.testing.ros_harness import read_config

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
KINDS = {"bounds_node": BoundsNode, "controller_node": ControllerNode, "bullet_node": BulletNode}
PATIENT = {"clock": "lockstep", "bounds_timeout": 5.0, "state_timeout": 10.0, "rate_hz": 200.0}
VALUES = read_config("panda", *KINDS) | PATIENT
JOINTS = VALUES["joints"]
GOAL = np.array(VALUES["start_positions"]) + [0.2, 0.1, -0.2, 0.2, 0.2, 0.2, 0.3]
TARGET = "target_joint_trajectory"


@pytest.fixture(scope="module")
def moveit():
    """The module of the node, with the messages that it needs."""
    try:
        import_control_msgs(ROOT / "build" / "control_msgs")
    except CompilerMissingError as error:
        pytest.skip(str(error))
    from torque_safety_controller.remote import moveit_node

    return moveit_node


def start_node(ros, moveit, **changed):
    names = {*VALUES} & {"joints", "robot_description", "position_min", "position_max"}
    return ros.start(moveit.MoveitNode, {name: VALUES[name] for name in names} | changed)


CLIENTS = []


@pytest.fixture(autouse=True)
def clients_end(ros):
    """Nodes do not end the clients of actions with themselves: they would stay in the graph."""
    yield
    while CLIENTS:
        CLIENTS.pop().destroy()


class Goal:
    """A goal of the action, and what has come of it."""

    def __init__(self, user, goal) -> None:
        self.feedback, self.handle, self.answer = [], None, None
        sent = user.client.send_goal_async(goal, lambda message: self.feedback.append(message))
        sent.add_done_callback(self._taken)

    def _taken(self, future) -> None:
        self.handle = future.result()
        assert self.handle.accepted
        self.handle.get_result_async().add_done_callback(self._ended)

    def _ended(self, future) -> None:
        self.answer = future.result()

    @property
    def outcome(self):
        """Status, code and text."""
        return self.answer.status, self.answer.result.error_code, self.answer.result.error_string


class User:
    """Who sends goals to a Panda."""

    def __init__(self, ros, moveit, *, silence=10.0, **changed) -> None:
        self.ros, self.types = ros, moveit
        self.node = start_node(ros, moveit, **changed)
        kind = moveit.FollowJointTrajectory
        self.client = ActionClient(ros.probe, kind, "moveit_node/follow_joint_trajectory")
        CLIENTS.append(self.client)
        ros.wait_until(self.client.server_is_ready)
        self.states = ros.listen(JointState, "joint_states")
        self.controller = ros.start(ControllerNode, VALUES | {"state_timeout": silence})
        ros.start(BoundsNode, VALUES | {"state_timeout": silence})
        self.robot = ros.start(BulletNode, VALUES)
        ros.wait_until(lambda: len(self.states) > 2)
        self.run(1.5 * RISE_TIME)  # goals fade in

    @property
    def q(self):
        return np.array(self.states[-1].position[: len(JOINTS)])

    @property
    def v(self):
        return np.array(self.states[-1].velocity[: len(JOINTS)])

    def goal(self, q=GOAL, duration=1.0, ahead=0.0, **parts):
        """Return a goal that begins when it comes, or at a robot time so much ahead, s."""
        goal = self.types.FollowJointTrajectory.Goal(**parts)
        goal.trajectory = JointTrajectory(
            joint_names=JOINTS[::-1],  # matched by name
            points=[JointTrajectoryPoint(positions=[float(x) for x in q][::-1])],
        )
        set_stamp(goal.trajectory.points[0].time_from_start, round(1e9 * duration))
        if ahead:
            now = stamp_to_ns(self.states[-1].header.stamp)
            set_stamp(goal.trajectory.header.stamp, now + round(1e9 * ahead))
        return goal

    def send(self, **parts):
        return Goal(self, self.goal(**parts))

    def wait(self, goal):
        self.ros.wait_until(lambda: goal.answer, timeout=300.0)
        return goal.outcome

    def run(self, duration):
        """Let robot time pass."""
        end = stamp_to_ns(self.states[-1].header.stamp) + round(1e9 * duration)
        self.ros.wait_until(lambda: stamp_to_ns(self.states[-1].header.stamp) > end, timeout=300.0)


def test_goals_are_reached_one_after_the_other(ros, moveit):
    user = User(ros, moveit)
    for q in (GOAL, np.array(VALUES["start_positions"])):
        # In lockstep much robot time goes by until a message has come: both are to know the begin.
        goal = user.send(q=q, ahead=1.0)
        assert user.wait(goal) == (GoalStatus.STATUS_SUCCEEDED, 0, "")
        assert np.abs(user.q - q).max() < 0.01
        told = [each.feedback for each in goal.feedback]
        assert len(told) > 3
        for each in told:
            assert list(each.joint_names) == JOINTS
            off = np.subtract(each.desired.positions, each.actual.positions)
            np.testing.assert_allclose(each.error.positions, off, atol=1e-12)
            assert np.abs(off).max() < 0.005
        # Others may drive the arm in between.
        ros.wait_until(lambda: ros.probe.count_publishers(TARGET) == 0)
    user.ros.assert_limits_kept()


def test_one_that_is_cancelled_stops(ros, moveit):
    user = User(ros, moveit)
    goal = user.send(duration=4.0)
    ros.wait_until(lambda: len(goal.feedback) > 2 and np.abs(user.v).max() > 0.05)
    goal.handle.cancel_goal_async()
    assert user.wait(goal)[0] == GoalStatus.STATUS_CANCELED
    ros.wait_until(lambda: np.abs(user.v).max() < 1e-3)
    at = user.q
    user.run(0.5)
    assert np.abs(user.q - at).max() < 0.01
    assert np.abs(user.q - GOAL).max() > 0.05


def test_a_newer_goal_takes_the_place_of_an_older_one_unless_it_is_refused(ros, moveit):
    user = User(ros, moveit)
    first = user.send(duration=100.0)
    ros.wait_until(lambda: first.feedback)
    far = GOAL.copy()
    far[3] = 1.0
    assert user.wait(user.send(q=far))[:2] == (GoalStatus.STATUS_ABORTED, -1)
    assert not first.answer
    second = user.send(q=VALUES["start_positions"])
    assert user.wait(first) == (GoalStatus.STATUS_ABORTED, -1, "a newer goal has come")
    assert user.wait(second)[:2] == (GoalStatus.STATUS_SUCCEEDED, 0)
    assert np.abs(user.q - VALUES["start_positions"]).max() < 0.01


def test_one_that_is_not_reached_in_time_tells_how_far_it_is(ros, moveit):
    user = User(ros, moveit, trajectory_goal_time=0.01)
    goal = user.send(q=GOAL + [1.0, 0, 0, 0, 0, 0, 0], duration=0.2)
    status, code, text = user.wait(goal)
    assert (status, code) == (GoalStatus.STATUS_ABORTED, -5)
    assert re.fullmatch(r"panda_joint1 is .* rad off; allowed: 0.01", text)


def test_what_cannot_be_followed_is_told(ros, moveit):
    user = User(ros, moveit)
    before = user.q
    far = GOAL.copy()
    far[3] = 1.0

    def with_(change):
        goal = user.goal()
        change(goal)
        return goal

    cases = [
        (user.goal(q=far), -1, "points[0]: panda_joint4 is 1 rad; allowed: -3.0718 to -0.0698"),
        (with_(lambda g: g.trajectory.joint_names.pop()), -2, "joint_names is ['panda_joint7'"),
        (
            with_(lambda g: g.multi_dof_trajectory.points.append(MultiDOFJointTrajectoryPoint())),
            -1,
            "multi_dof_trajectory is given",
        ),
        (user.goal(path_tolerance=[moveit.JointTolerance(name="elbow")]), -2, "unknown joint"),
        (
            user.goal(goal_tolerance=[moveit.JointTolerance(name=JOINTS[1], position=-0.5)]),
            -1,
            "panda_joint2: tolerance -0.5; allowed: 0, above, or -1",
        ),
        (with_(lambda g: set_stamp(g.trajectory.header.stamp, 1)), -3, "header.stamp is "),
    ]
    user.run(1.5)
    for request, code, text in cases:
        status, found, why = user.wait(Goal(user, request))
        assert (status, found) == (GoalStatus.STATUS_ABORTED, code), why
        assert text in why
    assert np.abs(user.q - before).max() < 0.01
    assert ros.probe.count_publishers(TARGET) == 0


def test_it_does_not_drive_beside_another(ros, moveit):
    user = User(ros, moveit)
    other = ros.talk(JointTrajectory, TARGET, GOAL_QOS)
    ros.wait_until(lambda: user.node.count_publishers(TARGET) == 1)
    outcome = user.wait(user.send())
    assert outcome[1:] == (-1, f"another node publishes '/{TARGET}'")
    ros.probe.destroy_publisher(other)
    ros.wait_until(lambda: user.node.count_publishers(TARGET) == 0)
    assert user.wait(user.send())[1:] == (0, "")


def test_a_robot_that_falls_silent_ends_it(ros, moveit):
    user = User(ros, moveit, silence=1.0)
    goal = user.send(duration=1000.0)
    ros.wait_until(lambda: goal.feedback)
    ros.stop(user.robot)
    status, code, text = user.wait(goal)
    assert (status, code) == (GoalStatus.STATUS_ABORTED, -4)
    assert "silent" in text or "STOPPED" in text


def test_a_controller_that_goes_ends_it(ros, moveit):
    user = User(ros, moveit)
    goal = user.send(duration=1000.0)
    ros.wait_until(lambda: goal.feedback)
    ros.stop(user.controller)
    assert user.wait(goal) == (GoalStatus.STATUS_ABORTED, -4, "the controller has gone")
