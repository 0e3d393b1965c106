# SPDX-License-Identifier: Apache-2.0
"""Two hands of one robot: their tasks, and one integral for both, written down once more.

Jacobians are differences of where the hands are; the equations are NumPy's.
"""

import numpy as np
import pinocchio as pin
import pytest
from printed_law import FAST, LAMBDA, MU, SLOW, STEP, PrintedLaw

from torque_safety_controller.controller import Controller
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.integral import IntegralAction
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

SMALL, TINY = 1e-4, 1e-5  # s; rad; of differences
CONFIG = read_config("two_hands/talos_arms", "controller_node")
FRAMES = CONFIG["end_effector_frame"].split()
START = np.array(CONFIG["start_positions"])
WIDE = np.full(16, 1e5)


@pytest.fixture(scope="module")
def model():
    made = build_model(read_urdf(CONFIG["robot_description"]), CONFIG["joints"])
    made.armature = np.array(CONFIG["rotor_inertia"])
    return made


def robot(model, dt):
    first, *others = FRAMES
    return RobotModel(model, first, dt, others)


def hands(model, q):
    """Where they are."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return [data.oMf[model.getFrameId(frame)].copy() for frame in FRAMES]


def jacobian(model, q):
    """Both hands' twists, each in its own axes, by the joints' speeds, shape (12, 16)."""
    columns = []
    for step in TINY * np.eye(len(q)):
        moved = zip(hands(model, q - step), hands(model, q + step), strict=True)
        columns.append(np.concatenate([pin.log6(a.actInv(b)).vector for a, b in moved]))
    return np.array(columns).T / (2.0 * TINY)


class Motion(PrintedLaw):
    """Both arms on a motion."""

    def __init__(self, model):
        super().__init__(model, START, 12, 0.05, 3.0, SMALL)

    def J(self, t):
        return jacobian(self.model, self.q(t))


def test_one_integral_for_both_is_what_the_paper_prints(model):
    motion = Motion(model)
    law = IntegralSettings(np.full(16, np.inf), LAMBDA, SLOW, FAST, MU, "paper")
    action = IntegralAction("task", law, np.full(16, np.inf), hands=2)
    arm = robot(model, STEP)

    def torque(t, a_last, elapsed):
        arm.dt = 0.0  # M and C of the state itself, not of the middle of a step
        arm.update(State(motion.q(t), motion.v(t)), np.zeros(16))
        arm.dt = STEP
        return action.torque(arm, a_last, elapsed)

    torque(0.0, motion.a_ref(0.0), 0.0)
    for k in range(1, 20):
        t = k * STEP
        found = torque(t, motion.a_ref(t - STEP), STEP)
        expected = motion.expected(t)
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(motion.integral[6:]).max() > 1e-6  # the second hand counts


def two_hands(model, posture, goals, posture_weight) -> Controller:
    """A controller with goals for the hands, None for none, and a posture away from them."""
    arm = robot(model, STEP)
    gains = Gains(
        pose_kp=100.0, pose_kd=7.0, posture_kp=30.0, posture_kd=1.0, posture_weight=posture_weight
    )
    controller = Controller(arm, [Goals(arm.n, gains, len(arm.others)), JointBounds()], WIDE)
    controller.reset(posture)
    if goals[0] is not None:
        controller.goals.set_pose(goals[0])
    controller.goals.set_other_pose(0, goals[1])
    return controller


@pytest.mark.parametrize("only_second", [False, True])
def test_each_hand_accelerates_towards_its_own_goal(model, only_second):
    """(7) and (8), by differences along the motion."""
    rng = np.random.default_rng(1)
    q, v = START + 0.1 * rng.normal(size=16), 0.2 * rng.normal(size=16)
    goals = [
        pose * pin.exp6(pin.Motion(np.r_[0.1 * rng.normal(size=3), 0.3 * rng.normal(size=3)]))
        for pose in hands(model, q)
    ]
    if only_second:
        goals[0] = None
    controller = two_hands(model, q + 0.3, goals, posture_weight=1e-7)
    a = controller.step(State(q, v), AccelerationRange(-WIDE, WIDE)).a
    path = [hands(model, q + h * v + 0.5 * h * h * a) for h in (-SMALL, 0.0, SMALL)]
    for goal, before, now, after in zip(goals, *path, strict=True):
        if goal is None:
            continue
        speed = (after.translation - before.translation) / (2.0 * SMALL)
        found = (after.translation - 2.0 * now.translation + before.translation) / SMALL**2
        expected = 100.0 * (goal.translation - now.translation) - 7.0 * speed
        np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())
        turns = [
            pin.log3(second.rotation @ first.rotation.T) / SMALL
            for first, second in ((before, now), (now, after))
        ]
        error = pin.log3(goal.rotation @ now.rotation.T)
        expected = 100.0 * error - 7.0 * 0.5 * (turns[0] + turns[1])
        found = (turns[1] - turns[0]) / SMALL
        np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_the_stiffness_of_the_posture_moves_neither_hand(model):
    """By differences between an arm at its posture and one that is off it."""
    found = []
    for posture in (START, START + 0.2 * np.sin(np.arange(16))):
        controller = two_hands(model, posture, hands(model, START), posture_weight=0.1)
        step = controller.step(State(START, np.zeros(16)), AccelerationRange(-WIDE, WIDE))
        found.append(step.a)
    difference = found[1] - found[0]
    assert np.abs(difference).max() > 1.0
    assert np.abs(jacobian(model, START) @ difference).max() < 1e-4
