# SPDX-License-Identifier: Apache-2.0
"""A Panda in MuJoCo, without ROS: wild goals, and no limit broken in another physics engine.

Robot, limits and gains are those of `config/panda.yaml`. MuJoCo reads the same URDF; its own joint
limits, dampers and contacts are off, so that nothing but the torque keeps the limits. Needs
`pip install mujoco`. With the argument `naive`, the usual bounds break limits.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.parameter_files import node_parameters, read_files
from viability_bounds_pkg.robot.configuration import TaskFrames, load_model
from viability_bounds_pkg.state import State

FILES = [Path(__file__).resolve().parent.parent / "config" / "panda.yaml"]
STEPS = 4  # of physics in a control period of 2 ms
DURATION, CHANGE = 12.0, 0.6  # s; each so often another goal


class Extremes(NamedTuple):
    """How near the arm came to its limits, positive beyond, and how much it was driven."""

    position: float
    """rad"""
    speed: float
    """rad/s"""
    torque: float
    """N m"""
    driven: float
    """Largest speed, as a share of its limit."""
    disagreement: float
    """Between the accelerations of MuJoCo and Pinocchio for the same torque, rad/s^2."""


def mujoco_arm(urdf: str, joints: tuple[str, ...], dt: float) -> mujoco.MjModel:
    """Return the arm as MuJoCo reads it: inertias and joints, nothing else."""
    root = ElementTree.fromstring(urdf)
    for link in root.iter("link"):
        for part in link.findall("visual") + link.findall("collision"):
            link.remove(part)
    for joint in root.iter("joint"):
        if joint.get("name") not in joints:
            joint.set("type", "fixed")
        for part in joint.findall("dynamics") + joint.findall("mimic"):
            joint.remove(part)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    model.opt.timestep = dt
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    names = [model.joint(i).name for i in range(model.njnt)]
    assert names == list(joints), names
    return model


def drive(method: str = "exact", duration: float = DURATION, seed: int = 0) -> Extremes:
    """Send the hand to poses of random postures, and look at each physics step."""
    values = node_parameters(FILES, "/**/bounds_node") | {"method": method}
    config = read(BoundsConfiguration, values)
    model = load_model(config, config.read_urdf())
    bounds = make_bounds(config)
    frames = read_files(TaskFrames, FILES, "/**/controller_node")
    gains = read(Gains, node_parameters(FILES, "/**/controller_node") | {"pose_kp": 100.0})
    dt, tau_max, v_max = config.dt, config.torque_max, config.velocity_max
    low, high = config.position_min, config.position_max
    robot = RobotModel(model, frames.end_effector_frame, dt)
    controller = Controller(robot, [Goals(robot.n, gains), JointBounds()], tau_max)
    arm = mujoco_arm(config.read_urdf(), config.joints, dt / STEPS)
    data, rng = mujoco.MjData(arm), np.random.default_rng(seed)
    data.qpos[:] = 0.5 * (low + high)
    controller.reset(data.qpos.copy())
    goal = RobotModel(model, frames.end_effector_frame, 0.0)
    rest, worst = np.zeros(model.nv), np.full(5, -np.inf)
    for k in range(round(duration / dt)):
        if k % round(CHANGE / dt) == 0:
            goal.update(State(rng.uniform(low, high), rest), rest)
            controller.goals.set_pose(goal.pose.copy())
        q, v = data.qpos.copy(), data.qvel.copy()
        limits = bounds(q, v)
        tau = controller.step(State(q, v), AccelerationRange(limits.lower, limits.upper)).tau
        data.qfrc_applied[:] = tau
        mujoco.mj_forward(arm, data)
        apart = np.abs(data.qacc - pin.aba(model, model.createData(), q, v, tau)).max()
        for _ in range(STEPS):
            mujoco.mj_step(arm, data)
            q, v = data.qpos, data.qvel
            now = (
                np.maximum(low - q, q - high).max(),
                (np.abs(v) - v_max).max(),
                (np.abs(tau) - tau_max).max(),
                (np.abs(v) / v_max).max(),
                apart,
            )
            worst = np.maximum(worst, now)
    return Extremes(*worst.tolist())


def main() -> int:
    """Drive the arm; print how near it came to its limits; return 1 if one was broken."""
    found = drive(*sys.argv[1:2])
    broken = max(found[:3]) > 0.0
    print(f"largest speed {found.driven:.1%} of its limit; MuJoCo and Pinocchio differ by at most")
    print(f"{found.disagreement:.1e} rad/s^2; beyond limits (negative: inside) by")
    print(f"{found.position:.1e} rad, {found.speed:.1e} rad/s, {found.torque:.1e} N m")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
