# SPDX-License-Identifier: Apache-2.0
"""What the tasks of a hand and of the joints ask for, by differences and along motions."""

import math
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.tasks.gains import Gains, critical_damping
from torque_safety_controller.tasks.pose_task import PoseMotion, PoseTask, pose_error
from torque_safety_controller.tasks.posture_task import PostureTask
from viability_bounds_pkg.state import State

KP, KD, WEIGHT = 30.0, 7.0, 2.5
STILL = 1e-6  # relative; the null space is regularised


def updated(arm, q, v):
    robot = arm.robot(0.0)
    robot.update(State(q, v), np.zeros(arm.n))
    return robot


def minimum(terms, n) -> np.ndarray:
    """Accelerations that the terms ask for together, by normal equations."""
    H, g = np.zeros((n, n)), np.zeros(n)
    for A, b, weight in terms:
        A = np.eye(n) if A is None else A
        H += weight * A.T @ A
        g += weight * A.T @ b
    return np.linalg.solve(H, g)


@pytest.mark.parametrize("moving", [False, True])
def test_the_pose_task_makes_the_error_a_damped_spring(arm, moving):
    """e'' = -kp e - kd e', by finite differences along the motion asked for."""
    rng = np.random.default_rng(5)
    q, v = arm.random_state(rng)
    motion = PoseMotion(
        *(rng.normal(size=(2, 6)) * [[0.3], [1.0]] if moving else np.zeros((2, 6)))
    )
    robot, h = updated(arm, q, v), 1e-4
    # A goal near by: the logarithm is linear to first order in the error, which is small.
    goal = robot.pose * pin.exp6(1e-6 * rng.normal(size=6))
    term = PoseTask(goal, KP, KD, WEIGHT, motion if moving else None).term(robot)
    assert term.weight == WEIGHT
    a = np.linalg.pinv(term.A) @ term.b
    errors = [
        pose_error(updated(arm, q + t * v + 0.5 * t * t * a, v).pose, goal_at(goal, motion, t))
        for t in (-h, 0.0, h)
    ]
    rate = (errors[2] - errors[0]) / (2.0 * h)
    expected = -KP * errors[1] - KD * rate
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(np.diff(errors, 2, axis=0)[0] / h**2, expected, atol=2e-3)


def goal_at(goal, motion, t):
    """Where a goal is that moves so now, to second order."""
    return goal * pin.exp6(t * motion.twist + 0.5 * t * t * motion.twist_rate)


@pytest.mark.parametrize("moving", [False, True])
def test_with_errors_apart_position_and_orientation_are_springs_by_themselves(arm, moving):
    """(7), (8) in the axes of the root; all derivatives by differences along the motion."""
    rng = np.random.default_rng(7)
    h = 1e-4  # s
    for _ in range(2):
        q, v = arm.random_state(rng)
        robot = updated(arm, q, v)
        goal = robot.pose * pin.exp6(0.5 * rng.normal(size=6))  # far, in every direction
        motion = PoseMotion(*(rng.normal(size=(2, 6)) if moving else np.zeros((2, 6))))
        given = motion if moving else None
        term = PoseTask(goal, KP, KD, WEIGHT, given, separate=True).term(robot)
        a = np.linalg.pinv(term.A) @ term.b
        hand = [updated(arm, q + t * v + 0.5 * t * t * a, v).pose for t in (-h, 0.0, h)]
        goals = [goal_at(goal, motion, t) for t in (-h, 0.0, h)]

        def rates(poses):
            p = [pose.translation for pose in poses]
            turns = [
                pin.log3(x.rotation @ y.rotation.T) for x, y in zip(poses[1:], poses, strict=False)
            ]
            return (
                (p[2] - p[0]) / (2 * h),
                (p[2] - 2 * p[1] + p[0]) / h**2,
                (turns[0] + turns[1]) / (2 * h),
                (turns[1] - turns[0]) / h**2,
            )

        velocity, acceleration, turning, turning_rate = rates(hand)
        velocity_des, acceleration_des, turning_des, turning_rate_des = rates(goals)
        there, here = goals[1], hand[1]
        wanted = acceleration_des + KP * (there.translation - here.translation)
        wanted += KD * (velocity_des - velocity)
        np.testing.assert_allclose(acceleration, wanted, atol=2e-3 * np.abs(wanted).max())
        wanted = turning_rate_des + KP * pin.log3(there.rotation @ here.rotation.T)
        wanted += KD * (turning_des - turning)
        np.testing.assert_allclose(turning_rate, wanted, atol=2e-3 * np.abs(wanted).max())


def test_a_far_goal_is_approached_at_the_speed_allowed(arm):
    """At that speed stiffness and damping balance: nothing accelerates the hand any more."""
    gains = Gains(pose_kp=90.0, posture_kp=0.0, pose_speed_max=np.array([0.3, 0.7]))
    rng = np.random.default_rng(6)
    for _ in range(3):
        q, _ = arm.random_state(rng)
        robot = updated(arm, q, np.zeros(arm.n))
        turn, shift = rng.normal(size=(2, 3))
        goal = robot.pose * pin.exp6(np.concatenate([2.0 * shift, turn]))
        error = pose_error(robot.pose, goal)
        twist = np.concatenate(
            [
                speed * part / np.linalg.norm(part)
                for speed, part in zip((0.3, 0.7), (error[:3], error[3:]), strict=True)
            ]
        )
        robot = updated(arm, q, np.linalg.pinv(robot.J) @ twist)
        term = PoseTask(goal, gains.pose_kp, gains.pose_kd, 1.0, error_max=gains.pose_error_max)
        np.testing.assert_allclose(term.term(robot).b, -robot.drift, atol=1e-9)


def test_posture_and_damping_terms():
    q_des, q, v = np.array([1.0, 2.0]), np.array([0.5, 3.0]), np.array([0.1, -0.2])
    term = PostureTask(q_des, KP, KD, WEIGHT).term(SimpleNamespace(q=q, v=v))
    np.testing.assert_allclose(term.b, KP * (q_des - q) - KD * v, rtol=1e-15)
    # Critical damping has one double root.
    roots = np.linalg.eigvals(np.array([[0.0, 1.0], [-KP, -critical_damping(KP)]]))
    np.testing.assert_allclose(roots, -math.sqrt(KP), rtol=1e-6)


@pytest.mark.parametrize("lost", [False, True])
def test_the_null_space_leaves_the_pose_still_also_where_the_jacobian_has_lost_rank(lost):
    rng = np.random.default_rng(4)
    J, x = rng.normal(size=(6, 7)), rng.normal(size=7)
    if lost:
        J[5], J[3] = J[4], 0.0  # one direction twice, one that cannot be moved at all
    robot = SimpleNamespace(q=np.zeros(7), v=np.zeros(7), J=J)
    part = PostureTask(x, 1.0, KD, WEIGHT, in_null_space=True).term(robot).b
    assert np.abs(J @ part).max() < STILL
    # And no more than that is taken.
    np.testing.assert_allclose(part, x - np.linalg.pinv(J) @ (J @ x), atol=1e-6)


@pytest.mark.parametrize(
    ("in_null_space", "least", "most"), [(True, 0.0, 1e-6), (False, 1e-4, 1e-2)]
)
def test_posture_in_the_null_space_leaves_the_pose_reached_and_else_they_compromise(
    arm, in_null_space, least, most
):
    """As the paper has it, they do; played without dynamics. Errors in m and rad."""
    rng = np.random.default_rng(5)
    q, v, dt = arm.q_start.copy(), np.zeros(arm.n), 0.01
    goal = updated(arm, q + rng.uniform(-0.3, 0.3, arm.n), v).pose.copy()
    tasks = [
        PoseTask(goal, KP, critical_damping(KP), 1.0),
        PostureTask(arm.q_start, 10.0, critical_damping(10.0), 1e-3, in_null_space),
    ]
    for _ in range(2000):
        robot = updated(arm, q, v)
        a = minimum([task.term(robot) for task in tasks], arm.n)
        q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
    assert least < np.abs(pose_error(updated(arm, q, v).pose, goal)).max() < most
    assert np.abs(q - arm.q_start).max() > 0.05  # rad


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-9])
def test_separate_error_turns_the_shorter_way(arm, angle):
    """The angular part of the task is kp log(R'R_d), whatever quaternion that is told by."""
    robot, rng = updated(arm, arm.q_start, np.zeros(arm.n)), np.random.default_rng(5)
    for _ in range(20):
        axis = rng.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        goal = robot.pose * pin.SE3(pin.exp3(vector), np.zeros(3))
        b = PoseTask(goal, 1.0, 0.0, 1.0, separate=True).term(robot).b
        np.testing.assert_allclose(b, np.r_[np.zeros(3), vector], atol=1e-12)  # rad/s^2
