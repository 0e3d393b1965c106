# SPDX-License-Identifier: Apache-2.0
"""TALOS' wrist held on its limit with commands that act two periods late, in the simulation."""

from __future__ import annotations

from collections import deque

import numpy as np

from sim_bridge.nodes.bullet_parameters import BulletConfiguration, make_robot
from torque_safety_controller.node.assembly import make_controller
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.qp.constraints import AccelerationRange
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot_configuration import load_model
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

ROBOT = "talos_left_arm"
JOINT = 8
DELAY = 2
POSTURE = {"pose_weight": 0.0, "posture_kp": 100.0, "posture_kd": 20.0}


def configured(kind, node, **changed):
    return read(kind, read_config(ROBOT, node) | changed)


def largest_step(**changed) -> float:
    """Return the largest step of the torque at the end of 1.5 s, of the limit."""
    bullet = configured(BulletConfiguration, "bullet_node")
    bounds = configured(BoundsConfiguration, "bounds_node", **changed)
    config = configured(ControllerConfiguration, "controller_node", **POSTURE, **changed)
    robot = make_robot(bullet)
    model = load_model(bullet, bullet.urdf)
    solve = make_bounds(bounds, lambda _: model).solve
    controller, _ = make_controller(config)
    q = np.array(bullet.start_positions)
    robot.reset(q, np.zeros(len(q)))
    controller.reset(q)
    goal = q.copy()
    goal[JOINT] = bounds.position_max[JOINT] + 0.3
    controller.set_posture_goal(goal)
    under_way: deque[np.ndarray] = deque()
    torques: list[np.ndarray] = []
    for _ in range(1500):
        q, v, _ = robot.state()
        limits = solve(q, v)
        step = controller.step(State(q, v), AccelerationRange(limits.lower, limits.upper))
        torques.append(step.tau)
        under_way.append(step.tau)
        late = under_way.popleft() if len(under_way) > DELAY else torques[0]
        robot.step(late, bullet.substeps)
    steps = np.abs(np.diff(np.array(torques[-300:]), axis=0)) / config.torque_max
    return float(steps.max())


def test_it_oscillates_with_100_not_with_50_nor_with_a_longer_horizon():
    assert largest_step(integral_lambda=100.0) > 0.3
    assert largest_step(integral_lambda=50.0) < 0.05
    assert largest_step(integral_lambda=100.0, bounds_dt_factor=6.0) < 0.01


def test_without_the_disturbance_observer_friction_ends_it():
    assert largest_step(integral_lambda=100.0, disturbance_time=-1.0) < 0.05
