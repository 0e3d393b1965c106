# SPDX-License-Identifier: Apache-2.0
"""The hand comes to rest where its goal is out of reach."""

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.tasks.pose_task import PoseTask
from torque_safety_controller.tasks.settling_pose_task import (
    STIFFENING,
    SettlingPoseTask,
    curvature,
)
from viability_bounds_pkg.state import State

KP, KD = 100.0, 20.0
DT = 0.005  # s
POSTURE_WEIGHT = 1e-3


def minimum(term, v):
    """Return the accelerations of a task with a light damping of the null space."""
    H = term.weight * term.A.T @ term.A + POSTURE_WEIGHT * np.eye(len(v))
    return np.linalg.solve(H, term.weight * term.A.T @ term.b - POSTURE_WEIGHT * KD * v)


def follow(arm, task, seconds):
    """Follow a task without dynamics; return robot and largest acceleration of the last second."""
    robot = arm.robot(0.0)
    q, v, a = arm.q_start.copy(), np.zeros(arm.n), np.zeros(arm.n)
    largest = []
    for _ in range(round(seconds / DT)):
        robot.update(State(q, v), a)
        a = minimum(task.term(robot), v)
        q, v = q + DT * v + 0.5 * DT * DT * a, v + DT * a
        largest.append(np.abs(a).max())
    return robot, max(largest[-round(1.0 / DT) :])


def far(arm, offset):
    robot = arm.robot(0.0)
    robot.update(State(arm.q_start, np.zeros(arm.n)), np.zeros(arm.n))
    return robot.pose * pin.SE3(np.eye(3), np.array(offset))


def test_the_curvature_is_the_second_derivative_of_the_path(arm):
    """u'S u = -r . (d/dt J(q + t u)) u, by central differences, world axes."""
    rng = np.random.default_rng(1)
    h = 1e-5
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    model, data = arm.model, arm.model.createData()
    frame = arm.robot(0.0)._frame_id

    def velocity(q, u):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        return pin.getFrameJacobian(model, data, frame, world) @ u

    for _ in range(10):
        q, _ = arm.random_state(rng)
        robot = arm.robot(0.0)
        robot.update(State(q, np.zeros(arm.n)), np.zeros(arm.n))
        r = rng.normal(size=6)
        S = curvature(robot.J, r)
        np.testing.assert_array_equal(S, S.T)
        R = robot.pose.rotation
        r_world = np.concatenate([R @ r[:3], R @ r[3:]])
        for _ in range(5):
            u = rng.normal(size=arm.n)
            rate = (velocity(q + h * u, u) - velocity(q - h * u, u)) / (2.0 * h)
            assert u @ S @ u == pytest.approx(-r_world @ rate, rel=1e-6, abs=1e-8)


def test_in_reach_it_is_the_pose_task(arm):
    """Nothing is added where the last step asked for what the task wants."""
    rng = np.random.default_rng(2)
    for _ in range(5):
        q, v = arm.random_state(rng)
        robot = arm.robot(0.0)
        robot.update(State(q, v), np.zeros(arm.n))
        goal = robot.pose * pin.exp6(0.1 * rng.normal(size=6))
        plain = PoseTask(goal, KP, KD, 2.0).term(robot)
        robot.update(State(q, v), np.linalg.pinv(plain.A) @ plain.b)
        A, b, weight = SettlingPoseTask(goal, KP, KD, 2.0).term(robot)
        np.testing.assert_array_equal(A, plain.A)
        np.testing.assert_array_equal(b, plain.b)
        assert weight == 2.0


def test_in_reach_the_hand_gets_there(arm):
    rng = np.random.default_rng(3)
    robot = arm.robot(0.0)
    robot.update(State(arm.q_start + rng.uniform(-0.3, 0.3, arm.n), np.zeros(arm.n)), arm.q_start)
    goal = robot.pose.copy()
    robot, _ = follow(arm, SettlingPoseTask(goal, KP, KD, 1.0), 5.0)
    np.testing.assert_allclose(robot.pose.homogeneous, goal.homogeneous, atol=1e-5)


@pytest.mark.parametrize("offset", [[2.0, 0.0, 0.0], [0.0, 0.0, -2.0], [0.0, 2.0, 2.0]])
def test_out_of_reach_the_arm_comes_to_rest_as_near_as_it_can(arm, offset):
    goal = far(arm, offset)
    robot, largest = follow(arm, SettlingPoseTask(goal, KP, KD, 1.0), 15.0)
    assert largest < 0.1  # rad/s^2
    # Nearer in no direction: the gradient of the squared error is zero.
    error = PoseTask(goal, 1.0, 0.0, 1.0).term(robot).b + robot.drift
    assert np.linalg.norm(error) > 0.1
    assert np.abs(robot.J.T @ error).max() < 2e-2 * np.linalg.norm(error)


def test_out_of_reach_no_direction_is_much_stiffer_than_asked_for(arm):
    """No joint direction is stiffer than that times STIFFENING; the plain task is."""
    goal = far(arm, [1.0, 0.0, 0.0])
    robot, _ = follow(arm, SettlingPoseTask(goal, KP, KD, 1.0), 15.0)
    q, h, zero = robot.q.copy(), 1e-6, np.zeros(arm.n)

    def slopes(kind):
        def a(at):
            # The error that did not act is that of the rest; J turns with the joints.
            robot.update(State(at, zero), zero)
            return minimum(kind(goal, KP, KD, 1.0).term(robot), zero)

        gradient = np.array([(a(q + h * u) - a(q - h * u)) / (2.0 * h) for u in np.eye(arm.n)])
        return -np.linalg.eigvals(gradient).real

    assert slopes(PoseTask).max() > 2.0 * STIFFENING * KP
    assert slopes(SettlingPoseTask).max() < 1.05 * STIFFENING * KP


def test_numbers_that_are_not_finite_change_nothing(arm):
    robot = arm.robot(0.0)
    robot.update(State(arm.q_start, np.zeros(arm.n)), np.zeros(arm.n))
    goal = far(arm, [1.0, 0.0, 0.0])
    plain = PoseTask(goal, KP, KD, 1.0).term(robot)
    robot.a_last = np.full(arm.n, np.inf)
    A, b, _ = SettlingPoseTask(goal, KP, KD, 1.0).term(robot)
    np.testing.assert_array_equal(A, plain.A)
    np.testing.assert_array_equal(b, plain.b)
