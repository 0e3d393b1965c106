# SPDX-License-Identifier: Apache-2.0
"""Rotors and heavier links in the equations of motion, and what the arm meets with them."""

from contextlib import closing
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pybullet
import pytest
from talos_joints import (
    INERTIA,
    JOINTS,
    ROTOR,
    ROTORS,
    TALOS,
    H,
    N,
    Q,
    random_steps,
    reset_raw,
    single_joint,
    talos,
)

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    build_model,
    read_urdf,
)


def test_rotors_are_on_the_diagonal_of_the_inertia_matrix(talos_model):
    data = talos_model.createData()
    with talos(rotor_inertia=ROTORS) as robot:
        for q, v, tau, a in random_steps(robot, 20, 1, (1.5, 3.0, 50.0)):
            expected = pin.aba(talos_model, data, q, v, tau)
            np.testing.assert_allclose(a, expected, atol=1e-11 * np.abs(expected).max())


def test_rotors_of_prismatic_joints_and_of_some_joints_only():
    urdf = """<robot name="two"><link name="base"/>
      <link name="one"><inertial><origin xyz="0.2 0.1 0"/><mass value="2"/>
        <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial></link>
      <link name="two"><inertial><origin xyz="0 0.1 0.3"/><mass value="1"/>
        <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
      <joint name="turn" type="continuous"><parent link="base"/><child link="one"/>
        <axis xyz="0 1 1"/></joint>
      <joint name="slide" type="prismatic"><parent link="one"/><child link="two"/>
        <axis xyz="1 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
    for rotors in ([0.0, 3.0], [0.7, 0.0], [0.7, 3.0]):
        model = build_model(urdf, ["turn", "slide"], rotor_inertia=rotors)
        joint_friction = JointFriction(2, rotor_inertia=rotors)
        with closing(
            BulletRobot(urdf, ["turn", "slide"], physics_dt=H, joint_friction=joint_friction)
        ) as robot:
            q, v, tau = np.array([0.3, 0.2]), np.array([1.0, -0.5]), np.array([2.0, 9.0])
            reset_raw(robot, q, v)
            robot.step(tau)
            a = pin.aba(model, model.createData(), q, v, tau)
            np.testing.assert_allclose((robot.state().v - v) / H, a, rtol=1e-10)


def test_heavier_links_move_as_if_the_urdf_said_so():
    scales = {"arm_left_4_link": 1.1, "torso_2_link": 0.8, "arm_right_3_link": 3.0}
    urdf = read_urdf(TALOS)
    model = build_model(urdf, JOINTS)
    root = ElementTree.fromstring(urdf)
    for link, scale in scales.items():
        inertial = root.find(f"./link[@name='{link}']/inertial")
        for element in (inertial.find("mass"), inertial.find("inertia")):
            for key, value in element.attrib.items():
                element.set(key, repr(scale * float(value)))
    heavy = build_model(ElementTree.tostring(root, encoding="unicode"), JOINTS)
    data = heavy.createData()
    with talos(scales=scales) as robot:
        for q, v, tau, a in random_steps(robot, 5, 5, (1.0, 2.0, 30.0)):
            expected = pin.aba(heavy, data, q, v, tau)
            np.testing.assert_allclose(a, expected, atol=1e-10 * np.abs(expected).max())
            nominal = pin.aba(model, model.createData(), q, v, tau)
            assert np.abs(nominal - expected).max() > 1e-2


def test_pushes_are_felt_through_rotors_and_friction(talos_model):
    data = talos_model.createData()
    with talos(rotor_inertia=ROTORS) as robot:
        reset_raw(robot, Q, np.zeros(N))
        wrench = np.array([30.0, -20.0, 10.0, 1.0, 2.0, -3.0])
        robot.apply_wrench("wrist_left_ft_link", wrench[:3], wrench[3:])
        robot.step(np.zeros(N))
        frame = talos_model.getFrameId("wrist_left_ft_link")
        J = pin.computeFrameJacobian(talos_model, data, Q, frame, pin.LOCAL_WORLD_ALIGNED)
        expected = pin.aba(talos_model, data, Q, np.zeros(N), J.T @ wrench)
        np.testing.assert_allclose(robot.state().v / H, expected, rtol=1e-9)


@pytest.mark.parametrize("reach", [0.09, 0.2])
def test_an_impact_meets_the_rotor(reach):
    """Angular momentum about the axis, rotor included, is what ball and arm share."""
    with single_joint(rotor_inertia=ROTOR) as robot:
        world = {"physicsClientId": robot.client_id}
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1, **world)
        place = [1.0, 0.19 + reach / 100.0, 0.0]
        ball = pybullet.createMultiBody(1.0, shape, basePosition=place, **world)
        pybullet.changeDynamics(ball, -1, linearDamping=0.0, angularDamping=0.0, **world)
        pybullet.changeDynamics(ball, -1, lateralFriction=0.0, restitution=0.0, **world)
        robot.reset([0.0], [1.0])
        for _ in range(30):
            robot.step([0.0])
        v = robot.state().v[0]
        (x, y, _), _ = pybullet.getBasePositionAndOrientation(ball, **world)
        (vx, vy, _), _ = pybullet.getBaseVelocity(ball, **world)
        assert vy > 0.5
        momentum = (INERTIA + ROTOR) * v + 1.0 * (x * vy - y * vx)
        assert momentum == pytest.approx(INERTIA + ROTOR, rel=1e-3)
        assert v < 0.9


def test_stiction_bears_what_lies_on_the_arm():
    """A box of 2 kg comes to lie 1 m out on an arm that turns about a horizontal axis."""
    for stiction, holds in ((25.0, True), (15.0, False)):
        with single_joint(
            axis="0 1 0",
            gravity=(0.0, 0.0, -9.81),
            friction_coulomb=stiction,
            rotor_inertia=ROTOR,
        ) as robot:
            world = {"physicsClientId": robot.client_id}
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=[0.05] * 3, **world
            )
            pybullet.createMultiBody(2.0, shape, basePosition=[1.0, 0.0, 0.1501], **world)
            robot.reset([0.0], [0.0])
            robot.step([0.0], 300)
            if holds:  # apart from the small knock when it comes to lie
                assert robot.state().q[0] == pytest.approx(0.0, abs=1e-3)
                assert robot.state().v[0] == pytest.approx(0.0, abs=1e-6)
            else:
                assert robot.state().q[0] > 1e-2


def test_robots_that_cannot_be_are_refused():
    urdf = read_urdf(TALOS)
    with pytest.raises(ValueError, match="that of 3 joints, not of 9"):
        BulletRobot(urdf, JOINTS, physics_dt=H, joint_friction=JointFriction(3))
    for scales, match in (
        ({"wing": 1.1}, "unknown link 'wing'.*torso_2_link"),
        ({"torso_2_link": 0.0}, "'torso_2_link' cannot be scaled by 0"),
        ({"torso_2_link": np.nan}, "cannot be scaled by nan"),
    ):
        with pytest.raises(RobotDescriptionError, match=match):
            BulletRobot(urdf, JOINTS, physics_dt=H, mass_scales=scales)
