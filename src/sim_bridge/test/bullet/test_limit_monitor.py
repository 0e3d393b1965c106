# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from sim_bridge.bullet.limit_monitor import LimitMonitor

INF = np.inf


def make_monitor():
    return LimitMonitor([-1.0, -INF], [2.0, INF], [3.0, 4.0], [10.0, 20.0])


def test_before_any_update_nothing_is_violated():
    monitor = make_monitor()
    assert not monitor.violated
    for extreme in (
        monitor.max_position_violation,
        monitor.max_velocity_violation,
        monitor.max_torque_ratio,
    ):
        np.testing.assert_array_equal(extreme, [0.0, 0.0])
    np.testing.assert_array_equal(monitor.closest_to_q_min, [INF, INF])
    np.testing.assert_array_equal(monitor.closest_to_q_max, [INF, INF])


def test_within_limits():
    monitor = make_monitor()
    monitor.update(np.array([1.5, 100.0]), np.array([-3.0, 1.0]), np.array([-10.0, 5.0]))
    monitor.update(np.array([-0.5, -100.0]), np.array([2.0, -4.0]), np.array([0.0, -15.0]))
    assert not monitor.violated
    np.testing.assert_array_equal(monitor.max_position_violation, [0.0, 0.0])
    np.testing.assert_array_equal(monitor.max_velocity_violation, [0.0, 0.0])
    np.testing.assert_array_equal(monitor.max_torque_ratio, [1.0, 0.75])
    np.testing.assert_array_equal(monitor.closest_to_q_min, [0.5, INF])
    np.testing.assert_array_equal(monitor.closest_to_q_max, [0.5, INF])


@pytest.mark.parametrize(
    ("q", "v", "tau", "position", "velocity", "ratio"),
    [
        ([2.25, 0.0], [0.0, 0.0], [0.0, 0.0], [0.25, 0.0], [0.0, 0.0], [0.0, 0.0]),
        ([-1.5, 0.0], [0.0, 0.0], [0.0, 0.0], [0.5, 0.0], [0.0, 0.0], [0.0, 0.0]),
        ([0.0, 0.0], [3.5, 0.0], [0.0, 0.0], [0.0, 0.0], [0.5, 0.0], [0.0, 0.0]),
        ([0.0, 0.0], [0.0, -6.0], [0.0, 0.0], [0.0, 0.0], [0.0, 2.0], [0.0, 0.0]),
        ([0.0, 0.0], [0.0, 0.0], [0.0, 30.0], [0.0, 0.0], [0.0, 0.0], [0.0, 1.5]),
        ([0.0, 0.0], [0.0, 0.0], [-20.0, 0.0], [0.0, 0.0], [0.0, 0.0], [2.0, 0.0]),
    ],
)
def test_each_violation_is_measured_and_kept(q, v, tau, position, velocity, ratio):
    monitor = make_monitor()
    inside = np.zeros(2)
    monitor.update(inside, inside, inside)
    assert not monitor.violated
    monitor.update(np.array(q), np.array(v), np.array(tau))
    monitor.update(inside, inside, inside)
    assert monitor.violated
    np.testing.assert_array_equal(monitor.max_position_violation, position)
    np.testing.assert_array_equal(monitor.max_velocity_violation, velocity)
    np.testing.assert_array_equal(monitor.max_torque_ratio, ratio)


def test_broken_position_limit_shows_as_negative_distance():
    monitor = make_monitor()
    monitor.update(np.array([2.25, 0.0]), np.zeros(2), np.zeros(2))
    np.testing.assert_array_equal(monitor.closest_to_q_max, [-0.25, INF])
    np.testing.assert_array_equal(monitor.closest_to_q_min, [3.25, INF])


def test_both_limits_may_be_broken_in_turn_and_the_larger_violation_counts():
    monitor = make_monitor()
    monitor.update(np.array([2.25, 0.0]), np.zeros(2), np.zeros(2))
    monitor.update(np.array([-1.125, 0.0]), np.zeros(2), np.zeros(2))
    np.testing.assert_array_equal(monitor.max_position_violation, [0.25, 0.0])
    assert monitor.violated


def test_a_torque_may_exceed_its_limit_by_rounding():
    monitor = make_monitor()
    monitor.update(np.zeros(2), np.zeros(2), np.array([10.0 * (1.0 + 1e-10), 0.0]))
    assert not monitor.violated
    monitor.update(np.zeros(2), np.zeros(2), np.array([10.0 * (1.0 + 1e-8), 0.0]))
    assert monitor.violated


@pytest.mark.parametrize("row", range(3))
def test_not_a_number_is_a_violation(row):
    monitor = make_monitor()
    values = np.zeros((3, 2))
    values[row, 1] = np.nan
    monitor.update(*values)
    monitor.update(*np.zeros((3, 2)))
    assert monitor.violated


def test_reset_forgets():
    monitor = make_monitor()
    monitor.update(np.array([9.0, 0.0]), np.full(2, 9.0), np.full(2, 99.0))
    monitor.reset()
    assert not monitor.violated
    np.testing.assert_array_equal(monitor.max_position_violation, [0.0, 0.0])
    np.testing.assert_array_equal(monitor.max_torque_ratio, [0.0, 0.0])


def test_limits_and_samples_are_copied():
    q_max = np.array([2.0])
    monitor = LimitMonitor([-1.0], q_max, [1.0], [1.0])
    q_max[0] = 0.0
    q = np.array([1.0])
    monitor.update(q, np.zeros(1), np.zeros(1))
    q[0] = 5.0
    np.testing.assert_array_equal(monitor.closest_to_q_max, [1.0])
