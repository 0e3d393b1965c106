# SPDX-License-Identifier: Apache-2.0
"""Arms that rest on a joint limit in the simulation: commands late, encoders coarse."""

from __future__ import annotations

from collections import deque

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from torque_safety_controller.node.assembly import make_controller
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.observer import Observer
from viability_bounds_pkg.testing.ros_harness import read_config

POSTURE = {"pose_weight": 0.0, "posture_kp": 100.0, "posture_kd": 20.0}


class Encoders:
    """Positions in steps, and the state that observers make of them and of the torque."""

    def __init__(self, model: pin.Model, bounds: BoundsConfiguration, q: np.ndarray) -> None:
        declared = bounds.declared
        self.model, self.data = model, model.createData()
        self.step = 2.0 * declared.position_error
        self.observer = Observer(declared.observers(bounds.dt), bounds.dt, np.zeros(len(q)))
        self.observer.start(State(q, np.zeros(len(q))))

    def read(self, q: np.ndarray, tau: np.ndarray | None) -> State:
        observer = self.observer
        if tau is not None:
            observer.predict(pin.aba(self.model, self.data, *observer.state, tau))
        observer.correct(observer.innovation(np.round(q / self.step) * self.step))
        return observer.state


def largest_step(robot, joint, seconds, delay=0, coarse=False, **changed) -> float:
    """Send a joint beyond its upper limit; return the largest step of the torque at the end.

    Args:
        robot: name of its file.
        joint: its index.
        seconds: of robot time; the last fifth of it counts.
        delay: of commands, in control periods.
        coarse: whether positions come in steps.
        changed: parameters.

    Returns:
        The step, as a share of the torque limit.
    """

    def configured(kind, node):
        return read(kind, read_config(robot, node) | POSTURE | changed)

    bullet = configured(BulletConfiguration, "bullet_node")
    bounds = configured(BoundsConfiguration, "bounds_node")
    config = configured(ControllerConfiguration, "controller_node")
    arm, solve = make_robot(bullet), make_bounds(bounds)
    controller, _ = make_controller(config)
    q = np.array(bullet.start_positions)
    encoders = Encoders(load_model(bullet, bullet.urdf), bounds, q) if coarse else None
    arm.reset(q, np.zeros(len(q)))
    controller.reset(q)
    goal = q.copy()
    goal[joint] = bounds.position_max[joint] + 0.3
    controller.goals.set_posture(goal)
    under_way: deque[np.ndarray] = deque()
    torques: list[np.ndarray] = []
    for _ in range(round(seconds / bullet.dt)):
        q, v, _ = arm.state()
        state = State(q, v)
        if encoders is not None:
            state = encoders.read(q, torques[-1] if torques else None)
        limits = solve(*state)
        step = controller.step(state, AccelerationRange(limits.lower, limits.upper))
        torques.append(step.tau)
        under_way.append(step.tau)
        arm.step(under_way.popleft() if len(under_way) > delay else torques[0], bullet.substeps)
    last = np.array(torques[-len(torques) // 5 :])
    return float((np.abs(np.diff(last, axis=0)) / config.torque_max).max())


def test_late_commands_make_no_limit_cycle_of_the_file_s_gains():
    """TALOS' wrist, commands two periods late and not compensated."""
    assert largest_step("talos_left_arm", 8, 1.5, delay=2, integral_lambda=100.0) < 0.01


@pytest.mark.parametrize(("factor", "calm"), [(1.0, False), (6.5, True)])
def test_the_horizon_that_the_tool_prints_leaves_coarse_encoders_calm(factor, calm):
    """Panda's wrist, encoders of 16 bits: at least 5.3 periods by `gain_limits`."""
    declared = {
        "position_error": [4.8e-5] * 7,
        "rotor_inertia": [0.1] * 7,
        "acceleration_disturbance": [1.0] * 7,
        "use_estimated_states": True,
    }
    found = largest_step("panda", 6, 1.5, coarse=True, bounds_dt_factor=factor, **declared)
    assert (found < 0.05) == calm
