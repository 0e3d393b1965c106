# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from sim_bridge.bullet.limit_monitor import LimitMonitor

INF, NAN = np.inf, np.nan
INSIDE = np.zeros((3, 2))  # q, v, tau of two joints


@pytest.fixture
def monitor():
    return LimitMonitor([-1.0, -INF], [2.0, INF], [3.0, 4.0], [10.0, 20.0])


def sample(row, values):
    """Return q, v and tau of zero but for one of them."""
    changed = INSIDE.copy()
    changed[row] = values
    return changed


def test_on_the_limits_nothing_is_violated(monitor):
    assert not monitor.violated
    monitor.update(np.array([2.0, 100.0]), np.array([-3.0, 1.0]), np.array([-10.0, 5.0]))
    monitor.update(np.array([-0.5, -100.0]), np.array([2.0, -4.0]), np.array([0.0, -15.0]))
    assert not monitor.violated
    np.testing.assert_array_equal(monitor.max_torque_ratio, [1.0, 0.75])
    np.testing.assert_array_equal(monitor.closest_to_q_min, [0.5, INF])
    np.testing.assert_array_equal(monitor.closest_to_q_max, [0.0, INF])


@pytest.mark.parametrize(
    ("row", "values", "name", "expected"),
    [
        (0, [2.25, 0.0], "max_position_violation", [0.25, 0.0]),
        (0, [-1.5, 0.0], "max_position_violation", [0.5, 0.0]),
        (1, [0.0, -6.0], "max_velocity_violation", [0.0, 2.0]),
        (2, [0.0, 30.0], "max_torque_ratio", [0.0, 1.5]),
        (2, [10.0 * (1.0 + 1e-8), 0.0], "max_torque_ratio", [1.0 + 1e-8, 0.0]),
        (0, [0.0, NAN], "max_position_violation", [0.0, NAN]),
        (1, [0.0, NAN], "max_velocity_violation", [0.0, NAN]),
        (2, [0.0, NAN], "max_torque_ratio", [0.0, NAN]),
    ],
)
def test_a_violation_is_measured_and_kept_until_a_reset(monitor, row, values, name, expected):
    monitor.update(*INSIDE)
    monitor.update(*sample(row, values))
    monitor.update(*INSIDE)
    assert monitor.violated
    np.testing.assert_allclose(getattr(monitor, name), expected, rtol=1e-15)
    monitor.reset()
    assert not monitor.violated


def test_a_torque_may_exceed_its_limit_by_rounding(monitor):
    monitor.update(*sample(2, [10.0 * (1.0 + 1e-10), 0.0]))
    assert not monitor.violated


@pytest.mark.parametrize(
    ("q", "v", "excess"),
    [
        (1.9, 0.6, 0.1),  # up to sqrt(2 * 5 * 0.1) - 0.5 rad/s, 0.1 rad before the limit
        (-0.9, -0.6, 0.1),
        (1.9, -2.0, 0.0),  # away from it
        (1.98, 0.1, 0.1),  # not at all there
        (0.5, 3.5, 0.5),
        (0.5, NAN, NAN),
    ],
)
def test_speeds_are_compared_with_the_limits_at_their_positions(q, v, excess):
    limits = [-1.0, -INF], [2.0, INF], [3.0, 4.0], [10.0, 20.0]
    monitor = LimitMonitor(*limits, [0.5, 0.0], [5.0, INF])
    monitor.update(np.array([q, 9.0]), np.array([v, -4.0]), np.zeros(2))
    monitor.update(*INSIDE)
    np.testing.assert_allclose(monitor.max_velocity_violation, [excess, 0.0], atol=1e-12)
    assert monitor.violated == (excess != 0.0)


def test_positions_that_are_ahead_of_velocities_are_taken_back_for_them():
    monitor = LimitMonitor([-1.0], [2.0], [3.0], [10.0], [0.5], [5.0])
    monitor.update(np.array([1.9 + 0.5 * 0.002]), np.array([0.5]), np.zeros(1), 0.002)
    np.testing.assert_allclose(monitor.max_velocity_violation, 0.0, atol=1e-12)
    monitor.update(np.array([1.9 + 0.5 * 0.002]), np.array([0.5]), np.zeros(1))
    assert monitor.max_velocity_violation > 1e-3
