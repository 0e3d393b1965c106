# SPDX-License-Identifier: Apache-2.0
"""An arm under torque control, without ROS: a pose out of its reach, and no limit broken.

The robot is Pinocchio's forward dynamics in small steps. Its acceleration limits and what a held
torque costs are estimated first, so that the limits hold for the continuous motion.
"""

from __future__ import annotations

import sys

import numpy as np
import pinocchio as pin

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.acceleration_limits import estimate_acceleration_limits
from viability_bounds_pkg.bounds.torque_margin import tightened, torque_margins
from viability_bounds_pkg.estimate.drift import acceleration_drift
from viability_bounds_pkg.estimate.worst_case import StateSpace
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import BoundsSolver

DT, SUBSTEPS = 0.002, 8  # s


def main() -> int:
    """Drive the arm for 3 s; print the largest violations; return 1 if there is one."""
    model = pin.buildSampleModelManipulator()
    n, names = model.nv, list(model.names)[1:]
    q_max, v_max, tau_max = np.full(n, 1.0), np.full(n, 1.5), np.full(n, 120.0)
    found = estimate_acceleration_limits(
        model, -q_max, q_max, v_max, tau_max, 5000, method="refined", cap=8.0
    )
    limits = JointLimits(names, -q_max, q_max, v_max, found.a_min, found.a_max)
    space = StateSpace.of(model, -q_max, q_max, v_max, tau_max)
    jerk = acceleration_drift(model, space, found.a_min, found.a_max, 2000)
    margins = torque_margins(1.1 * jerk, DT)
    solver = BoundsSolver(tightened(limits, margins), 2 * DT, margins.acceleration, period=DT)
    gains = Gains(pose_kp=100.0, posture_kp=10.0, posture_kd=6.0)
    robot = RobotModel(model, "effector_body", DT)
    controller = Controller(robot, [Goals(robot.n, gains), JointBounds()], tau_max)
    q, v, data = np.full(n, 0.3), np.zeros(n), model.createData()
    controller.reset(q)
    controller.goals.set_pose(pin.SE3(np.eye(3), np.array([0.0, -3.0, 0.0])))
    position = speed = torque = -np.inf
    for _ in range(round(3.0 / DT)):
        bounds = solver.bounds(q, v)
        tau = controller.step(State(q, v), AccelerationRange(bounds.lower, bounds.upper)).tau
        for _ in range(SUBSTEPS):
            h = DT / SUBSTEPS
            a = pin.aba(model, data, q + 0.5 * h * v, v, tau)
            q, v = q + h * v + 0.5 * h * h * a, v + h * a
            position = max(position, float((np.abs(q) - q_max).max()))
            speed = max(speed, float((np.abs(v) - v_max).max()))
        torque = max(torque, float((np.abs(tau) - tau_max).max()))
    print(f"nearest to a limit: {-position:.1e} rad, {-speed:.1e} rad/s, {-torque:.1f} N m inside")
    print("joints at rest on a limit:", [f"{x:.3f}" for x in q[np.abs(q) > 0.999 * q_max]])
    return 0 if max(position, speed, torque) <= 0.0 else 1


if __name__ == "__main__":
    sys.exit(main())
