# SPDX-License-Identifier: Apache-2.0
"""Contacts with obstacles: statics, Coulomb's law, equations of motion, and what is refused."""

from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.obstacles import ContactMaterial, Obstacle, ObstacleError
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    build_model,
    read_urdf,
)
from viability_bounds_pkg.testing.ros_harness import read_config

H = 1e-3  # s
STIFFNESS = ContactMaterial().stiffness
CONFIG = read_config("talos_left_arm", "bullet_node")
URDF = read_urdf(CONFIG["robot_description"])
JOINTS = CONFIG["joints"]
N = len(JOINTS)
Q = np.array(CONFIG["start_positions"])
LOCKED = dict(zip(CONFIG["locked_joints"], CONFIG["locked_positions"], strict=True))
STICTION = np.array(CONFIG["friction_static"])
HAND = "gripper_left_base_link"


@pytest.fixture(scope="module")
def model():
    return build_model(URDF, JOINTS, LOCKED, CONFIG["rotor_inertia"])


def talos(friction=1.0, **options):
    """The configured arm, its friction scaled."""
    joint_friction = JointFriction(
        N,
        friction_coulomb=friction * np.array(CONFIG["friction_coulomb"]),
        friction_static=friction * STICTION,
        friction_viscous=CONFIG["friction_viscous"],
        stribeck_velocity=CONFIG["stribeck_velocity"],
        rotor_inertia=CONFIG["rotor_inertia"],
    )
    return closing(
        BulletRobot(
            URDF,
            JOINTS,
            physics_dt=H,
            locked_positions=LOCKED,
            joint_friction=joint_friction,
            **options,
        )
    )


def table(height):
    return Obstacle("table", "box", [0.6, 0.6, 0.1], [0.4, 0.25, height - 0.05])


def contact_torques(model, data, q, forces):
    """Return the joint torques of forces on links, shape (n,), N m."""
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    tau = np.zeros(model.nv)
    for link, point, force, *_ in forces:
        frame = model.getFrameId(link)
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        arm = point - data.oMf[frame].translation
        tau += J.T @ np.hstack([force, np.cross(arm, force)])
    return tau


def hand_push(model, data, q, force):
    """Return the torques that hold the arm and let its hand push with `force`, (3,), N."""
    frame = model.getFrameId(HAND)
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
    return pin.computeGeneralizedGravity(model, data, q) + J[:3].T @ force


def press(robot, model, force, steps):
    """Push with the hand, damped; return the torques of the last step."""
    data = model.createData()
    damping = np.array(CONFIG["rotor_inertia"]) * 25.0
    for _ in range(steps):
        q, v, _ = robot.state()
        tau = hand_push(model, data, q, np.array(force)) - damping * v
        robot.step(tau)
        assert np.isfinite(robot.state()).all()
    return tau


def total(contacts):
    return sum((contact.force for contact in contacts), np.zeros(3))


# A robot that moves along three axes, with a ball for a hand.


def floor(height):
    return Obstacle("floor", "box", [9.0, 9.0, 0.1], [0.0, 0.0, height - 0.05])


def gantry(axes, joint_friction=None, gravity=(0.0, 0.0, 0.0), **options):
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
    joints = [f"joint{i}" for i in range(3)]
    return closing(
        BulletRobot(
            urdf + "</robot>",
            joints,
            physics_dt=H,
            gravity=gravity,
            joint_friction=joint_friction,
            **options,
        )
    )


STRAIGHT, SKEW = np.eye(3), np.array([[1.0, 0.0, 0.5], [0.3, 1.0, 0.0], [-0.6, 0.2, 1.0]])


@pytest.mark.parametrize(
    "joint_friction", [None, JointFriction(3, rotor_inertia=0.3)], ids=["plain", "rotors"]
)
@pytest.mark.parametrize("axes", [STRAIGHT, SKEW], ids=["straight", "skew"])
@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_sliding_friction_is_coulombs_in_every_direction(joint_friction, axes, angle):
    with gantry(axes, joint_friction) as robot:
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
    with gantry(STRAIGHT, JointFriction(3, rotor_inertia=0.3)) as robot:
        robot.obstacles.add(floor(-0.0501))
        robot.step([0.0, 0.0, -20.0], 100)
        robot.step([7.0, -6.5, -20.0], 1000)  # 9.6 N of 10 N
        held = robot.state().q
        np.testing.assert_allclose(total(robot.obstacles.contacts()), [-7.0, 6.5, 20.0], atol=1e-2)
        robot.step([7.0, -6.5, -20.0], 3000)
        np.testing.assert_allclose(robot.state().q, held, rtol=0.0, atol=1e-7)
        robot.step([8.0, -7.5, -20.0], 500)  # 11 N
        assert np.linalg.norm(robot.state().q - held) > 0.04


def test_a_ball_comes_to_rest_on_a_table_without_bouncing():
    with gantry(STRAIGHT, gravity=(0.0, 0.0, -9.81)) as robot:
        robot.obstacles.add(floor(-0.1))
        hold = [0.0, 9.81, 0.0]  # only the last link's weight, and its joint's, is free to fall
        robot.reset(np.zeros(3), np.zeros(3))
        heights, forces = [], []
        for _ in range(600):
            robot.step(hold)
            heights.append(robot.state().q[2])
            forces.append(total(robot.obstacles.contacts())[2])
        touched = int(np.argmax(np.array(forces) > 0.0))
        assert np.max(heights[touched:]) < heights[touched] + 1e-3  # from 5 cm
        # v sqrt(k m) and the damper's
        assert max(forces) < np.sqrt(STIFFNESS) + ContactMaterial().damping
        assert forces[-1] == pytest.approx(9.81, abs=1e-2)
        assert -0.05 - heights[-1] == pytest.approx(9.81 / STIFFNESS, abs=2e-5)


# TALOS


@pytest.fixture(scope="module", params=["hard", "soft"])
def pressed(request, model):
    """The arm without dry friction comes to rest on a table that it presses with 100 N."""
    material = ContactMaterial(stiffness=2e4, damping=300.0) if request.param == "soft" else None
    with talos(friction=0.0, material=material) as robot:
        robot.reset(Q, np.zeros(N))
        height = robot.link_pose(HAND).translation[2] - 0.3
        robot.obstacles.add(table(height))
        tau = press(robot, model, [0.0, 0.0, -100.0], 3000)
        yield robot, height, tau, (material or ContactMaterial()).stiffness


def test_an_arm_presses_as_statics_says(pressed, model):
    robot, height, tau, stiffness = pressed
    data, state = model.createData(), robot.state()
    assert np.abs(state.v).max() < 0.05  # viscous friction lets it settle slowly
    contacts = robot.obstacles.contacts()
    force = total(contacts)
    np.testing.assert_allclose(force, [0.0, 0.0, 100.0], atol=2.0)
    forces = [(contact.link, contact.position, contact.force) for contact in contacts]
    held = tau + contact_torques(model, data, state.q, forces)
    held -= CONFIG["friction_viscous"] * state.v
    gravity = pin.computeGeneralizedGravity(model, data, state.q)
    np.testing.assert_allclose(held, gravity, atol=0.2)
    # The table has given way by F / k, and no point is further in than that.
    for contact in contacts:
        np.testing.assert_allclose(contact.normal, [0.0, 0.0, 1.0], atol=1e-6)
        assert height - contact.position[2] == pytest.approx(force[2] / stiffness, abs=5e-5)


def test_what_it_feels_is_what_moves_it(model):
    """Each step of a blow obeys the equations of motion with the forces that are reported."""
    data = model.createData()
    viscous = np.array(CONFIG["friction_viscous"])
    with talos(friction=0.0) as robot:
        robot.reset(Q, np.zeros(N))
        elbow = robot.link_pose("arm_left_4_link").translation
        robot.obstacles.add(table(robot.link_pose(HAND).translation[2] - 0.31))
        pole = Obstacle("pole", "cylinder", [0.05, 0.05, 1.0], elbow + [0.2, 0.0, 0.0])
        robot.obstacles.add(pole)
        touched = set()
        for k in range(700):
            q, v, _ = robot.state()
            q = q + 0.5 * H * v  # PyBullet's own
            force = [40.0, 30.0 * np.sin(0.01 * k), -40.0]
            tau = hand_push(model, data, q, np.array(force))
            robot.step(tau)
            forces = robot.obstacles.wrenches()
            touched |= {contact.obstacle for contact in robot.obstacles.contacts()}
            v_next = robot.state().v
            pin.computeJointJacobians(model, data, q)
            torque = tau - viscous * v_next + contact_torques(model, data, q, forces)
            a = pin.aba(model, data, q, v, torque)
            np.testing.assert_allclose((v_next - v) / H, a, atol=1e-7 * max(np.abs(a).max(), 1.0))
        assert touched == {"table", "pole"}


def test_friction_in_the_joints_leaves_the_force_steady_and_within_what_it_bears(model):
    data = model.createData()
    with talos() as robot:
        robot.reset(Q, np.zeros(N))
        robot.obstacles.add(table(robot.link_pose(HAND).translation[2] - 0.3))
        press(robot, model, [0.0, 0.0, -100.0], 1500)
        forces = []
        for _ in range(200):
            tau = press(robot, model, [0.0, 0.0, -100.0], 1)
            forces.append(total(robot.obstacles.contacts()))
        state = robot.state()
        assert np.abs(state.v).max() < 1e-9
        assert np.ptp(forces, axis=0).max() < 1e-3
        contacts = [(c.link, c.position, c.force) for c in robot.obstacles.contacts()]
        left = tau + contact_torques(model, data, state.q, contacts)
        left -= pin.computeGeneralizedGravity(model, data, state.q)
        assert (np.abs(left) < STICTION).all()
        assert forces[-1][2] > 20.0


# The world


def test_obstacles_out_of_reach_change_nothing():
    states = []
    for far in (False, True):
        with talos() as robot:
            robot.reset(Q, np.zeros(N))
            if far:
                robot.obstacles.add(table(-2.0))
            robot.step(np.linspace(30.0, 1.0, N), 100)
            states.append(robot.state())
            assert not robot.obstacles.contacts()
    np.testing.assert_allclose(states[0].q, states[1].q, rtol=0.0, atol=1e-9)


def test_obstacles_are_replaced_and_removed():
    with gantry(STRAIGHT) as robot:
        push = [0.0, 0.0, -20.0]
        robot.obstacles.add(floor(-0.0501))
        robot.step(push, 300)
        assert (
            robot.obstacles.contacts()[0].link == "link2"
            and robot.obstacles.contacts()[0].obstacle == "floor"
        )
        robot.obstacles.add(floor(-0.1))
        robot.obstacles.add(Obstacle("ground", "box", [9.0, 9.0, 0.2], [0.0, 0.0, -0.4]))
        assert not robot.obstacles.contacts()
        robot.step(push, 1000)
        assert robot.state().q[2] == pytest.approx(-0.05, abs=2e-4)
        assert robot.obstacles.remove("floor") and not robot.obstacles.remove("floor")
        robot.step(push, 1000)
        assert robot.state().q[2] == pytest.approx(-0.25, abs=2e-4)
        robot.reset(np.zeros(3), np.zeros(3))
        assert not robot.obstacles.contacts()
        robot.obstacles.clear()
        robot.step(push, 1000)
        assert robot.state().q[2] < -1.0


def test_the_same_contacts_give_the_same_numbers():
    runs = []
    for _ in range(2):
        with gantry(SKEW, JointFriction(3, rotor_inertia=0.3, friction_coulomb=1.0)) as robot:
            robot.obstacles.add(floor(-0.051))
            robot.step([6.0, 9.0, -30.0], 300)
            runs.append(np.hstack([*robot.state(), total(robot.obstacles.contacts())]))
    assert robot.obstacles.force > 5.0
    np.testing.assert_array_equal(*runs)


def test_an_obstacle_where_the_robot_is_is_refused():
    with gantry(STRAIGHT) as robot:
        with pytest.raises(ObstacleError, match=r"'floor' overlaps the robot by 20\.0 mm"):
            robot.obstacles.add(floor(-0.03))
        robot.step([0.0, 0.0, -20.0], 100)
        assert not robot.obstacles.contacts()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"name": ""}, "needs a name"),
        ({"shape": "cone"}, "'cone', none of box, sphere, cylinder"),
        ({"size": [1.0, 1.0]}, "size must be 3"),
        ({"size": [1.0, np.nan, 1.0]}, "size must be 3 finite"),
        ({"size": [1.0, 0.0, 1.0]}, "not 1 mm to 1 km"),
        ({"size": [1.0, -1.0, 1.0]}, "not 1 mm to 1 km"),
        ({"shape": "sphere", "size": [1.0, 1.0, 2.0]}, "a sphere is round"),
        ({"shape": "cylinder", "size": [1.0, 2.0, 2.0]}, "a cylinder is round"),
        ({"position": [np.inf, 0.0, 0.0]}, "position must be 3 finite"),
        ({"orientation": [0.0, 0.0, 0.0, 0.0]}, "no quaternion"),
        ({"orientation": [0.0, 0.0, 1.0]}, "orientation must be 4"),
    ],
)
def test_obstacles_that_cannot_be_are_refused(change, match):
    values = {"name": "thing", "shape": "box", "size": [1.0] * 3, "position": [0.0] * 3}
    with pytest.raises(ObstacleError, match=match):
        Obstacle(**values | change)


def test_a_robot_without_its_shapes_moves_but_meets_no_obstacles():
    mesh = '<collision><geometry><mesh filename="package://no/such.stl"/></geometry></collision>'
    urdf = f"""<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{mesh}</link>
      <joint name="joint" type="continuous"><parent link="base"/><child link="arm"/></joint>
      </robot>"""
    with closing(BulletRobot(urdf, ["joint"], physics_dt=H)) as robot:
        robot.step([1.0])
        with pytest.raises(RobotDescriptionError, match=r"no/such\.stl"):
            robot.obstacles.add(table(-1.0))
