# SPDX-License-Identifier: Apache-2.0
"""Robots in PyBullet beside the Pinocchio models that they should equal, for tests."""

from contextlib import closing
from typing import NamedTuple

import numpy as np

from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import (
    build_model,
    read_urdf,
)

PHYSICS_DT = 1e-3  # s
DYNAMICS_TOLERANCE = 1e-11  # relative; 1e-9 is asked for, 5e-15 was measured
BAXTER = "package://example-robot-data/robots/baxter_description/urdf/baxter.urdf"
PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
LEFT_ARM = tuple(f"left_{name}" for name in ("s0", "s1", "e0", "e1", "w0", "w1", "w2"))
PANDA_ARM = tuple(f"panda_joint{i}" for i in range(1, 8))
# What PyBullet would get wrong by itself: a link without inertia between two that have it, a
# flat and a slender tensor that break the triangle inequality, oblique products of inertia,
# joint damping and friction, a mimic joint, an axis that is not of unit length.
AWKWARD = """
<robot name="awkward">
  <link name="base"/>
  <link name="one"><inertial><origin xyz="0.1 0 0.05" rpy="0.3 1.5707963267948966 -0.2"/>
    <mass value="2"/><inertia ixx="0.02" ixy="0.003" ixz="-0.002" iyy="0.03" iyz="0.001"
    izz="0.06"/></inertial></link>
  <link name="bracket"/>
  <link name="two"><inertial><origin xyz="0 0.2 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.04"/></inertial></link>
  <link name="three"><inertial><origin xyz="0.1 0.2 0"/><mass value="0.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0" iyz="0" izz="0.01"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="one"/>
    <origin xyz="0 0 1" rpy="0.1 -1.5707963267948966 0.4"/><axis xyz="1 2 3"/>
    <dynamics damping="3" friction="2"/></joint>
  <joint name="lock" type="revolute"><parent link="one"/><child link="bracket"/>
    <origin xyz="0.3 0 0" rpy="0 0 0.5"/><axis xyz="0 3 4"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="bracket"/><child link="two"/>
    <origin xyz="0 0.1 0" rpy="0.2 0 0"/><axis xyz="0 0 -2"/>
    <limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>
    <mimic joint="lock" multiplier="2"/></joint>
  <joint name="elbow" type="revolute"><parent link="two"/><child link="three"/>
    <origin xyz="0 0.4 0"/>
    <limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint>
</robot>
"""


class Case(NamedTuple):
    urdf: str
    joints: tuple[str, ...]
    locked_positions: dict[str, float]
    tip: str
    middle: str


CASES = {
    "baxter": Case(
        BAXTER,
        LEFT_ARM,
        {"right_s0": 0.3, "right_e1": 1.0, "head_pan": -0.4, "l_gripper_l_finger_joint": 0.01},
        "left_gripper",
        "left_upper_elbow_visual",
    ),
    "panda": Case(
        PANDA,
        PANDA_ARM,
        {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.03},
        "panda_hand_tcp",
        "panda_link4",
    ),
    # Joints locked in the middle of the arm: their angles turn all that follows.
    "baxter_partly_locked": Case(
        BAXTER,
        tuple(name for name in LEFT_ARM if name not in ("left_e0", "left_w1")),
        {"left_e0": 0.7, "left_w1": -1.2},
        "left_gripper",
        "left_lower_elbow",
    ),
    "awkward": Case(AWKWARD, ("shoulder", "slide", "elbow"), {"lock": 0.8}, "three", "bracket"),
}


class Pair:
    """A robot in PyBullet and the Pinocchio model that it should equal."""

    def __init__(self, case, physics_dt=PHYSICS_DT):
        self.case = case
        self.urdf = read_urdf(case.urdf) if case.urdf.startswith("package") else case.urdf
        self.robot = BulletRobot(
            self.urdf,
            case.joints,
            locked_positions=case.locked_positions,
            physics_dt=physics_dt,
        )
        self.model = build_model(self.urdf, case.joints, case.locked_positions)
        self.data = self.model.createData()
        self.n = len(case.joints)

    def random_state(self, rng):
        return rng.uniform(-2.0, 2.0, self.n), rng.uniform(-2.0, 2.0, self.n)

    def reset_raw(self, q, v):
        """Put PyBullet's own positions, half a step ahead of the state, at q."""
        self.robot.reset(q - 0.5 * self.robot.physics_dt * v, v)


def single_joint(kind="revolute", extra="", inertia=0.5):
    if "limit" not in extra:
        extra += '<limit effort="0" velocity="0"/>'
    # Mass and inertia are equal in number, so that torque and force accelerate alike.
    return f"""
    <robot name="single"><link name="base"/>
      <link name="arm"><inertial><mass value="{inertia}"/>
        <inertia ixx="0.5" ixy="0" ixz="0" iyy="0.5" iyz="0" izz="{inertia}"/></inertial></link>
      <joint name="joint" type="{kind}"><parent link="base"/><child link="arm"/>
        <axis xyz="0 0 1"/>{extra}</joint></robot>"""


def single_robot(physics_dt=PHYSICS_DT, kind="revolute", **options):
    options.setdefault("gravity", (0.0, 0.0, 0.0))
    urdf = single_joint(kind, options.pop("extra", ""))
    return closing(BulletRobot(urdf, ["joint"], physics_dt=physics_dt, **options))


def relative_error(actual, expected):
    return np.abs(actual - expected).max() / np.abs(expected).max()
