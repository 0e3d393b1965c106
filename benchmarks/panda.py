# SPDX-License-Identifier: Apache-2.0
"""The arm that rivals are compared on: Panda, its limits, and this project's controller of it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pinocchio as pin

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf

URDF = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
FRAME = "panda_hand"
JOINTS = [f"panda_joint{j}" for j in range(1, 8)]
V_MAX, A_MAX = 1.5, 5.0  # rad/s, rad/s^2
TAU_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # N m


def bare_urdf() -> str:
    """Return the arm's URDF without fingers that move, and without shapes."""
    robot = ET.fromstring(read_urdf(URDF))
    for link in robot.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    for joint in robot.findall("joint"):
        if joint.get("name") not in JOINTS:
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    return ET.tostring(robot, encoding="unicode")


def problem(dt: float, **gains: float) -> dict[str, Any]:
    """Return arm, limits, gains and control period, s, as all that are compared get them."""
    urdf = bare_urdf()
    model = build_model(urdf, JOINTS)
    return {
        "urdf": urdf,
        "joints": np.array(JOINTS),
        "low": model.lowerPositionLimit,
        "high": model.upperPositionLimit,
        "v_max": V_MAX,
        "a_max": A_MAX,
        "tau_max": TAU_MAX,
        "dt": dt,
        "posture_weight": 1.0,
        **gains,
    }


def limits_of(given: dict[str, Any]) -> JointLimits:
    """Return the limits of all joints."""
    ones = np.ones(len(JOINTS))
    return JointLimits(
        JOINTS, given["low"], given["high"], V_MAX * ones, -A_MAX * ones, A_MAX * ones
    )


def make_controller(
    model: pin.Model, goals: Goals, dt: float, q: np.ndarray, solver: str = "daqp"
) -> Controller:
    """Return a controller that starts at rest at q, shape (7,), rad."""
    robot = RobotModel(model, FRAME, dt)
    controller = Controller(robot, [goals, JointBounds()], TAU_MAX, solver=solver)
    controller.warm_up()
    controller.reset(q)
    return controller
