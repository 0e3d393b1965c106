# SPDX-License-Identifier: Apache-2.0
import math
from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.hardware import RIPPLE_PERIODS, Imperfections, Motors
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.robot.description import build_model, read_urdf

N = 7
H = 1e-3
TORQUE_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
ZERO = np.zeros(N)
URDF = read_urdf("package://example-robot-data/robots/panda_description/urdf/panda.urdf")
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
Q = np.array([0.1, -0.7, 0.2, -2.2, 0.1, 1.6, 0.7])


def motors(**given):
    rows = [row for row in parameter_table(Imperfections) if row.per_joint]
    values = {row.name: np.zeros(N) for row in rows}
    values |= {
        key: np.broadcast_to(value, N) if key in values else value for key, value in given.items()
    }
    return Motors(Imperfections(**values), TORQUE_MAX, H)


def test_without_imperfections_the_torque_is_the_one_asked_for():
    asked = 0.3 * TORQUE_MAX
    np.testing.assert_array_equal(motors().step(asked, Q), asked)


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


def test_velocity_and_lagging_torque_together_change_by_the_torque_asked_for():
    """What compensating the lag rests on: v + T / (omega I) is driven by the command alone."""
    rng, inertia, bandwidth = np.random.default_rng(0), 0.2, 60.0
    motor = motors(motor_bandwidth=bandwidth)
    v = ZERO
    motor.step(ZERO, Q)
    total = ZERO
    for _ in range(100):
        asked = rng.uniform(-1.0, 1.0, N) * TORQUE_MAX
        v = v + H * motor.step(asked, Q) / inertia
        total = total + H * asked / inertia
        z = v + motor.believed / (2.0 * math.pi * bandwidth * inertia)
        np.testing.assert_allclose(z, total, rtol=1e-9, atol=1e-9)


def test_the_brakes_open_when_the_motors_carry_the_load():
    motor = motors(motor_bandwidth=10.0)
    asked = 0.2 * TORQUE_MAX
    np.testing.assert_array_equal(motor.step(asked, Q), asked)
    later = motor.step(ZERO, Q)
    assert (later > 0.9 * asked).all()
    motor.switch_off()
    assert motor.believed is None
    np.testing.assert_array_equal(motor.step(-asked, Q), -asked)


def test_the_torque_constant_is_off_by_its_share_and_the_drive_does_not_know():
    error = np.linspace(-0.1, 0.1, N)
    motor = motors(torque_constant_error=error)
    asked = 0.5 * TORQUE_MAX
    np.testing.assert_allclose(motor.step(asked, Q), (1.0 + error) * asked, rtol=1e-14)
    np.testing.assert_array_equal(motor.believed, asked)


def test_the_ripple_is_a_sine_of_the_joint_angle():
    motor = motors(torque_ripple=0.01)
    angles = np.random.default_rng(0).uniform(-3.0, 3.0, (200, N))
    for q in angles:
        expected = 0.01 * TORQUE_MAX * np.sin(RIPPLE_PERIODS * q)
        np.testing.assert_allclose(motor.step(ZERO, q), expected, atol=1e-12)
    turn = 2.0 * math.pi / RIPPLE_PERIODS
    np.testing.assert_allclose(motor.step(ZERO, Q + turn), motor.step(ZERO, Q), atol=1e-9)


def test_the_noise_of_the_current_has_its_size_and_repeats_after_a_reset():
    motor = motors(current_noise=0.01)
    motor.reset()
    torques = np.array([motor.step(ZERO, Q) for _ in range(4000)])
    np.testing.assert_allclose(torques.std(axis=0), 0.01 * TORQUE_MAX, rtol=0.05)
    assert (np.abs(torques) <= 0.03 * TORQUE_MAX * (1.0 + 1e-12)).all()
    np.testing.assert_array_equal(motor.believed, ZERO)
    motor.reset()
    np.testing.assert_array_equal(motor.step(ZERO, Q), torques[0])
    other = motors(current_noise=0.01, imperfection_seed=1)
    assert (other.step(ZERO, Q) != torques[0]).all()


def test_no_torque_is_beyond_the_limits_errors_included():
    motor = motors(
        motor_bandwidth=100.0, torque_constant_error=0.1, torque_ripple=0.05, current_noise=0.05
    )
    rng = np.random.default_rng(0)
    torques = np.array(
        [
            motor.step(rng.choice([-1.0, 1.0], N) * TORQUE_MAX, rng.uniform(-3.0, 3.0, N))
            for _ in range(2000)
        ]
    )
    assert (np.abs(torques) <= TORQUE_MAX).all()
    assert (np.abs(torques).max(axis=0) == TORQUE_MAX).all()


@pytest.fixture
def robot():
    infinite = np.full(N, np.inf)
    given = motors(
        motor_bandwidth=100.0, torque_constant_error=0.05, torque_ripple=0.02, current_noise=0.01
    )
    with closing(BulletRobot(URDF, JOINTS, physics_dt=H, motors=given)) as robot:
        robot.monitor = LimitMonitor(-infinite, infinite, infinite, TORQUE_MAX)
        robot.reset(Q, ZERO)
        yield robot


def test_the_robot_moves_by_the_true_torque_and_reports_the_believed_one(robot):
    model = build_model(URDF, JOINTS)
    data = model.createData()
    same = motors(
        motor_bandwidth=100.0, torque_constant_error=0.05, torque_ripple=0.02, current_noise=0.01
    )
    hold = pin.computeGeneralizedGravity(model, data, Q)
    for k in range(20):
        before, asked = robot.state(), hold + 0.1 * (-1) ** k * TORQUE_MAX
        true = same.step(asked, robot._q)
        robot.step(asked)
        after = robot.state()
        np.testing.assert_array_equal(after.motor_torque, true)
        np.testing.assert_array_equal(robot.believed_torque, same.believed)
        raw = before.q + 0.5 * H * before.v  # PyBullet's own position
        a = pin.aba(model, data, raw, before.v, true)
        np.testing.assert_allclose((after.v - before.v) / H, a, atol=1e-9 * np.abs(a).max())


def test_the_monitor_sees_the_true_torque(robot):
    robot.step(TORQUE_MAX, 5)
    assert (robot.monitor.max_torque_ratio <= 1.0).all()
    assert (robot.monitor.max_torque_ratio > 0.99).all()
    robot.monitor.reset()
    robot.step(ZERO, 200)  # the lag has gone: ripple and noise remain
    robot.monitor.reset()
    robot.step(ZERO, 50)
    assert (robot.monitor.max_torque_ratio > 0.005).all()
    assert (robot.monitor.max_torque_ratio < 0.06).all()


def test_a_reset_repeats_the_run(robot):
    def run():
        robot.reset(Q, ZERO)
        for k in range(30):
            robot.step(0.05 * math.sin(0.3 * k) * TORQUE_MAX)
        return robot.state()

    for once, again in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(once, again)


def test_brakes_have_no_motors_and_their_torque_is_reported(robot):
    robot.brake(3, TORQUE_MAX)
    np.testing.assert_array_equal(robot.believed_torque, robot.state().motor_torque)
    assert np.abs(robot.state().v).max() < 1e-12


def test_the_drives_hold_a_position_with_such_motors(robot):
    for _ in range(1500):
        robot.move(Q + 0.05, ZERO, TORQUE_MAX, np.ones(N))
    np.testing.assert_allclose(robot.state().q, Q + 0.05, atol=2e-3)
    assert (robot.monitor.max_torque_ratio <= 1.0).all()
