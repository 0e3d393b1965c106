# SPDX-License-Identifier: Apache-2.0
"""Contacts with obstacles: Coulomb's law, rest, equations of motion."""

from contextlib import closing

import numpy as np
import pytest
from simulated_robots import H, configured

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.obstacles import ContactMaterial, Obstacle, ObstacleError
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.testing.ros_harness import read_config

TALOS = read_config("talos_left_arm", "bullet_node")
Q = np.array(TALOS["start_positions"])
HAND = "gripper_left_base_link"
STRAIGHT, SKEW = np.eye(3), np.array([[1.0, 0.0, 0.5], [0.3, 1.0, 0.0], [-0.6, 0.2, 1.0]])


def floor(height):
    return Obstacle("floor", "box", [9.0, 9.0, 0.1], [0.0, 0.0, height - 0.05])


def table(height):
    return Obstacle("table", "box", [0.6, 0.6, 0.1], [0.4, 0.25, height - 0.05])


def total(contacts):
    return sum((contact.force for contact in contacts), np.zeros(3))


def gantry(axes=STRAIGHT, gravity=(0.0, 0.0, 0.0), material=None, **friction):
    """A robot that moves along three axes, with a ball of 5 cm for a hand."""
    urdf = '<robot name="gantry"><link name="base"/>'
    for i, axis in enumerate(axes):
        parent = f"link{i - 1}" if i else "base"
        ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
        urdf += f"""<link name="link{i}"><inertial><mass value="1"/>
          <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
          {ball if i == 2 else ""}</link>
          <joint name="joint{i}" type="prismatic"><parent link="{parent}"/>
          <child link="link{i}"/><axis xyz="{" ".join(map(str, axis))}"/>
          <limit lower="-9" upper="9" effort="0" velocity="0"/></joint>"""
    return closing(
        BulletRobot(
            urdf + "</robot>",
            [f"joint{i}" for i in range(3)],
            physics_dt=H,
            gravity=gravity,
            material=material,
            joint_friction=JointFriction(3, **friction),
        )
    )


@pytest.mark.parametrize(
    ("axes", "rotor", "angle"), [(STRAIGHT, 0.0, 0.4), (SKEW, 0.3, 2.0)], ids=["plain", "skew"]
)
def test_sliding_friction_is_coulombs_in_every_direction(axes, rotor, angle):
    with gantry(axes, rotor_inertia=rotor) as robot:
        directions = axes / np.linalg.norm(axes, axis=1)[:, None]  # velocity = directions.T v
        robot.obstacles.add(floor(-0.0501))
        push = directions @ np.array([0.0, 0.0, -20.0])
        robot.step(push, 200)
        np.testing.assert_allclose(total(robot.obstacles.contacts()), [0.0, 0.0, 20.0], atol=0.3)

        # Pushed along, with more than friction bears, until it slides that way.
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        robot.step(push + directions @ (25.0 * along), 200)
        robot.step(push, 60)
        for _ in range(20):
            robot.step(push)
            force, velocity = total(robot.obstacles.contacts()), directions.T @ robot.state().v
            assert force[2] > 5.0
            sliding = velocity[:2] / np.linalg.norm(velocity[:2])
            np.testing.assert_allclose(force[:2], -0.5 * force[2] * sliding, atol=0.02 * force[2])


def test_it_sticks_below_the_limit_and_slides_above():
    with gantry(rotor_inertia=0.3) as robot:
        robot.obstacles.add(floor(-0.0501))
        robot.step([0.0, 0.0, -20.0], 100)
        robot.step([7.0, -6.5, -20.0], 1000)  # 9.6 N of 10 N
        held = robot.state().q
        np.testing.assert_allclose(total(robot.obstacles.contacts()), [-7.0, 6.5, 20.0], atol=1e-2)
        robot.step([7.0, -6.5, -20.0], 500)
        np.testing.assert_allclose(robot.state().q, held, rtol=0.0, atol=1e-7)
        robot.step([8.0, -7.5, -20.0], 500)  # 11 N
        assert np.linalg.norm(robot.state().q - held) > 0.04


@pytest.mark.parametrize(
    "material",
    [ContactMaterial(), ContactMaterial(stiffness=2e4, damping=300.0)],
    ids=["hard", "soft"],
)
def test_a_ball_comes_to_rest_on_a_table_without_bouncing(material):
    with gantry(gravity=(0.0, 0.0, -9.81), material=material) as robot:
        robot.obstacles.add(floor(-0.1))
        hold = [0.0, 9.81, 0.0]  # only the last link's weight, and its joint's, is free to fall
        robot.reset(np.zeros(3), np.zeros(3))
        heights, forces = [], []
        for _ in range(600):
            robot.step(hold)
            heights.append(robot.state().q[2])
            forces.append(total(robot.obstacles.contacts())[2])
        (contact,) = robot.obstacles.contacts()
    np.testing.assert_allclose(contact.normal, [0.0, 0.0, 1.0], atol=1e-6)
    touched = int(np.argmax(np.array(forces) > 0.0))
    assert np.max(heights[touched:]) < heights[touched] + 1e-3  # from 5 cm
    assert max(forces) < np.sqrt(material.stiffness) + material.damping  # at 1 m/s and 1 kg
    assert forces[-1] == pytest.approx(9.81, abs=1e-2)
    assert -0.05 - heights[-1] == pytest.approx(9.81 / material.stiffness, abs=2e-5)


def test_what_an_arm_feels_is_what_moves_it():
    """Each step of a blow obeys the equations of motion with the forces that are reported."""
    with configured("talos_left_arm", friction=0.0) as pair:
        robot, touched = pair.robot, set()
        robot.reset(Q, np.zeros(pair.n))
        elbow = robot.link_pose("arm_left_4_link").translation
        robot.obstacles.add(table(robot.link_pose(HAND).translation[2] - 0.31))
        pole = Obstacle("pole", "cylinder", [0.05, 0.05, 1.0], elbow + [0.2, 0.0, 0.0])
        robot.obstacles.add(pole)
        for k in range(600):
            q, v, _ = robot.state()
            q = q + 0.5 * H * v  # PyBullet's own
            push = [40.0, 30.0 * np.sin(0.01 * k), -40.0]
            tau = pair.gravity(q) + pair.torque_of(q, HAND, push)
            robot.step(tau)
            touched |= {contact.obstacle for contact in robot.obstacles.contacts()}
            for link, point, force, *_ in robot.obstacles.wrenches():
                tau = tau + pair.torque_of(q, link, force, point=point)
            a = pair.acceleration(q, v, tau)
            change = (robot.state().v - v) / H
            np.testing.assert_allclose(change, a, atol=1e-7 * max(np.abs(a).max(), 1.0))
        assert touched == {"table", "pole"}


def test_obstacles_are_replaced_and_removed():
    push = [0.0, 0.0, -20.0]
    with gantry() as robot:
        obstacles = robot.obstacles
        obstacles.add(floor(-0.0501))
        robot.step(push, 100)
        (contact,) = obstacles.contacts()
        assert (contact.link, contact.obstacle) == ("link2", "floor")

        obstacles.add(floor(-0.1))
        assert not obstacles.contacts()
        robot.step(push, 600)
        assert robot.state().q[2] == pytest.approx(-0.05, abs=2e-4)

        assert obstacles.remove("floor") and not obstacles.remove("floor")
        robot.step(push, 100)
        assert robot.state().q[2] < -0.1


def test_the_same_contacts_give_the_same_numbers():
    runs = []
    for _ in range(2):
        with gantry(SKEW, rotor_inertia=0.3, friction_coulomb=1.0) as robot:
            robot.obstacles.add(floor(-0.051))
            robot.step([6.0, 9.0, -30.0], 200)
            runs.append(np.hstack([*robot.state(), total(robot.obstacles.contacts())]))
            assert robot.obstacles.force > 5.0
    np.testing.assert_array_equal(*runs)


def test_an_obstacle_where_the_robot_is_is_refused():
    with gantry() as robot:
        with pytest.raises(ObstacleError, match=r"'floor' overlaps the robot by 20\.0 mm"):
            robot.obstacles.add(floor(-0.03))
        robot.step([0.0, 0.0, -20.0], 100)
        assert not robot.obstacles.contacts()
