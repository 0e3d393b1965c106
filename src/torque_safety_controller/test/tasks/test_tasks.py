# SPDX-License-Identifier: Apache-2.0
import math
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.tasks.gains import Gains, critical_damping
from torque_safety_controller.tasks.pose_task import PoseMotion, PoseTask, pose_error
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import RestTask
from viability_bounds_pkg.state import State

KP, KD, WEIGHT = 30.0, 7.0, 2.5
STILL = 1e-6  # relative; the null space is regularised


def updated(arm, q, v):
    robot = arm.robot(0.0)
    robot.update(State(q, v), np.zeros(arm.n))
    return robot


def null_space_part(J, x) -> np.ndarray:
    """What of a joint vector the posture task may ask for, if the pose is not to feel it."""
    zero = np.zeros(len(x))
    robot = SimpleNamespace(q=zero, v=zero, J=J)
    return PostureTask(x, 1.0, KD, WEIGHT, True).term(robot).b


def minimum(terms, n) -> np.ndarray:
    """Accelerations that the terms ask for together, by normal equations."""
    H, g = np.zeros((n, n)), np.zeros(n)
    for A, b, weight in terms:
        A = np.eye(n) if A is None else A
        H += weight * A.T @ A
        g += weight * A.T @ b
    return np.linalg.solve(H, g)


def test_the_pose_error_is_the_motion_that_is_left(arm):
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, v = arm.random_state(rng)
        direction = rng.normal(size=arm.n)
        robot = updated(arm, q, v)

        def residual(size, q=q, v=v, direction=direction, robot=robot):
            goal = updated(arm, q + size * direction, v).pose
            return np.linalg.norm(pose_error(robot.pose, goal) - size * robot.J @ direction)

        # The Jacobian tells the error to first order: what remains is of second order.
        assert residual(1e-3) / residual(5e-4) == pytest.approx(4.0, rel=0.05)


def test_the_pose_error_is_in_metres_and_radians_in_the_hand_s_axes():
    turn = pin.exp3(np.array([0.0, 0.0, math.pi / 2.0]))
    here = pin.SE3(turn, np.array([1.0, 2.0, 3.0]))
    there = pin.SE3(turn, np.array([1.0, 2.5, 3.0]))
    # Half a metre along the world's y is along the hand's x.
    np.testing.assert_allclose(pose_error(here, there), [0.5, 0, 0, 0, 0, 0], atol=1e-12)
    turned = pin.SE3(turn @ pin.exp3(np.array([0.2, 0.0, 0.0])), here.translation)
    np.testing.assert_allclose(pose_error(here, turned), [0, 0, 0, 0.2, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(pose_error(here, here), np.zeros(6))


def test_the_pose_task_makes_the_error_a_damped_spring(arm):
    """e'' = -kp e - kd e', with e'' by finite differences along the motion asked for."""
    rng = np.random.default_rng(2)
    h = 1e-4  # s
    for _ in range(5):
        q, v = arm.random_state(rng)
        robot = updated(arm, q, v)
        # At the goal, where the logarithm's own derivatives vanish, but in motion.
        goal = robot.pose
        A, b, weight = PoseTask(goal, KP, KD, WEIGHT).term(robot)
        a = np.linalg.lstsq(A, b, rcond=None)[0]
        np.testing.assert_allclose(A @ a, b, atol=1e-8)
        errors = [
            pose_error(updated(arm, q + t * v + 0.5 * t * t * a, v).pose, goal)
            for t in (-h, 0.0, h)
        ]
        rate = (errors[2] - errors[0]) / (2.0 * h)
        curvature = (errors[2] - 2.0 * errors[1] + errors[0]) / h**2
        expected = -KP * errors[1] - KD * rate
        assert np.abs(expected).max() > 1.0
        np.testing.assert_allclose(curvature, expected, atol=1e-3 * np.abs(expected).max())
        assert weight == WEIGHT


def goal_at(goal, motion, t):
    """Where a goal is that moves so now, to second order."""
    return goal * pin.exp6(t * motion.twist + 0.5 * t * t * motion.twist_rate)


@pytest.mark.parametrize("moving", [False, True])
def test_with_errors_apart_position_and_orientation_are_springs_by_themselves(arm, moving):
    """(7), (8) in the axes of the root; all derivatives by differences along the motion."""
    rng = np.random.default_rng(7)
    h = 1e-4  # s
    for _ in range(5):
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


def test_with_errors_apart_the_hand_goes_straight(arm):
    """To a goal 0.3 m and 90 degrees away; the screw of the logarithm leaves the line."""
    off = {}
    for separate in (True, False):
        q, v, dt = arm.q_start.copy(), np.zeros(arm.n), 2e-3
        start = updated(arm, q, v).pose.copy()
        goal = pin.SE3(
            start.rotation @ pin.exp3(np.array([0.0, 0.0, math.pi / 2.0])),
            start.translation + np.array([-0.05, 0.0, -0.05]),
        )
        line = goal.translation - start.translation
        along = line / np.linalg.norm(line)
        off[separate] = 0.0
        for _ in range(500):
            robot = updated(arm, q, v)
            way = robot.pose.translation - start.translation
            off[separate] = max(off[separate], np.linalg.norm(way - along * (along @ way)))
            term = PoseTask(goal, KP, critical_damping(KP), 1.0, separate=separate).term(robot)
            a = np.linalg.pinv(term.A) @ term.b
            q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
    assert off[True] < 2e-3  # m
    assert off[False] > 5.0 * off[True]


def test_a_pose_task_at_rest_pulls_with_its_stiffness(arm):
    robot = updated(arm, arm.q_start, np.zeros(arm.n))
    goal = robot.pose * pin.exp6(0.1 * np.arange(6.0))
    error, share = pose_error(robot.pose, goal), np.linspace(0.0, 1.0, 6)
    A, b, weight = PoseTask(goal, KP, KD, WEIGHT).term(robot)
    np.testing.assert_allclose(error, 0.1 * np.arange(6.0), atol=1e-12)
    np.testing.assert_allclose(b, KP * error, atol=1e-12)
    less = PoseTask(goal, KP, KD, WEIGHT, stiffness=share).term(robot)
    np.testing.assert_allclose(less.b, KP * share * error, atol=1e-12)
    np.testing.assert_array_equal(A, robot.J)
    assert weight == WEIGHT


def test_a_far_goal_counts_as_one_at_the_largest_error(arm):
    robot = updated(arm, arm.q_start, np.zeros(arm.n))
    largest = (0.05, 0.2)  # m, rad
    for size in (0.5, 1.0, 2.0, 10.0):
        error = size * np.array(
            [0.03, 0.0, -0.04, 0.12, 0.16, 0.0]
        )  # as long as allowed, times size
        goal = robot.pose * pin.exp6(error)
        b = PoseTask(goal, KP, KD, WEIGHT, error_max=largest).term(robot).b
        np.testing.assert_allclose(b, KP * error * min(1.0, 1.0 / size), atol=1e-9)


def test_a_far_goal_is_approached_at_the_speed_allowed(arm):
    """At that speed stiffness and damping balance: nothing accelerates the hand any more."""
    gains = Gains(pose_kp=90.0, posture_kp=0.0, pose_speed_max=np.array([0.3, 0.7]))
    rng = np.random.default_rng(6)
    for _ in range(5):
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


def test_without_a_speed_or_a_stiffness_no_error_is_too_large():
    unlimited = (math.inf, math.inf)
    gains = Gains(pose_kp=90.0, posture_kp=0.0, pose_speed_max=np.empty(0))
    assert gains.pose_error_max == unlimited
    speeds = np.array([0.3, 0.7])
    gains = Gains(pose_kp=0.0, posture_kp=0.0, pose_speed_max=speeds)
    assert gains.pose_error_max == unlimited
    limits = Gains(pose_kp=100.0, pose_kd=10.0, posture_kp=0.0, pose_speed_max=speeds)
    assert limits.pose_error_max == pytest.approx((0.03, 0.07))


def test_posture_and_damping_terms():
    q_des, q, v = np.array([1.0, 2.0]), np.array([0.5, 3.0]), np.array([0.1, -0.2])
    robot = SimpleNamespace(q=q, v=v)
    A, b, weight = PostureTask(q_des, KP, KD, WEIGHT).term(robot)
    assert A is None
    assert weight == WEIGHT
    np.testing.assert_allclose(b, KP * (q_des - q) - KD * v, rtol=1e-15)
    A, b, _ = RestTask(-KD * robot.v).term(robot)
    assert A is None
    np.testing.assert_allclose(b, -KD * v, rtol=1e-15)


@pytest.mark.parametrize("kp", [0.25, 10.0, 1000.0])
def test_critical_damping_has_one_double_root(kp):
    kd = critical_damping(kp)
    roots = np.linalg.eigvals(np.array([[0.0, 1.0], [-kp, -kd]]))
    np.testing.assert_allclose(roots, -math.sqrt(kp), rtol=1e-6)


def test_the_null_space_leaves_the_pose_still(arm):
    rng = np.random.default_rng(3)
    for _ in range(20):
        q, v = arm.random_state(rng)
        J = updated(arm, q, v).J
        x = rng.normal(size=arm.n)
        part = null_space_part(J, x)
        assert np.abs(J @ part).max() < STILL * np.abs(J @ x).max()
        # And no more than that is taken; near a singularity the regularisation is felt.
        weakest = np.linalg.svd(J, compute_uv=False)[-1]
        expected = x - np.linalg.pinv(J) @ (J @ x)
        np.testing.assert_allclose(part, expected, atol=1e-9 + 1e-8 / weakest**2)


def test_the_posture_moves_the_elbow_but_not_the_hand(arm):
    """Followed for a second, a posture in the null space moves joints and keeps the pose."""
    q, v = arm.q_start.copy(), np.zeros(arm.n)
    q_des = q + np.array([0.4, -0.3, 0.5, 0.2, -0.4, 0.3, 0.2])
    robot = updated(arm, q, v)
    begin = robot.pose.copy()
    dt = 0.01
    for _ in range(100):
        robot.update(State(q, v), np.zeros(arm.n))
        a = minimum(
            [
                PoseTask(begin, 400.0, 40.0, 1.0).term(robot),
                PostureTask(q_des, 10.0, critical_damping(10.0), 1e-3, True).term(robot),
            ],
            arm.n,
        )
        q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
    assert np.abs(q - arm.q_start).max() > 0.05  # rad
    assert np.linalg.norm(pose_error(updated(arm, q, v).pose, begin)) < 1e-4  # m, rad


def test_the_null_space_of_a_jacobian_that_lost_rank():
    rng = np.random.default_rng(4)
    J = rng.normal(size=(6, 7))
    J[5] = J[4]  # one direction twice
    J[3] = 0.0  # one that cannot be moved at all
    x = rng.normal(size=7)
    part = null_space_part(J, x)
    assert np.isfinite(part).all()
    assert np.abs(J @ part).max() < STILL
    assert np.linalg.norm(part) > 0.1
    np.testing.assert_allclose(null_space_part(np.zeros((6, 7)), x), x, atol=1e-12)


def settle(arm, in_null_space, seconds=30.0) -> np.ndarray:
    """Drive the arm kinematically to a pose against its posture; return the pose error left."""
    rng = np.random.default_rng(5)
    q_goal = arm.q_start + rng.uniform(-0.3, 0.3, arm.n)
    goal = updated(arm, q_goal, np.zeros(arm.n)).pose.copy()
    q, v, dt = arm.q_start.copy(), np.zeros(arm.n), 0.01
    robot = arm.robot(0.0)
    kd = critical_damping(KP)
    for _ in range(round(seconds / dt)):
        robot.update(State(q, v), np.zeros(arm.n))
        a = minimum(
            [
                PoseTask(goal, KP, kd, 1.0).term(robot),
                PostureTask(arm.q_start, 10.0, critical_damping(10.0), 1e-3, in_null_space).term(
                    robot
                ),
            ],
            arm.n,
        )
        q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
    return pose_error(updated(arm, q, v).pose, goal)


def test_with_the_posture_in_the_null_space_the_pose_is_reached(arm):
    assert np.abs(settle(arm, in_null_space=True)).max() < 1e-6  # m, rad


def test_as_the_paper_has_it_pose_and_posture_end_in_a_compromise(arm):
    assert 1e-4 < np.abs(settle(arm, in_null_space=False)).max() < 1e-2  # m, rad


def test_a_moving_goal_is_followed_exactly(arm):
    """Feed-forward: on the track, with the track's twist, the asked rate is the track's own."""
    rng = np.random.default_rng(4)
    q, v = arm.random_state(rng)
    robot = arm.robot(0.0)
    robot.update(State(q, v), np.zeros(arm.n))
    twist, rate = robot.J @ v, rng.normal(size=6)
    term = PoseTask(robot.pose, 30.0, 7.0, 1.0, PoseMotion(twist, rate)).term(robot)
    a = np.linalg.pinv(robot.J) @ term.b
    np.testing.assert_allclose(robot.J @ a + robot.drift, rate, atol=1e-8)


def test_the_error_of_a_moving_goal_dies_away_as_that_of_one_at_rest(arm):
    """The second derivative of the error is -kp e - kd e', also away from the track."""
    rng = np.random.default_rng(5)
    q, v = arm.random_state(rng)
    twist, rate = 0.3 * rng.normal(size=6), rng.normal(size=6)
    kp, kd, h = 30.0, 7.0, 1e-4
    robot = arm.robot(0.0)
    robot.update(State(q, v), np.zeros(arm.n))
    # A goal near by: the logarithm is linear to first order in the error, which is small.
    goal = robot.pose * pin.exp6(1e-6 * rng.normal(size=6))
    error = pose_error(robot.pose, goal)
    term = PoseTask(goal, kp, kd, 1.0, PoseMotion(twist, rate)).term(robot)
    a = np.linalg.pinv(robot.J) @ term.b

    def error_at(t):
        other = arm.robot(0.0)
        other.update(State(q + t * v + 0.5 * t * t * a, v), np.zeros(arm.n))
        moved = goal * pin.exp6(t * twist + 0.5 * t * t * rate)
        return pose_error(other.pose, moved)

    first = (error_at(h) - error_at(-h)) / (2.0 * h)
    second = (error_at(h) - 2.0 * error_at(0.0) + error_at(-h)) / (h * h)
    np.testing.assert_allclose(first, twist - robot.J @ v, atol=1e-4)
    expected = -kp * error - kd * (twist - robot.J @ v)
    np.testing.assert_allclose(second, expected, atol=1e-3)
