# SPDX-License-Identifier: Apache-2.0
"""The examples in CONTRIBUTING.md do what they say."""

import re
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import load_arm
from controllers import GAINS

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import BoundsSolver

TEXT = (Path(__file__).resolve().parents[2] / "CONTRIBUTING.md").read_text()
STIFF = replace(GAINS, pose_kp=100.0, pose_kd=20.0)
FLOOR = 0.4  # m


@pytest.fixture(scope="module")
def examples():
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL):
        exec(textwrap.dedent(block), names)
    return names


def test_the_task_asks_for_the_acceleration_of_the_point(examples):
    arm = load_arm("panda")
    robot = arm.robot(0.0)
    q, v = arm.random_state(np.random.default_rng(3))
    robot.update(State(q, v), np.zeros(arm.n))
    goal = robot.pose.translation + 0.1
    A, b, weight = examples["PointTask"](goal, 50.0, 14.0, 2.0).term(robot)
    a = np.linalg.pinv(A) @ b
    wanted = robot.pose.rotation @ (
        50.0 * robot.pose.actInv(goal) - 14.0 * (robot.J @ v)[:3]
    )  # m/s^2
    h, places = 1e-4, []
    for t in (-h, 0.0, h):
        robot.update(State(q + t * v + 0.5 * t * t * a, v), np.zeros(arm.n))
        places.append(robot.pose.translation.copy())
    assert np.diff(places, 2, axis=0)[0] / h**2 == pytest.approx(wanted, abs=1e-4)
    assert weight == 2.0


@pytest.mark.parametrize("limited", [True, False])
def test_the_limit_is_kept_in_motion(examples, limited):
    arm = load_arm("panda")
    limits = [examples["HeightLimit"](FLOOR, 1.0, 2.0, arm.dt)] if limited else []
    robot = arm.robot()
    controller = Controller(robot, [Goals(robot.n, STIFF), JointBounds(), *limits], arm.tau_max)
    a_max = np.full(arm.n, 15.0)
    bounds = BoundsSolver(
        JointLimits(arm.model.names[1:], arm.q_min, arm.q_max, arm.v_max, -a_max, a_max),
        2.0 * arm.dt,
        period=arm.dt,
    )
    q, v = arm.q_start.copy(), np.zeros(arm.n)
    robot = arm.robot(0.0)
    robot.update(State(q, v), v)
    goal = robot.pose.copy()
    goal.translation[2] = FLOOR - 0.1
    controller.reset(q)
    controller.goals.set_pose(goal)
    heights = []
    for _ in range(round(2.0 / arm.dt)):
        now = bounds.bounds(q, v)
        a = controller.step(State(q, v), AccelerationRange(now.lower, now.upper)).a
        q, v = q + arm.dt * v + 0.5 * arm.dt**2 * a, v + arm.dt * a
        robot.update(State(q, v), np.zeros(arm.n))
        heights.append(robot.pose.translation[2])
    if limited:
        assert min(heights) > FLOOR - 1e-4  # m; what changes within a step
        assert heights[-1] < FLOOR + 1e-3
    else:
        assert min(heights) < FLOOR - 0.05


def test_the_parameter_is_that_of_the_controller(examples):
    (row,) = parameter_table(examples["Damping"])
    (real,) = (each for each in parameter_table(Gains) if each.name == row.name)
    assert row == real
