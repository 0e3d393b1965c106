# SPDX-License-Identifier: Apache-2.0
"""TALOS' torso and arm, and a single joint, in PyBullet with friction and rotors, for tests."""

from contextlib import closing

import numpy as np
import pytest

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import (
    build_model,
    read_urdf,
)

H = 1e-3  # s
TALOS = "package://example-robot-data/robots/talos_data/robots/talos_full_v2.urdf"
JOINTS = ("torso_1_joint", "torso_2_joint", *(f"arm_left_{i}_joint" for i in range(1, 8)))
N = len(JOINTS)
TAU_MAX = np.array([200.0, 200.0, 100.0, 100.0, 70.0, 70.0, 20.0, 8.0, 8.0])
ROTORS = np.array([0.5, 0.5, 0.2, 0.2, 0.1, 0.1, 0.08, 0.05, 0.05])
Q = np.array([0.1, 0.1, -0.3, 0.4, 0.3, -1.4, 0.2, -0.3, 0.1])

INERTIA, ROTOR = 0.5, 2.0  # kg m^2, of the single joint


def single_joint(gravity=(0.0, 0.0, 0.0), physics_dt=H, **options):
    """A link that turns about a vertical axis, without gravity, with a ball 1 m out."""
    urdf = f"""
    <robot name="single"><link name="base"/>
      <link name="arm"><inertial><mass value="0.5"/>
        <inertia ixx="0.5" ixy="0" ixz="0" iyy="{INERTIA}" iyz="0" izz="{INERTIA}"/></inertial>
        <collision><origin xyz="1 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
      </link>
      <joint name="joint" type="revolute"><parent link="base"/><child link="arm"/>
        <axis xyz="{options.pop("axis", "0 0 1")}"/>
        <limit effort="0" velocity="0"/></joint></robot>"""
    return closing(
        BulletRobot(
            urdf,
            ["joint"],
            physics_dt=physics_dt,
            gravity=gravity,
            joint_friction=JointFriction(1, **options),
        )
    )


def talos(scales=None, gravity=(0.0, 0.0, -9.81), **options):
    joint_friction = JointFriction(N, **options)
    return closing(
        BulletRobot(
            read_urdf(TALOS),
            JOINTS,
            physics_dt=H,
            gravity=gravity,
            joint_friction=joint_friction,
            mass_scales=scales,
        )
    )


FRICTION = {
    "friction_coulomb": 0.1 * TAU_MAX,
    "friction_static": 0.15 * TAU_MAX,
    "friction_viscous": 0.02 * TAU_MAX,
    "stribeck_velocity": np.linspace(0.01, 0.05, N),
}


@pytest.fixture(scope="session")
def talos_model():
    return build_model(read_urdf(TALOS), JOINTS, rotor_inertia=ROTORS)


def reset_raw(robot, q, v):
    """Put PyBullet's own positions, half a step ahead of the state, at q."""
    robot.reset(q - 0.5 * robot.physics_dt * v, v)


def random_steps(robot, count, seed, largest):
    """Play physics steps from random states under random torques.

    Yields q, v and tau, up to `largest` in size, and the acceleration that came of them.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        q, v, tau = rng.uniform(-1.0, 1.0, (3, N)) * np.reshape(largest, (3, 1))
        reset_raw(robot, q, v)
        robot.step(tau)
        yield q, v, tau, (robot.state().v - v) / H
