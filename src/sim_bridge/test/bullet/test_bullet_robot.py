# SPDX-License-Identifier: Apache-2.0
"""Steps, brakes and resets of a single joint in PyBullet."""

import numpy as np
import pinocchio as pin
import pytest
from bullet_pairs import (
    PHYSICS_DT,
    single_robot,
)

from sim_bridge.bullet.limit_monitor import LimitMonitor


def test_link_pose_follows_the_steps():
    with single_robot() as robot:
        robot.reset([0.2], [1.0])
        robot.step([0.0], 100)
        raw = 0.2 + (100 + 0.5) * PHYSICS_DT * 1.0
        turned = pin.log3(robot.link_pose("arm").rotation)
        np.testing.assert_allclose(turned, [0.0, 0.0, raw], atol=1e-12)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("substeps", [1, 3, 8])
def test_state_follows_the_constant_acceleration_map_exactly(kind, substeps):
    rng = np.random.default_rng(5)
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    with single_robot(kind=kind, extra=limit) as robot:
        x, v, dt = 0.3, -0.7, substeps * PHYSICS_DT
        robot.reset([x], [v])
        for _ in range(300):
            a = rng.uniform(-15.0, 15.0)
            robot.step([0.5 * a], substeps)
            x, v = x + dt * v + 0.5 * dt**2 * a, v + dt * a
            state = robot.state()
            assert state.q[0] == pytest.approx(x, abs=1e-12)
            assert state.v[0] == pytest.approx(v, abs=1e-12)


def test_raw_position_passes_a_bound_by_at_most_a_h2_over_8():
    h, a, q_max = 0.01, 15.0, 2.0
    overshoot = a * h**2 / 8
    with single_robot(h) as robot:
        for phase in (0.0, 0.25, 0.5, 0.75):
            # The fastest approach from which full braking keeps x at or below q_max.
            v = (10 + phase) * a * h
            robot.monitor = LimitMonitor([-np.inf], [q_max], [9.0], [99.0])
            robot.reset([q_max - v**2 / (2 * a)], [v])
            for _ in range(20):
                robot.step([-0.5 * a])
                assert robot.state().q[0] <= q_max + 1e-12
            violation = robot.monitor.max_position_violation[0]
            assert violation <= overshoot + 1e-12
            if phase == 0.5:  # the steps hit the worst state, v = a h / 2
                assert violation == pytest.approx(overshoot, abs=1e-12)


def test_monitor_sees_every_physics_step():
    with single_robot() as robot:
        robot.monitor = LimitMonitor([-1.0], [1.0], [0.0065], [1.0])
        robot.reset([0.0], [0.008])
        robot.step([-0.5], 16)  # out and back, at 1 rad/s^2
        assert robot.state().q[0] == pytest.approx(0.0, abs=1e-12)
        # The largest position is in the middle, the largest speed at the end.
        assert robot.monitor.closest_to_q_max[0] == pytest.approx(1.0 - 3.2e-5, abs=1e-12)
        assert robot.monitor.max_velocity_violation[0] == pytest.approx(0.0015, abs=1e-12)
        assert robot.monitor.max_torque_ratio[0] == 0.5
        assert robot.monitor.violated


def test_brake_is_as_strong_as_its_limit():
    with single_robot() as robot:
        robot.reset([0.0], [1.0])
        robot.brake(100, [2.0])  # 4 rad/s^2
        assert robot.state().v[0] == pytest.approx(1.0 - 0.1 * 4.0, abs=1e-9)
        assert robot.state().motor_torque[0] == pytest.approx(-2.0, abs=1e-9)
        before = robot.state().v[0]
        robot.brake(10, [0.0])
        assert robot.state().v[0] == before
        assert robot.state().motor_torque[0] == 0.0
        robot.brake(500, [2.0])
        assert robot.state().v[0] == pytest.approx(0.0, abs=1e-9)


def test_state_belongs_to_the_caller():
    with single_robot() as robot:
        robot.reset([0.5], [1.0])
        for array in robot.state():
            array.fill(9.0)
        np.testing.assert_array_equal(robot.state().v, [1.0])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_there_are_no_joint_stops(kind):
    limit = '<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>'
    with single_robot(kind=kind, extra=limit) as robot:
        robot.reset([0.0], [1.0])
        robot.step([0.0], 500)
        assert robot.state().q[0] == pytest.approx(0.5, abs=1e-12)


def test_fast_joints_are_not_clipped():
    with single_robot() as robot:
        robot.reset([0.0], [500.0])
        robot.step([0.5])
        assert robot.state().v[0] == pytest.approx(500.0 + PHYSICS_DT, abs=1e-12)


def test_robots_do_not_share_a_world():
    with single_robot() as one, single_robot() as other:
        one.reset([0.0], [1.0])
        other.reset([0.0], [0.0])
        one.step([0.0], 10)
        np.testing.assert_array_equal(other.state().q, [0.0])
        other.step([0.0], 10)
        np.testing.assert_array_equal(other.state().q, [0.0])
        one.close()
        one.close()  # harmless
        other.step([0.0])
