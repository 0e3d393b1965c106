# SPDX-License-Identifier: Apache-2.0
"""Arms and pendulums whose acceleration limits tests estimate."""

from __future__ import annotations

from functools import cache

from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf

ROBOTS = "package://example-robot-data/robots"
PENDULUM_MASS, PENDULUM_LENGTH, GRAVITY = 2.0, 0.5, 9.81


@cache
def baxter():
    joints = [f"left_{name}" for name in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]
    return build_model(read_urdf(f"{ROBOTS}/baxter_description/urdf/baxter.urdf"), joints)


@cache
def panda():
    joints = [f"panda_joint{i}" for i in range(1, 8)]
    return build_model(read_urdf(f"{ROBOTS}/panda_description/urdf/panda.urdf"), joints)


def limits_of(model):
    """The URDF's q_min, q_max, v_max, tau_max."""
    return (
        model.lowerPositionLimit,
        model.upperPositionLimit,
        model.velocityLimit,
        model.effortLimit,
    )


def pendulum(links=1, joint_type="continuous", tip_mass=PENDULUM_MASS):
    """Point masses on massless rods that swing about y; angles zero hang straight down."""
    parts = ['<robot name="pendulum"><link name="link0"/>']
    for i in range(1, links + 1):
        parts.append(
            f'<joint name="joint{i}" type="{joint_type}"><parent link="link{i - 1}"/>'
            f'<child link="link{i}"/><origin xyz="0 0 {0 if i == 1 else -PENDULUM_LENGTH}"/>'
            '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="30" velocity="4"/></joint>'
            f'<link name="link{i}"><inertial><origin xyz="0 0 {-PENDULUM_LENGTH}"/>'
            f'<mass value="{tip_mass}"/>'
            '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
    joints = [f"joint{i}" for i in range(1, links + 1)]
    return build_model("".join(parts) + "</robot>", joints)
