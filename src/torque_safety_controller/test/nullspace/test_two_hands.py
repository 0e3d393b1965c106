# SPDX-License-Identifier: Apache-2.0
"""Two hands of one robot: their tasks, and one integral for both, written down once more.

Jacobians are differences of where the hands are; the equations are NumPy's.
"""

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from printed_law import FAST, LAMBDA, MU, SLOW, STEP, PrintedLaw

from torque_safety_controller.controller import Controller
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.integral_feedback.nullspace import (
    NullspaceCompliance,
    TaskShapeError,
)
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.integral import IntegralAction
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

SMALL, TINY = 1e-4, 1e-5  # s; rad; of differences


@cache
def config():
    return read_config("two_hands/talos_arms", "controller_node")


@cache
def model():
    made = build_model(read_urdf(config()["robot_description"]), config()["joints"])
    made.armature = np.array(config()["rotor_inertia"])
    return made


def frames():
    return config()["end_effector_frame"].split()


def robot(dt=0.0):
    first, *others = frames()
    return RobotModel(model(), first, dt, others)


def hands(q):
    """Where they are."""
    data = model().createData()
    pin.framesForwardKinematics(model(), data, q)
    return [data.oMf[model().getFrameId(frame)].copy() for frame in frames()]


def jacobian(q):
    """Both hands' twists, each in its own axes, by the joints' speeds, shape (12, 16)."""
    columns = []
    for step in TINY * np.eye(len(q)):
        moved = zip(hands(q - step), hands(q + step), strict=True)
        columns.append(np.concatenate([pin.log6(a.actInv(b)).vector for a, b in moved]))
    return np.array(columns).T / (2.0 * TINY)


class Motion(PrintedLaw):
    """Both arms on a motion."""

    start = np.array(config()["start_positions"])

    def __init__(self):
        super().__init__(model(), self.start, 12, 0.05, 3.0, SMALL)

    def J(self, t):
        return jacobian(self.q(t))


def additional(anti_windup, **changed):
    budget = np.full(len(Motion.start), np.inf)
    law = IntegralSettings(budget, LAMBDA, SLOW, FAST, MU, anti_windup)
    law = IntegralSettings(budget, anti_windup=anti_windup, **changed) if changed else law
    return IntegralAction("task", law, budget, hands=2)


def at(arm, motion, t):
    arm.rates, arm.dt = True, 0.0  # M and C of the state itself, not of the middle of a step
    arm.update(State(motion.q(t), motion.v(t)), np.zeros(motion.n))
    arm.dt = STEP
    return arm


def test_one_integral_for_both_is_what_the_paper_prints():
    motion, arm, action = Motion(), robot(), additional("paper")
    action.torque(at(arm, motion, 0.0), motion.a_ref(0.0), 0.0)
    for k in range(1, 60):
        t = k * STEP
        found = action.torque(at(arm, motion, t), motion.a_ref(t - STEP), STEP)
        expected = motion.expected(t)
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(motion.integral[6:]).max() > 1e-5  # the second hand counts


def test_the_errors_of_both_hands_are_integrated_exactly():
    """(25), without leaks: J a grows by the middle of J times the increment of s."""
    motion, arm = Motion(), robot()
    action = additional("qp", gain=5.0, slow_leak_rate=0.0, fast_leak_rate=50.0)
    action.torque(at(arm, motion, 0.0), motion.a_ref(0.0), 0.0)
    task, total = action.law, np.zeros(12)
    assert isinstance(task, NullspaceCompliance)
    for k in range(1, 40):
        t = k * STEP
        action.torque(at(arm, motion, t), motion.a_ref(t - STEP), STEP)
        grown = motion.a_ref(t - STEP) * STEP - (motion.v(t) - motion.v(t - STEP))
        total += 0.5 * (motion.J(t) + motion.J(t - STEP)) @ grown
        np.testing.assert_allclose(motion.J(t) @ task.memory.a, total, atol=1e-8)
    assert np.abs(total).max() > 0.05


def test_without_a_null_space_left_there_is_no_such_action():
    """11 joints, 12 rows."""
    settings = IntegralSettings(np.ones(11)), np.ones(11)
    IntegralAction("position", *settings, hands=2)
    with pytest.raises(TaskShapeError):
        IntegralAction("task", *settings, hands=2)


def two_hands(tau_max, gains) -> Controller:
    arm = robot(STEP)
    return Controller(arm, [Goals(arm.n, gains, len(arm.others)), JointBounds()], tau_max)


@pytest.mark.parametrize("only_second", [False, True])
def test_each_hand_accelerates_towards_its_own_goal(only_second):
    """(7) and (8), by differences along the motion; the posture's stiffness moves neither."""
    rng = np.random.default_rng(1)
    q, v = Motion.start + 0.1 * rng.normal(size=16), 0.2 * rng.normal(size=16)
    gains = Gains(pose_kp=100.0, pose_kd=7.0, posture_kp=30.0, posture_kd=1.0, posture_weight=1e-7)
    controller = two_hands(np.full(16, 1e5), gains)
    controller.reset(q + 0.3)
    goals = [
        pose * pin.exp6(pin.Motion(np.r_[0.1 * rng.normal(size=3), 0.3 * rng.normal(size=3)]))
        for pose in hands(q)
    ]
    if not only_second:
        controller.goals.set_pose(goals[0])
    controller.goals.set_other_pose(0, goals[1])
    wide = np.full(16, 1e5)
    a = controller.step(State(q, v), AccelerationRange(-wide, wide)).a
    path = [hands(q + h * v + 0.5 * h * h * a) for h in (-SMALL, 0.0, SMALL)]
    for hand in (1,) if only_second else (0, 1):
        before, now, after = (poses[hand] for poses in path)
        speed = (after.translation - before.translation) / (2.0 * SMALL)
        found = (after.translation - 2.0 * now.translation + before.translation) / SMALL**2
        expected = 100.0 * (goals[hand].translation - now.translation) - 7.0 * speed
        np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())
        turns = [
            pin.log3(second.rotation @ first.rotation.T) / SMALL
            for first, second in ((before, now), (now, after))
        ]
        error = pin.log3(goals[hand].rotation @ now.rotation.T)
        expected = 100.0 * error - 7.0 * 0.5 * (turns[0] + turns[1])
        found = (turns[1] - turns[0]) / SMALL
        np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_the_stiffness_of_the_posture_moves_neither_hand():
    """By differences between an arm at its posture and one that is off it."""
    q, rest, wide = Motion.start, np.zeros(16), np.full(16, 1e5)
    gains = Gains(pose_kp=100.0, pose_kd=7.0, posture_kp=30.0, posture_kd=1.0, posture_weight=0.1)
    found = []
    for posture in (q, q + 0.2 * np.sin(np.arange(16))):
        controller = two_hands(wide, gains)
        controller.reset(posture)
        controller.goals.set_pose(hands(q)[0])
        controller.goals.set_other_pose(0, hands(q)[1])
        found.append(controller.step(State(q, rest), AccelerationRange(-wide, wide)).a)
    difference = found[1] - found[0]
    assert np.abs(difference).max() > 1.0
    assert np.abs(jacobian(q) @ difference).max() < 1e-4
