# SPDX-License-Identifier: Apache-2.0
"""What drives report of a motion: encoders, noise, filter, delay."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sim_bridge.hardware import Imperfections, Sensing
from viability_bounds_pkg.parameter import parameter_table

N = 3
DT = 2e-3
TORQUE_MAX = np.array([80.0, 40.0, 10.0])


def imperfections(**given):
    """Return those given; of joints, the same for each."""
    rows = {row.name: row for row in parameter_table(Imperfections)}
    values = {row.name: np.zeros(N) for row in rows.values() if row.per_joint}
    values |= {k: np.full(N, v) if rows[k].per_joint else v for k, v in given.items()}
    return Imperfections(**values)


def sensing(**given):
    return Sensing(imperfections(**given), TORQUE_MAX, DT)


def path(count):
    """Return a motion: positions and velocities, shape (count, N) each."""
    t, rate = DT * np.arange(count)[:, None], np.array([3.0, 7.0, 11.0])
    return np.sin(rate * t), rate * np.cos(rate * t)


def readings(sensors, q, v, effort=None):
    """Return what is reported of a motion: positions, velocities, efforts."""
    tau = np.zeros_like(q) if effort is None else effort
    first = sensors.reset(q[0], v[0], tau[0])
    rest = [sensors.read(*each) for each in zip(q[1:], v[1:], tau[1:], strict=True)]
    return (np.array(each) for each in zip(first, *rest, strict=True))


def test_encoders_report_whole_steps_at_most_half_a_step_off():
    resolution = np.array([1e-3, 0.0, 3e-4])
    sensors = Sensing(replace(imperfections(), encoder_resolution=resolution), TORQUE_MAX, DT)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (3000, N))
    read, *_ = readings(sensors, q, q)
    np.testing.assert_array_equal(read[:, 1], q[:, 1])
    for j in (0, 2):
        steps = read[:, j] / resolution[j]
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
        error = np.abs(read[:, j] - q[:, j]).max()
        assert 0.49 * resolution[j] < error <= 0.5 * resolution[j] * (1.0 + 1e-9)


def test_velocity_from_encoders_is_the_difference_over_a_period():
    q, v = path(400)
    read, velocity, _ = readings(sensing(encoder_resolution=1e-3, velocity_source="encoder"), q, v)
    rounded = 1e-3 * np.round(q / 1e-3)
    np.testing.assert_allclose(read, rounded, atol=1e-12)
    np.testing.assert_allclose(velocity[1:], np.diff(rounded, axis=0) / DT, atol=1e-9)
    np.testing.assert_array_equal(velocity[0], v[0])


def test_the_drive_filters_velocities_and_nothing_else():
    q, v = np.zeros((40, N)), np.ones((40, N))
    v[0] = 0.0
    read, velocity, effort = readings(sensing(velocity_filter_hz=20.0), q, v, v)
    t = DT * np.arange(40)[:, None]
    expected = np.where(t > 0.0, 1.0 - np.exp(-2.0 * math.pi * 20.0 * t), 0.0)
    np.testing.assert_allclose(velocity, expected * np.ones(N), rtol=1e-12)
    np.testing.assert_array_equal(read, q)
    np.testing.assert_array_equal(effort, v)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_a_delayed_state_is_that_of_so_many_periods_ago(delay):
    q, v = path(30)
    tau = 2.0 * q
    reported = readings(sensing(state_delay=delay), q, v, tau)
    for read, true in zip(reported, (q, v, tau), strict=True):
        np.testing.assert_array_equal(read[delay:], true[: 30 - delay])
        np.testing.assert_array_equal(read[:delay], np.tile(true[0], (delay, 1)))


def test_noise_is_white_normal_clipped_at_three_deviations_and_apart_for_each_reading():
    q = np.zeros((8000, N))
    given = {"position_noise": 1.0, "velocity_noise": 0.05, "current_noise": 0.01}
    noises = np.hstack(list(readings(sensing(**given), q, q, q)))
    unit = noises / np.hstack([np.ones(N), np.full(N, 0.05), 0.01 * TORQUE_MAX])
    # The deviation of a normal distribution clipped at 3.
    inside, density = math.erf(3.0 / math.sqrt(2.0)), math.exp(-4.5) / math.sqrt(2.0 * math.pi)
    clipped = math.sqrt(inside - 6.0 * density + 9.0 * (1.0 - inside))
    np.testing.assert_allclose(unit.std(axis=0), clipped, rtol=0.03)
    np.testing.assert_allclose(np.abs(unit).max(axis=0), 3.0, rtol=1e-12)
    assert np.abs(unit.mean(axis=0)).max() < 0.05
    # Neither joints, kinds nor times have to do with each other.
    both = np.corrcoef(np.hstack([unit[1:], unit[:-1]]), rowvar=False)
    assert np.abs(both - np.eye(len(both))).max() < 0.05


def test_a_reset_and_the_seed_repeat_everything():
    given = {
        "encoder_resolution": 1e-4,
        "position_noise": 1e-4,
        "velocity_noise": 0.1,
        "velocity_source": "encoder",
        "velocity_filter_hz": 30.0,
        "state_delay": 2,
        "current_noise": 0.01,
    }
    q, v = path(50)
    sensors = sensing(**given)
    once, again = list(readings(sensors, q, v, v)), list(readings(sensors, q, v, v))
    others = list(readings(sensing(**given, imperfection_seed=1), q, v, v))
    np.testing.assert_array_equal(once, again)
    assert all((one != other).any() for one, other in zip(once, others, strict=True))
