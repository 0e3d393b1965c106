# SPDX-License-Identifier: Apache-2.0
"""Steps, brakes and wrenches of a single joint, compared with what is known in closed form."""

import numpy as np
import pytest
from simulated_robots import H, single_joint, single_joint_urdf

from sim_bridge.bullet.limit_monitor import LimitMonitor


@pytest.mark.parametrize(("kind", "substeps"), [("revolute", 1), ("prismatic", 8)])
def test_the_state_follows_the_constant_acceleration_map_exactly(kind, substeps):
    """Also outside the limits of the URDF: there are no joint stops."""
    rng = np.random.default_rng(5)
    urdf = single_joint_urdf(kind, 'lower="-0.1" upper="0.1" effort="1" velocity="1"')
    with single_joint(urdf) as robot:
        x, v, dt = 0.3, -0.7, substeps * H
        robot.reset([x], [v])
        for _ in range(300):
            a = rng.uniform(-15.0, 15.0)
            robot.step([0.5 * a], substeps)
            x, v = x + dt * v + 0.5 * dt**2 * a, v + dt * a
            assert robot.state().q[0] == pytest.approx(x, abs=1e-12)
            assert robot.state().v[0] == pytest.approx(v, abs=1e-12)


def test_the_raw_position_passes_a_bound_by_at_most_a_h2_over_8():
    h, a, q_max = 0.01, 15.0, 2.0
    overshoot = a * h**2 / 8
    with single_joint(physics_dt=h) as robot:
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


def test_the_monitor_sees_every_physics_step():
    with single_joint() as robot:
        robot.monitor = LimitMonitor([-1.0], [1.0], [0.0065], [1.0])
        robot.reset([0.0], [0.008])
        robot.step([-0.5], 16)  # out and back, at 1 rad/s^2
        assert robot.state().q[0] == pytest.approx(0.0, abs=1e-12)
        # The largest position is in the middle, the largest speed at the end.
        assert robot.monitor.closest_to_q_max[0] == pytest.approx(1.0 - 3.2e-5, abs=1e-12)
        assert robot.monitor.max_velocity_violation[0] == pytest.approx(0.0015, abs=1e-12)
        assert robot.monitor.max_torque_ratio[0] == 0.5
        assert robot.monitor.violated


def test_a_brake_is_as_strong_as_its_limit():
    with single_joint() as robot:
        robot.reset([0.0], [1.0])
        robot.brake(100, [2.0])  # 4 rad/s^2
        assert robot.state().v[0] == pytest.approx(1.0 - 0.1 * 4.0, abs=1e-9)
        assert robot.state().motor_torque[0] == pytest.approx(-2.0, abs=1e-9)
        before = robot.state().v[0]
        robot.brake(10, [0.0])
        assert robot.state().v[0] == before
        robot.brake(500, [2.0])
        assert robot.state().v[0] == pytest.approx(0.0, abs=1e-9)


def test_a_wrench_is_held_until_it_is_cleared():
    with single_joint() as robot:
        robot.apply_wrench("arm", [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        robot.step([0.0], 5)
        robot.step([0.0], 5)
        assert robot.state().v[0] == pytest.approx(10 * H * 1.0 / 0.5, rel=1e-12)
        robot.reset([1.0], [0.0])
        robot.step([0.0])
        assert robot.state().v[0] > 0.0  # a reset does not end the push
        robot.clear_wrenches()
        before = robot.state().v[0]
        robot.step([0.0], 5)
        assert robot.state().v[0] == before


def test_fast_joints_are_not_clipped():
    with single_joint() as robot:
        robot.reset([0.0], [500.0])
        robot.step([0.5])
        assert robot.state().v[0] == pytest.approx(500.0 + H, abs=1e-12)
