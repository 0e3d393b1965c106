# SPDX-License-Identifier: Apache-2.0
"""Motors with a lag and errors: their torque, alone and in a robot."""

import math

import numpy as np
import pytest
from simulated_robots import H, configured

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.hardware import Imperfections, Motors
from viability_bounds_pkg.parameter import parameter_table

N = 7
TORQUE_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
ZERO = np.zeros(N)
Q = np.array([0.1, -0.7, 0.2, -2.2, 0.1, 1.6, 0.7])
BAD = {
    "motor_bandwidth": 100.0,
    "torque_constant_error": 0.05,
    "torque_ripple": 0.02,
    "current_noise": 0.01,
}


def motors(**given):
    rows = [row for row in parameter_table(Imperfections) if row.per_joint]
    values = {row.name: np.zeros(N) for row in rows}
    values |= {
        key: np.broadcast_to(value, N) if key in values else value for key, value in given.items()
    }
    return Motors(Imperfections(**values), TORQUE_MAX, H)


def test_the_torque_follows_steps_as_a_first_order_lag():
    bandwidth = np.array([50.0, 80.0, 100.0, 200.0, 400.0, 1000.0, 0.0])
    motor = motors(motor_bandwidth=bandwidth)
    motor.step(ZERO, Q)
    asked, omega = 0.5 * TORQUE_MAX, 2.0 * math.pi * bandwidth
    for k in range(1, 30):
        mean = motor.step(asked, Q)
        gone = 1.0 - np.exp(-omega * k * H)
        gone[-1] = 1.0  # infinitely fast
        np.testing.assert_allclose(motor.believed, gone * asked, rtol=1e-12)
        # The mean of 1 - exp(-omega t) over the step.
        with np.errstate(divide="ignore", invalid="ignore"):
            start, end = np.exp(-omega * (k - 1) * H), np.exp(-omega * k * H)
            average = 1.0 - (start - end) / (omega * H)
        average[-1] = 1.0
        np.testing.assert_allclose(mean, average * asked, rtol=1e-11)


def test_the_brakes_open_when_the_motors_carry_the_load():
    motor, asked = motors(motor_bandwidth=10.0), 0.2 * TORQUE_MAX
    np.testing.assert_array_equal(motor.step(asked, Q), asked)
    assert (motor.step(ZERO, Q) > 0.9 * asked).all()
    motor.switch_off()
    np.testing.assert_array_equal(motor.step(-asked, Q), -asked)


def test_the_torque_constant_is_off_by_its_share_and_the_drive_does_not_know():
    error = np.linspace(-0.1, 0.1, N)
    motor, asked = motors(torque_constant_error=error), 0.5 * TORQUE_MAX
    np.testing.assert_allclose(motor.step(asked, Q), (1.0 + error) * asked, rtol=1e-14)
    np.testing.assert_array_equal(motor.believed, asked)


def test_the_ripple_is_a_sine_of_the_joint_angle():
    motor = motors(torque_ripple=0.01)
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (50, N)):
        expected = 0.01 * TORQUE_MAX * np.sin(200.0 * q)  # periods in a turn of the joint
        np.testing.assert_allclose(motor.step(ZERO, q), expected, atol=1e-12)


def test_the_noise_of_the_current_has_its_size_and_repeats_after_a_reset():
    motor = motors(current_noise=0.01)
    torques = np.array([motor.step(ZERO, Q) for _ in range(4000)])
    np.testing.assert_allclose(torques.std(axis=0), 0.01 * TORQUE_MAX, rtol=0.05)
    assert (np.abs(torques) <= 0.03 * TORQUE_MAX * (1.0 + 1e-12)).all()
    np.testing.assert_array_equal(motor.believed, ZERO)
    motor.reset()
    np.testing.assert_array_equal(motor.step(ZERO, Q), torques[0])


def test_no_torque_is_beyond_the_limits_errors_included():
    motor, rng = motors(**BAD), np.random.default_rng(0)
    asked = rng.choice([-1.0, 1.0], (1000, N)) * TORQUE_MAX
    torques = [motor.step(tau, rng.uniform(-3.0, 3.0, N)) for tau in asked]
    assert (np.abs(torques).max(axis=0) == TORQUE_MAX).all()


@pytest.fixture
def pair():
    infinite = np.full(N, np.inf)
    with configured("panda", motors=motors(**BAD)) as made:
        made.robot.monitor = LimitMonitor(-infinite, infinite, infinite, TORQUE_MAX)
        made.robot.reset(Q, ZERO)
        yield made


def test_the_robot_moves_by_the_true_torque_and_reports_the_believed_one(pair):
    same, robot, most = motors(**BAD), pair.robot, 0.0
    hold = pair.gravity(Q)
    for k in range(20):
        before, asked = robot.state(), hold + 0.1 * (-1) ** k * TORQUE_MAX
        raw = before.q + 0.5 * H * before.v  # PyBullet's own position
        true = same.step(asked, raw)
        robot.step(asked)
        after = robot.state()
        np.testing.assert_allclose(after.motor_torque, true, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(robot.believed_torque, same.believed)
        a = pair.acceleration(raw, before.v, after.motor_torque)
        np.testing.assert_allclose((after.v - before.v) / H, a, atol=1e-9 * np.abs(a).max())
        most = np.maximum(most, np.abs(after.motor_torque) / TORQUE_MAX)
    np.testing.assert_array_equal(robot.monitor.max_torque_ratio, most)
