# SPDX-License-Identifier: Apache-2.0
"""The wrist's sensor against weights, momentum, contacts and pushes."""

from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    inertia_beyond,
    read_urdf,
)
from viability_bounds_pkg.testing.ros_harness import read_config

G = np.array([0.0, 0.0, -9.81])
CONFIG = {robot: read_config(robot, "bullet_node") for robot in ("panda", "talos_left_arm")}
SENSOR = {"panda": "panda_link8", "talos_left_arm": "wrist_left_ft_link"}
HAND = {"panda": "panda_hand", "talos_left_arm": "gripper_left_base_link"}
FOREARM = {"panda": "panda_link5", "talos_left_arm": "arm_left_5_link"}


def make(name, physics_dt=1e-3, sensor=None, **options):
    config = CONFIG[name]
    n = len(config["joints"])
    joint_friction = JointFriction(
        n,
        friction_coulomb=config.get("friction_coulomb", 0.0),
        rotor_inertia=config.get("rotor_inertia", 0.0),
    )
    return closing(
        BulletRobot(
            read_urdf(config["robot_description"]),
            config["joints"],
            physics_dt=physics_dt,
            locked_positions=locked(config),
            joint_friction=joint_friction,
            sensor_frame=SENSOR[name] if sensor is None else sensor,
            **options,
        )
    )


def locked(config):
    positions = zip(
        config.get("locked_joints", ()), config.get("locked_positions", ()), strict=True
    )
    return dict(positions)


def rotation(robot, link):
    return robot.link_pose(link).rotation


def weight(robot, name):
    """Return what the tool weighs, (6,), by an inertia that knows nothing of the sensor."""
    config = CONFIG[name]
    tool = inertia_beyond(read_urdf(config["robot_description"]), SENSOR[name], locked(config))
    force = tool.mass * rotation(robot, SENSOR[name]).T @ G
    return np.hstack([force, np.cross(tool.lever, force)])


@pytest.fixture(params=list(SENSOR))
def name(request):
    return request.param


def test_at_rest_it_feels_the_weight_of_what_it_carries(name):
    with make(name) as robot:
        n = len(robot.joints)
        for q in (CONFIG[name]["start_positions"], np.linspace(-0.5, 0.7, n)):
            robot.reset(q, np.zeros(n))
            np.testing.assert_allclose(robot.sensor.wrench, weight(robot, name), atol=1e-9)
            robot.brake(50, np.full(n, 300.0))
            np.testing.assert_allclose(robot.sensor.wrench, weight(robot, name), atol=1e-3)
    with make(name, mass_scales={HAND[name]: 1.5}) as heavier:
        heavier.reset(q, np.zeros(n))
        assert np.linalg.norm(heavier.sensor.wrench[:3]) > 1.1 * np.linalg.norm(
            weight(heavier, name)[:3]
        )


@pytest.mark.parametrize(
    ("sensor", "beyond"),
    [
        ("panda_link8", ["panda_hand"]),
        ("panda_link5", ["panda_link6", "panda_link7"]),
        ("panda_link2", [f"panda_link{i}" for i in range(3, 8)]),
    ],
)
def test_in_motion_it_feels_the_change_of_momentum(sensor, beyond):
    """Of the bodies beyond, whose velocities PyBullet tells; right to the length of the step."""
    h, rng = 1e-5, np.random.default_rng(1)
    with make("panda", physics_dt=h, sensor=sensor) as robot:
        world, body = robot._bullet, robot.body_id

        def momentum(about):
            change, load = np.zeros((2, 6))
            for name in beyond:
                index = robot._links[name]
                mass, _, moments = world.getDynamicsInfo(body, index)[:3]
                state = world.getLinkState(body, index, 1, 1)
                x, y, z, w = state[1]
                axes = pin.Quaternion(w, x, y, z).toRotationMatrix()
                centre, v, omega = (np.array(state[i]) for i in (0, 6, 7))
                arm = centre - about
                change[:3] += mass * v
                change[3:] += axes @ np.diag(moments) @ axes.T @ omega + np.cross(arm, mass * v)
                load += np.hstack([mass * G, np.cross(arm, mass * G)])
            return change, load

        for pushed in (False, True):
            robot.reset(rng.uniform(-1.0, 1.0, 7), rng.uniform(-1.0, 1.0, 7))
            place, axes = robot.link_pose(sensor).translation, rotation(robot, sensor)
            before, load = momentum(place)
            if pushed:
                force, torque = np.array([3.0, -5.0, 7.0]), np.array([0.1, 0.2, -0.3])
                robot.apply_wrench("panda_leftfinger", force, torque)
                robot.apply_wrench("panda_link1", 9.0 * force, torque)
                arm = robot.link_pose("panda_leftfinger").translation - place
                load += np.hstack([force, torque + np.cross(arm, force)])
            robot.step(rng.uniform(-5.0, 5.0, 7))
            expected = load - (momentum(place)[0] - before) / h
            expected = np.hstack([axes.T @ expected[:3], axes.T @ expected[3:]])
            np.testing.assert_allclose(robot.sensor.wrench, expected, atol=0.01)


def test_pushes_and_contacts_beyond_are_felt_and_others_are_not():
    """Held by its friction, the arm passes on what pushes on the hand."""
    name = "talos_left_arm"
    with make(name) as robot:
        n = len(robot.joints)
        q = np.array(CONFIG[name]["start_positions"])
        robot.reset(q, np.zeros(n))
        free, axes = weight(robot, name), rotation(robot, SENSOR[name])
        place = robot.link_pose(SENSOR[name]).translation
        limits = np.full(n, 500.0)
        force = np.array([5.0, -10.0, 8.0])
        robot.apply_wrench(FOREARM[name], force, np.zeros(3))
        robot.brake(100, limits)
        np.testing.assert_allclose(robot.sensor.wrench, free, atol=1e-6)
        robot.clear_wrenches(FOREARM[name])
        robot.apply_wrench(HAND[name], force, [0.1, 0.0, 0.2])
        robot.brake(100, limits)
        moment = np.cross(robot.link_pose(HAND[name]).translation - place, force) + [0.1, 0.0, 0.2]
        felt = np.hstack([axes.T @ force, axes.T @ moment])
        np.testing.assert_allclose(robot.sensor.wrench - free, felt, atol=1e-6)
        robot.clear_wrenches()
        # A ball of 10 cm comes to touch the hand from below, and a table that pushes.
        hand = robot.link_pose("gripper_left_fingertip_3_link").translation
        robot.obstacles.add(Obstacle("ball", "sphere", [0.1] * 3, hand + [0.0, 0.0, -0.09]))
        robot.step(np.zeros(n), 400)
        robot.brake(200, limits)
        contacts = robot.obstacles.contacts()
        assert {contact.link for contact in contacts} == {"wrist_left_ft_tool_link"}
        place, axes = robot.link_pose(SENSOR[name]).translation, rotation(robot, SENSOR[name])
        force = sum(contact.force for contact in contacts)
        moment = sum(np.cross(contact.position - place, contact.force) for contact in contacts)
        assert np.linalg.norm(force) > 5.0
        felt = np.hstack([axes.T @ force, axes.T @ moment])
        np.testing.assert_allclose(robot.sensor.wrench, weight(robot, name) + felt, atol=1e-3)


def test_a_sensor_does_not_change_the_motion(name):
    states = []
    for sensor in (None, ""):
        with make(name, sensor=sensor) as robot:
            n = len(robot.joints)
            robot.reset(CONFIG[name]["start_positions"], np.full(n, 0.3))
            robot.step(np.linspace(20.0, -1.0, n), 100)
            states.append(robot.state())
            assert (robot.sensor is None) == (sensor == "")
    np.testing.assert_allclose(states[0].q, states[1].q, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("sensor", "match"),
    [("wing", "unknown link 'wing'"), ("panda_leftfinger", "carries no other link")],
)
def test_a_sensor_that_cannot_be_is_refused(sensor, match):
    with pytest.raises(RobotDescriptionError, match=match), make("panda", sensor=sensor):
        pass
