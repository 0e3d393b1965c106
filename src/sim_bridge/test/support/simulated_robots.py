# SPDX-License-Identifier: Apache-2.0
"""Robots in PyBullet beside the Pinocchio models that they should equal, for tests."""

from contextlib import closing

import numpy as np
import pinocchio as pin

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import read_config

H = 1e-3  # s, the physics step
FRICTION = "friction_coulomb", "friction_static", "friction_viscous"
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


class Pair:
    """A robot in PyBullet, and the Pinocchio model that it should equal but for friction.

    Args:
        friction: of the joints, by the names of `JointFriction`.
        options: further ones of `BulletRobot`.
    """

    def __init__(
        self, urdf, joints, locked=None, rotor_inertia=0.0, friction=None, physics_dt=H, **options
    ):
        self.n, self.physics_dt, self.urdf = len(joints), physics_dt, urdf
        rotors = np.broadcast_to(rotor_inertia, self.n)
        self.robot = BulletRobot(
            urdf,
            joints,
            physics_dt=physics_dt,
            locked_positions=locked,
            joint_friction=JointFriction(self.n, rotor_inertia=rotors, **(friction or {})),
            **options,
        )
        self.model = build_model(urdf, joints, locked, rotors)
        self.data = self.model.createData()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.robot.close()

    def step(self, q, v, tau):
        """Return the acceleration of one physics step at these positions of PyBullet's own."""
        # The state that it reports is half a step behind.
        self.robot.reset(q - 0.5 * self.physics_dt * v, v)
        self.robot.step(tau)
        return (self.robot.state().v - v) / self.physics_dt

    def acceleration(self, q, v, tau):
        """Return what Pinocchio says of the same."""
        return pin.aba(self.model, self.data, q, v, tau)

    def gravity(self, q=None):
        """Return the torques that hold the arm, by default where it is, shape (n,), N m."""
        q = self.robot.state().q if q is None else q
        return pin.computeGeneralizedGravity(self.model, self.data, q)

    def torque_of(self, q, link, force, torque=(0.0, 0.0, 0.0), point=None):
        """Return the joint torques of a wrench on a link, by default at its origin, (n,), N m."""
        frame = self.model.getFrameId(link)
        J = pin.computeFrameJacobian(
            self.model, self.data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        arm = np.zeros(3) if point is None else point - self.data.oMf[frame].translation
        return J.T @ np.hstack([force, torque + np.cross(arm, force)])


def configured(name, friction=1.0, **options):
    """Return a robot of the parameter files, its friction scaled, its masses the URDF's."""
    config = read_config(name, "bullet_node")
    given = {key: friction * np.array(config[key]) for key in FRICTION if key in config}
    if "stribeck_velocity" in config:
        given["stribeck_velocity"] = config["stribeck_velocity"]
    return Pair(
        read_urdf(config["robot_description"]),
        config["joints"],
        locked_joints(config),
        config.get("rotor_inertia", 0.0),
        given,
        **options,
    )


def locked_joints(config):
    names, positions = (config.get(f"locked_{each}", ()) for each in ("joints", "positions"))
    return dict(zip(names, positions, strict=True))


def single_joint_urdf(kind="revolute", limit='effort="0" velocity="0"'):
    """Return a link on a joint; 2 N m, or 2 N, accelerate it by 4 rad/s^2, or m/s^2."""
    return f"""
    <robot name="single"><link name="base"/>
      <link name="arm"><inertial><mass value="0.5"/>
        <inertia ixx="0.5" ixy="0" ixz="0" iyy="0.5" iyz="0" izz="0.5"/></inertial></link>
      <joint name="joint" type="{kind}"><parent link="base"/><child link="arm"/>
        <axis xyz="0 0 1"/><limit {limit}/></joint></robot>"""


def single_joint(urdf=None, physics_dt=H, **friction):
    """Return the robot of `single_joint_urdf`, without gravity."""
    return closing(
        BulletRobot(
            urdf or single_joint_urdf(),
            ["joint"],
            physics_dt=physics_dt,
            gravity=(0.0, 0.0, 0.0),
            joint_friction=JointFriction(1, **friction),
        )
    )
