# SPDX-License-Identifier: Apache-2.0
from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.payload import PayloadError, payload_inertia
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    build_model,
    inertia_beyond,
    read_urdf,
)
from viability_bounds_pkg.testing.ros_harness import read_config

H = 1e-3
CENTRE = np.array([0.05, -0.02, 0.1])
BODY = [0.01, 0.001, 0.0, 0.012, -0.002, 0.008]  # kg m^2
POINT = [0.0] * 6


class Arm:
    """A robot of ``config/`` with its rotors and sensor, without friction."""

    def __init__(self, name):
        values = read_config(name, "bullet_node")
        self.urdf, self.joints = read_urdf(values["robot_description"]), values["joints"]
        names, places = values.get("locked_joints", []), values.get("locked_positions", [])
        self.locked = dict(zip(names, places, strict=True))
        self.n = len(self.joints)
        self.rotors = np.array(values.get("rotor_inertia", [0.0] * self.n))
        self.q, self.tau_max = np.array(values["start_positions"]), np.array(values["torque_max"])
        self.hand, self.sensor = values["end_effector_frame"], values.get("ft_frame", "")

    def robot(self, **friction):
        return BulletRobot(
            self.urdf,
            self.joints,
            physics_dt=H,
            locked_positions=self.locked,
            sensor_frame=self.sensor,
            joint_friction=JointFriction(self.n, rotor_inertia=self.rotors, **friction),
        )

    def model(self, payloads=()):
        """Return Pinocchio's model with payloads, pairs of link and inertia."""
        model = build_model(self.urdf, self.joints, self.locked, self.rotors)
        for link, inertia in payloads:
            frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
            model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
        return model

    def error(self, robot, model, count=20):
        """Return the largest error of accelerations in random states, relative."""
        data, rng, worst = model.createData(), np.random.default_rng(0), 0.0
        for _ in range(count):
            q = self.q + rng.uniform(-0.5, 0.5, self.n)
            v = rng.uniform(-1.0, 1.0, self.n)
            tau = rng.uniform(-0.3, 0.3, self.n) * self.tau_max
            robot.reset(q - 0.5 * H * v, v)  # so that PyBullet's own position is q
            robot.step(tau)
            a = pin.aba(model, data, q, v, tau)
            error = (robot.state().v - v) / H - a
            worst = max(worst, float(np.abs(error).max() / np.abs(a).max()))
        return worst


@pytest.mark.parametrize("name", ["panda", "talos_left_arm", "baxter_left_arm"])
def test_accelerations_are_those_of_the_model_with_the_payload(name):
    arm = Arm(name)
    sensor = arm.sensor or arm.hand
    with closing(arm.robot()) as robot:
        body = payload_inertia(arm.hand, 2.0, CENTRE, BODY)
        robot.set_payload(arm.hand, body)
        assert arm.error(robot, arm.model([(arm.hand, body)])) < 1e-11
        assert arm.error(robot, arm.model()) > 1e-2
        # A second one, on the sensor itself, and another one in place of the first.
        point = payload_inertia(sensor, 1.0, CENTRE, POINT)
        robot.set_payload(sensor, point)
        other = payload_inertia(arm.hand, 0.5, -CENTRE, POINT)
        robot.set_payload(arm.hand, other)
        now = {sensor: point} | {arm.hand: other}
        assert arm.error(robot, arm.model(now.items())) < 1e-11
        robot.set_payload(sensor, None)
        if sensor != arm.hand:
            assert arm.error(robot, arm.model([(arm.hand, other)])) < 1e-11
        robot.clear_payloads()
        assert arm.error(robot, arm.model()) < 1e-11


def test_a_payload_leaves_state_brakes_and_friction_as_they_are():
    arm = Arm("talos_left_arm")
    with closing(arm.robot(friction_coulomb=0.1 * arm.tau_max)) as robot:
        v = np.linspace(-0.1, 0.1, arm.n)
        robot.reset(arm.q, v)
        robot.step(np.zeros(arm.n), 3)
        before = robot.state()
        robot.set_payload(arm.hand, payload_inertia(arm.hand, 1.0, CENTRE, BODY))
        for once, again in zip(before, robot.state(), strict=True):
            np.testing.assert_array_equal(once, again)
        robot.brake(200, arm.tau_max)
        assert np.abs(robot.state().v).max() < 1e-12
        held = robot.state().q
        robot.set_payload(arm.hand, None)
        robot.brake(50, arm.tau_max)
        np.testing.assert_allclose(robot.state().q, held, atol=1e-12)


def test_a_payload_that_comes_in_motion_changes_the_next_step():
    arm = Arm("panda")
    body = payload_inertia("panda_link5", 3.0, CENTRE, BODY)
    with closing(arm.robot()) as robot:
        robot.reset(arm.q, np.full(arm.n, 0.2))
        for payload in (None, body, None):
            robot.set_payload("panda_link5", payload)
            model = arm.model([("panda_link5", payload)] if payload else ())
            for _ in range(5):
                q, v, _ = robot.state()
                tau = 0.1 * arm.tau_max
                a = pin.aba(model, model.createData(), q + 0.5 * H * v, v, tau)
                robot.step(tau)
                np.testing.assert_allclose((robot.state().v - v) / H, a, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("link", ["panda_hand", "panda_link8"])
def test_the_sensor_measures_what_it_carries(link):
    arm = Arm("panda")
    tool = inertia_beyond(arm.urdf, arm.sensor)
    with closing(arm.robot()) as robot:
        robot.reset(arm.q, np.zeros(arm.n))
        robot.brake(1, arm.tau_max)
        before = robot.sensor.wrench
        robot.set_payload(link, payload_inertia(link, 2.0, [0.0, 0.0, 0.1], POINT))
        np.testing.assert_array_equal(robot.sensor.wrench, before)  # until the next step
        robot.brake(1, arm.tau_max)
        force = np.linalg.norm(robot.sensor.wrench[:3])
        assert force == pytest.approx(9.81 * (tool.mass + 2.0), rel=1e-9)
        robot.set_payload(link, None)
        robot.set_payload("panda_link6", payload_inertia("panda_link6", 2.0, CENTRE, POINT))
        robot.brake(1, arm.tau_max)
        np.testing.assert_allclose(robot.sensor.wrench, before, atol=1e-9)


def test_contacts_go_on_when_a_payload_comes():
    """At rest on a table, under the same torques: the table takes the new weight."""
    arm = Arm("panda")
    model = build_model(arm.urdf, arm.joints, arm.locked)
    data, frame = model.createData(), model.getFrameId(arm.hand)
    with closing(arm.robot()) as robot:
        robot.reset(arm.q, np.zeros(arm.n))
        tip = robot.link_pose("panda_leftfinger").translation
        place = [tip[0], tip[1], tip[2] - 0.0538 - 0.1 - 0.001]
        robot.obstacles.add(Obstacle("table", "box", [0.4, 0.4, 0.2], place))

        def settle(steps):
            for _ in range(steps):
                q, v, _ = robot.state()
                J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
                gravity = pin.computeGeneralizedGravity(model, data, q)
                robot.step(gravity - 20.0 * J[2] - 5.0 * v)

        settle(1500)
        links = {contact.link for contact in robot.obstacles.contacts()}
        before = robot.obstacles.force
        assert before == pytest.approx(20.0, rel=0.05)
        robot.set_payload(arm.sensor, payload_inertia(arm.sensor, 1.0, [0.0, 0.0, 0.1], POINT))
        assert {contact.link for contact in robot.obstacles.contacts()} == links
        settle(1500)
        assert {contact.link for contact in robot.obstacles.contacts()} == links
        assert robot.obstacles.force - before == pytest.approx(9.81, rel=0.05)


def test_pushes_go_on_when_a_payload_comes():
    arm = Arm("panda")
    with closing(arm.robot()) as robot:
        robot.reset(arm.q, np.zeros(arm.n))
        robot.apply_wrench("panda_link5", [0.0, 5.0, 0.0], [0.0] * 3)
        pose = robot.link_pose(arm.hand)
        body = payload_inertia(arm.hand, 1.0, CENTRE, BODY)
        robot.set_payload(arm.hand, body)
        np.testing.assert_allclose(robot.link_pose(arm.hand).np, pose.np, atol=1e-12)
        model = arm.model([(arm.hand, body)])
        data = model.createData()
        push = model.getFrameId("panda_link5", pin.FrameType.BODY)
        J = pin.computeFrameJacobian(model, data, arm.q, push, pin.LOCAL_WORLD_ALIGNED)
        a = pin.aba(model, data, arm.q, np.zeros(arm.n), 5.0 * J[1])
        robot.step(np.zeros(arm.n))
        np.testing.assert_allclose(robot.state().v / H, a, rtol=1e-9, atol=1e-9)


def test_payloads_on_what_does_not_move_are_refused():
    arm = Arm("panda")
    with closing(arm.robot()) as robot:
        body = payload_inertia("panda_link0", 1.0, CENTRE, POINT)
        with pytest.raises(PayloadError, match="'panda_link0': that link does not move"):
            robot.set_payload("panda_link0", body)
        with pytest.raises(RobotDescriptionError, match="panda_lnik5"):
            robot.set_payload("panda_lnik5", body)
        robot.set_payload("panda_hand", body)
        for refused in (
            lambda: robot.set_payload("panda_hand payload", body),
            lambda: robot.apply_wrench("panda_hand payload", [0.0] * 3, [0.0] * 3),
        ):
            with pytest.raises(RobotDescriptionError, match="'panda_hand payload'"):
                refused()


@pytest.mark.parametrize(
    ("mass", "centre", "moments", "shown"),
    [
        (-1.0, CENTRE, POINT, "its mass is -1 kg; allowed: > 0"),
        (np.nan, CENTRE, POINT, "not finite"),
        (1.0, [np.inf, 0.0, 0.0], POINT, "not finite"),
        (1.0, CENTRE, [0.1, 0.0, 0.0, 0.1, 0.0, -0.1], "none negative"),
        (1.0, CENTRE, [0.1, 0.0, 0.0, 0.1, 0.0, 0.3], "none above the sum of the others"),
        (1.0, CENTRE, [0.1, 0.2, 0.0, 0.1, 0.0, 0.1], "none negative"),
        (1.0, CENTRE, [1e-3, 0.0, 0.0, 1e-3, 0.0, -5e-324], "should be positive"),
    ],
)
def test_payloads_that_no_body_can_be_are_refused(mass, centre, moments, shown):
    with pytest.raises(PayloadError, match=shown) as refusal:
        payload_inertia("hand", mass, centre, moments)
    assert "'hand'" in str(refusal.value)


def test_a_rod_a_disc_and_a_point_are_bodies():
    for moments in (POINT, [0.1, 0, 0, 0.1, 0, 0], [0.1, 0, 0, 0.1, 0, 0.2]):
        assert payload_inertia("hand", 1.0, CENTRE, moments).mass == 1.0
