# SPDX-License-Identifier: Apache-2.0
"""Position control as the motors' drives do it, through the robot that they move."""

import numpy as np
import pytest
from simulated_robots import H, configured

from sim_bridge.bullet.limit_monitor import LimitMonitor
from viability_bounds_pkg.testing.ros_harness import read_config

ACCURACY = 1e-3  # rad, what drives hold
ROBOTS = "panda", "talos_left_arm"  # without friction, and with much


class Driven:
    """A robot under its drives, at rest in its start posture."""

    def __init__(self, name, physics_dt=H):
        config = read_config(name, "bullet_node")
        self.tau_max, self.q = np.array(config["torque_max"]), np.array(config["start_positions"])
        self.pair = configured(name, physics_dt=physics_dt)
        self.n, self.robot, self.v_max = len(self.q), self.pair.robot, np.full(len(self.q), 2.0)
        self.robot.reset(self.q, np.zeros(self.n))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.robot.close()

    def move(self, q, v=None, steps=1):
        v = np.zeros(self.n) if v is None else v
        self.robot.move(q, v, self.tau_max, self.v_max, steps)

    @property
    def state(self):
        return self.robot.state()


@pytest.mark.parametrize(("name", "physics_dt"), [("panda", H), ("talos_left_arm", 2e-3)])
def test_it_holds_and_goes_where_it_is_told_within_torque(name, physics_dt):
    with Driven(name, physics_dt) as driven:
        for _ in range(5):
            driven.move(driven.q, steps=25)
            np.testing.assert_allclose(driven.state.q, driven.q, rtol=0.0, atol=ACCURACY)
        if name == "panda":  # no friction bears a part
            torque = driven.state.motor_torque
            np.testing.assert_allclose(torque, driven.pair.gravity(), atol=1e-2)

        infinite = np.full(driven.n, np.inf)
        monitor = LimitMonitor(-infinite, infinite, infinite, driven.tau_max)
        driven.robot.monitor = monitor
        goal = driven.q + 0.2 * np.resize([1.0, -1.0], driven.n)
        driven.move(goal, steps=round(1.5 / physics_dt))
        for _ in range(5):
            driven.move(goal, steps=round(0.1 / physics_dt))
            np.testing.assert_allclose(driven.state.q, goal, rtol=0.0, atol=ACCURACY)
        assert not monitor.violated
        assert monitor.max_torque_ratio.max() > 0.5  # it had to work


def test_it_follows_a_motion():
    with Driven("talos_left_arm") as driven:
        ahead = 0.3 * np.resize([1.0, -1.0], driven.n)
        errors = []
        for k in range(1000):
            t = (k + 1) * H
            path = driven.q + ahead * (1.0 - np.cos(4.0 * t))
            driven.move(path, ahead * 4.0 * np.sin(4.0 * t))
            errors.append(np.abs(driven.state.q - path).max())
        assert max(errors[100:]) < 3e-3  # rad, friction turning over included


def test_the_speed_asked_for_is_limited():
    with Driven("talos_left_arm") as driven:
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
        driven.move(driven.q, steps=1500)
        np.testing.assert_allclose(driven.state.q, driven.q, rtol=0.0, atol=ACCURACY)


@pytest.mark.parametrize("name", ROBOTS)
def test_it_takes_over_without_a_jump(name):
    with Driven(name) as driven:
        driven.robot.brake(100, driven.tau_max)
        braked = driven.state.motor_torque
        driven.move(driven.state.q)
        np.testing.assert_allclose(driven.state.motor_torque, braked, atol=1e-4)

        # From torque control, and back to it.
        driven.v_max = np.full(driven.n, 1e3)  # some are fast by now
        push = 0.05 * driven.tau_max * np.resize([1.0, -1.0], driven.n)
        tau = driven.pair.gravity() + push
        driven.robot.step(tau, 20)
        state = driven.state
        driven.move(state.q + H * state.v, state.v)  # what it is doing already
        jump = np.abs(driven.state.motor_torque - tau) / driven.tau_max
        assert jump.max() < 1e-12
        last = driven.state.motor_torque
        driven.robot.step(last)
        np.testing.assert_array_equal(driven.state.motor_torque, last)
