# SPDX-License-Identifier: Apache-2.0
"""Position control as the motors' drives do it, through the robot that they move."""

from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot.description import build_model, read_urdf

H = 1e-3  # s
ACCURACY = 1e-3  # rad, what drives hold
TALOS = "package://example-robot-data/robots/talos_data/robots/talos_full_v2.urdf"
PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
ROBOTS = {
    "talos": (
        TALOS,
        ("torso_1_joint", "torso_2_joint", *(f"arm_left_{i}_joint" for i in range(1, 8))),
        np.array([200.0, 200.0, 100.0, 100.0, 70.0, 70.0, 20.0, 8.0, 8.0]),
        np.array([0.1, 0.1, -0.3, 0.4, 0.3, -1.4, 0.2, -0.3, 0.1]),
        np.array([0.5, 0.5, 0.2, 0.2, 0.1, 0.1, 0.08, 0.05, 0.05]),
        {"arm_left_4_link": 1.1, "torso_2_link": 1.1},
    ),
    "panda": (
        PANDA,
        tuple(f"panda_joint{i}" for i in range(1, 8)),
        np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0]),
        np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]),
        np.zeros(7),
        {},
    ),
}


class Driven:
    """A robot under its drives; arrays in the order of its joints."""

    def __init__(self, name, *, geared=False, physics_dt=H):
        urdf, joints, self.tau_max, self.q, rotors, scales = ROBOTS[name]
        self.n = len(joints)
        self.model = build_model(read_urdf(urdf), joints)
        self.v_max = np.full(self.n, 2.0)
        joint_friction = JointFriction(self.n)
        if geared:
            joint_friction = JointFriction(
                self.n,
                friction_coulomb=0.1 * self.tau_max,
                friction_static=0.13 * self.tau_max,
                friction_viscous=0.02 * self.tau_max,
                rotor_inertia=rotors,
            )
        self.robot = BulletRobot(
            read_urdf(urdf),
            joints,
            physics_dt=physics_dt,
            joint_friction=joint_friction,
            mass_scales=scales if geared else None,
        )
        self.robot.reset(self.q, np.zeros(self.n))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.robot.close()

    def move(self, q, v=None, steps=1):
        v = np.zeros(self.n) if v is None else v
        limits = self.tau_max, self.v_max
        self.robot.move(q, v, *limits, steps)

    @property
    def state(self):
        return self.robot.state()

    def gravity(self):
        return pin.computeGeneralizedGravity(self.model, self.model.createData(), self.state.q)


@pytest.mark.parametrize("geared", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_it_holds_under_gravity_and_friction(name, geared):
    with Driven(name, geared=geared) as driven:
        for _ in range(20):
            driven.move(driven.q, steps=25)
            np.testing.assert_allclose(driven.state.q, driven.q, rtol=0.0, atol=ACCURACY)
        np.testing.assert_allclose(driven.state.v, 0.0, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_torque_that_holds_is_reported(name):
    with Driven(name) as driven:
        driven.move(driven.q, steps=500)
        np.testing.assert_allclose(driven.state.motor_torque, driven.gravity(), atol=1e-6)


@pytest.mark.parametrize("physics_dt", [H, 2e-3])
@pytest.mark.parametrize("geared", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_it_goes_where_it_is_told_within_torque_and_stays(name, geared, physics_dt):
    with Driven(name, geared=geared, physics_dt=physics_dt) as driven:
        infinite = np.full(driven.n, np.inf)
        driven.robot.monitor = monitor = LimitMonitor(
            -infinite, infinite, infinite, driven.tau_max
        )
        goal = driven.q + 0.2 * np.resize([1.0, -1.0], driven.n)
        seconds = round(1.0 / physics_dt)
        driven.move(goal, steps=2 * seconds)
        for _ in range(10):
            driven.move(goal, steps=seconds // 10)
            np.testing.assert_allclose(driven.state.q, goal, rtol=0.0, atol=ACCURACY)
        assert not monitor.violated
        assert monitor.max_torque_ratio.max() > 0.5  # it had to work


def test_it_follows_a_motion():
    with Driven("talos", geared=True) as driven:
        ahead = 0.3 * np.resize([1.0, -1.0], driven.n)
        errors = []
        for k in range(2000):
            t = (k + 1) * H
            path = driven.q + ahead * (1.0 - np.cos(2.0 * t))
            driven.move(path, ahead * 2.0 * np.sin(2.0 * t))
            errors.append(np.abs(driven.state.q - path).max())
        assert np.abs(driven.state.q - driven.q).max() > 0.3
        assert max(errors[100:]) < 3e-3  # rad, friction turning over included


def test_the_speed_asked_for_is_limited():
    with Driven("talos", geared=True) as driven:
        driven.v_max = np.full(driven.n, 0.5)
        driven.move(driven.q + 0.5 * np.eye(driven.n)[0], steps=500)
        assert driven.state.v[0] == pytest.approx(0.5, abs=0.01)


def test_motors_too_weak_give_what_they_have():
    with Driven("panda") as driven:
        driven.tau_max = 0.1 * driven.tau_max
        driven.move(driven.q, steps=300)
        assert (np.abs(driven.state.motor_torque) / driven.tau_max).max() == 1.0
        assert np.abs(driven.state.q - driven.q).max() > 0.1
        driven.tau_max = 10.0 * driven.tau_max
        driven.move(driven.q, steps=2000)
        np.testing.assert_allclose(driven.state.q, driven.q, rtol=0.0, atol=ACCURACY)


@pytest.mark.parametrize("geared", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_it_takes_over_without_a_jump(name, geared):
    with Driven(name, geared=geared) as driven:
        driven.robot.brake(100, driven.tau_max)
        braked = driven.state.motor_torque
        driven.move(driven.state.q)
        np.testing.assert_allclose(driven.state.motor_torque, braked, atol=1e-4)

        # From torque control, and back to it.
        driven.v_max = np.full(driven.n, 1e3)  # some are fast by now
        tau = driven.gravity() + 0.05 * driven.tau_max * np.resize([1.0, -1.0], driven.n)
        driven.robot.step(tau, 20)
        state = driven.state
        driven.move(state.q + H * state.v, state.v)  # what it is doing already
        jump = np.abs(driven.state.motor_torque - tau) / driven.tau_max
        assert jump.max() < 1e-12
        last = driven.state.motor_torque
        driven.robot.step(last)
        np.testing.assert_array_equal(driven.state.motor_torque, last)


def test_a_reset_starts_it_anew():
    with Driven("panda") as driven:
        driven.move(driven.q + 0.3, steps=200)
        driven.robot.reset(driven.q, np.zeros(7))
        driven.move(driven.q)
        np.testing.assert_allclose(driven.state.motor_torque, driven.gravity(), atol=1e-3)


def test_bad_targets_are_refused():
    urdf, joints, tau_max, q, *_ = ROBOTS["panda"]
    with closing(BulletRobot(read_urdf(urdf), joints, physics_dt=H)) as robot:
        zero = np.zeros(7)
        for arguments, match in (
            ((q[:6], zero, tau_max, tau_max), "q must"),
            ((q, zero + np.nan, tau_max, tau_max), "v must"),
            ((q, zero, -tau_max, tau_max), "torque_limits"),
            ((q, zero, tau_max, -tau_max), "speed_limits"),
        ):
            with pytest.raises(ValueError, match=match):
                robot.move(*arguments)
