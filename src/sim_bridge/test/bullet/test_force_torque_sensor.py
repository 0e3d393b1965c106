# SPDX-License-Identifier: Apache-2.0
"""The wrist's sensor against weights, momentum, contacts and pushes."""

import numpy as np
import pinocchio as pin
import pybullet
import pytest
from simulated_robots import configured, locked_joints

from sim_bridge.bullet.obstacles import Obstacle
from viability_bounds_pkg.robot.description import inertia_beyond
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import read_config

G = np.array([0.0, 0.0, -9.81])
CONFIG = {name: read_config(name, "bullet_node") for name in ("panda", "talos_left_arm")}
HAND = "gripper_left_base_link"


def sensing(name):
    return configured(name, sensor_frame=CONFIG[name]["ft_frame"])


def in_axes(pose, force, moment):
    """Return a wrench in the axes of a pose, shape (6,)."""
    return np.hstack([pose.rotation.T @ force, pose.rotation.T @ moment])


def weight(robot, name):
    """Return what the tool weighs, (6,), by an inertia that knows nothing of the sensor."""
    config = CONFIG[name]
    urdf, frame = read_urdf(config["robot_description"]), config["ft_frame"]
    tool = inertia_beyond(urdf, frame, locked_joints(config))
    force = tool.mass * robot.link_pose(frame).rotation.T @ G
    return np.hstack([force, np.cross(tool.lever, force)])


@pytest.mark.parametrize("name", CONFIG)
def test_at_rest_it_feels_the_weight_of_what_it_carries(name):
    with sensing(name) as pair:
        robot = pair.robot
        for q in (CONFIG[name]["start_positions"], np.linspace(-0.5, 0.7, pair.n)):
            robot.reset(q, np.zeros(pair.n))
            np.testing.assert_allclose(robot.sensor.wrench, weight(robot, name), atol=1e-9)
            robot.brake(50, np.full(pair.n, 300.0))
            np.testing.assert_allclose(robot.sensor.wrench, weight(robot, name), atol=1e-3)


def momentum(robot, links, about):
    """Return momentum and weight of links about a point, (6,) each, as PyBullet tells them."""
    world, body = robot.client_id, robot.body_id
    joints = range(pybullet.getNumJoints(body, physicsClientId=world))
    names = [pybullet.getJointInfo(body, i, physicsClientId=world)[12].decode() for i in joints]
    change, load = np.zeros((2, 6))
    for index in map(names.index, links):
        mass, _, moments = pybullet.getDynamicsInfo(body, index, physicsClientId=world)[:3]
        state = pybullet.getLinkState(body, index, 1, 1, physicsClientId=world)
        x, y, z, w = state[1]
        axes = pin.Quaternion(w, x, y, z).toRotationMatrix()
        centre, v, omega = (np.array(state[i]) for i in (0, 6, 7))
        arm = centre - about
        change[:3] += mass * v
        change[3:] += axes @ np.diag(moments) @ axes.T @ omega + np.cross(arm, mass * v)
        load += np.hstack([mass * G, np.cross(arm, mass * G)])
    return change, load


@pytest.mark.parametrize(
    ("sensor", "beyond"),
    [("panda_link8", ["panda_hand"]), ("panda_link5", ["panda_link6", "panda_link7"])],
)
def test_in_motion_it_feels_the_change_of_momentum(sensor, beyond):
    """Right to the length of the step."""
    h, rng = 1e-5, np.random.default_rng(1)
    force, torque = np.array([3.0, -5.0, 7.0]), np.array([0.1, 0.2, -0.3])
    with configured("panda", physics_dt=h, sensor_frame=sensor) as pair:
        robot = pair.robot
        for pushed in (False, True):
            robot.reset(*rng.uniform(-1.0, 1.0, (2, 7)))
            pose = robot.link_pose(sensor)
            before, load = momentum(robot, beyond, pose.translation)
            if pushed:
                robot.apply_wrench("panda_leftfinger", force, torque)
                robot.apply_wrench("panda_link1", 9.0 * force, torque)
                arm = robot.link_pose("panda_leftfinger").translation - pose.translation
                load += np.hstack([force, torque + np.cross(arm, force)])
            robot.step(rng.uniform(-5.0, 5.0, 7))
            felt = load - (momentum(robot, beyond, pose.translation)[0] - before) / h
            expected = in_axes(pose, felt[:3], felt[3:])
            np.testing.assert_allclose(robot.sensor.wrench, expected, atol=0.01)


def test_pushes_and_contacts_beyond_are_felt_and_others_are_not():
    """Held by its friction, the arm passes on what pushes on the hand."""
    name = "talos_left_arm"
    force, torque = np.array([5.0, -10.0, 8.0]), np.array([0.1, 0.0, 0.2])
    with sensing(name) as pair:
        robot, limits = pair.robot, np.full(pair.n, 500.0)
        robot.reset(CONFIG[name]["start_positions"], np.zeros(pair.n))
        free, pose = weight(robot, name), robot.link_pose(CONFIG[name]["ft_frame"])
        robot.apply_wrench("arm_left_5_link", force, torque)
        robot.brake(100, limits)
        np.testing.assert_allclose(robot.sensor.wrench, free, atol=1e-6)
        robot.clear_wrenches()

        robot.apply_wrench(HAND, force, torque)
        robot.brake(100, limits)
        arm = robot.link_pose(HAND).translation - pose.translation
        felt = in_axes(pose, force, np.cross(arm, force) + torque)
        np.testing.assert_allclose(robot.sensor.wrench - free, felt, atol=1e-6)
        robot.clear_wrenches()

        # A ball of 10 cm comes to touch the hand from below.
        hand = robot.link_pose("gripper_left_fingertip_3_link").translation
        robot.obstacles.add(Obstacle("ball", "sphere", [0.1] * 3, hand + [0.0, 0.0, -0.09]))
        robot.step(np.zeros(pair.n), 400)
        robot.brake(200, limits)
        contacts, pose = robot.obstacles.contacts(), robot.link_pose(CONFIG[name]["ft_frame"])
        assert {contact.link for contact in contacts} == {"wrist_left_ft_tool_link"}
        force = sum(contact.force for contact in contacts)
        moment = sum(np.cross(c.position - pose.translation, c.force) for c in contacts)
        assert np.linalg.norm(force) > 5.0
        expected = weight(robot, name) + in_axes(pose, force, moment)
        np.testing.assert_allclose(robot.sensor.wrench, expected, atol=1e-3)
