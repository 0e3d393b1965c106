# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest

from sim_bridge.hardware import Imperfections, Sensing
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import parameter_table

N = 3
DT = 2e-3
TORQUE_MAX = np.array([80.0, 40.0, 10.0])
ZERO = np.zeros(N)


def imperfections(**given):
    """Return those given; of joints, the same for each."""
    rows = {row.name: row for row in parameter_table(Imperfections)}
    values = {row.name: np.zeros(N) for row in rows.values() if row.per_joint}
    values |= {k: np.full(N, v) if rows[k].per_joint else v for k, v in given.items()}
    return Imperfections(**values)


def sensing(**given):
    return Sensing(imperfections(**given), TORQUE_MAX, DT)


def path(count, seed=0):
    """Return a motion: positions and velocities, shape (count, N) each."""
    t = DT * np.arange(count)[:, None]
    rate = np.array([3.0, 7.0, 11.0]) + seed
    return np.sin(rate * t), rate * np.cos(rate * t)


def readings(sensors, q, v, effort=None):
    """Return what is reported of a motion: positions, velocities, efforts."""
    tau = np.zeros_like(q) if effort is None else effort
    first = sensors.reset(q[0], v[0], tau[0])
    rest = [sensors.read(*each) for each in zip(q[1:], v[1:], tau[1:], strict=True)]
    return (np.array(each) for each in zip(first, *rest, strict=True))


def test_without_imperfections_readings_are_the_truth():
    q, v = path(50)
    tau = v.copy()
    for read, true in zip(readings(sensing(), q, v, tau), (q, v, tau), strict=True):
        np.testing.assert_array_equal(read, true)


def test_encoders_report_whole_steps_at_most_half_a_step_off():
    resolution = np.array([1e-3, 0.0, 3e-4])
    given = replace(imperfections(), encoder_resolution=resolution)
    encoders = Sensing(given, TORQUE_MAX, DT)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (5000, N))
    read = np.array([encoders.encoders(each) for each in q])
    np.testing.assert_array_equal(read[:, 1], q[:, 1])
    for j in (0, 2):
        steps = read[:, j] / resolution[j]
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
        error = np.abs(read[:, j] - q[:, j])
        assert error.max() <= 0.5 * resolution[j] * (1.0 + 1e-9)
        assert error.max() > 0.49 * resolution[j]


def test_noise_comes_before_rounding():
    q, v = np.full((2000, N), 0.3), np.zeros((2000, N))
    read, *_ = readings(sensing(encoder_resolution=1e-3, position_noise=6e-4), q, v)
    steps = read / 1e-3
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert set(np.rint(steps[:, 0] - 300.0)) == {-2.0, -1.0, 0.0, 1.0, 2.0}
    assert np.abs(read - q).max() <= 0.5e-3 + 3.0 * 6e-4


def test_velocity_from_encoders_is_the_difference_over_a_period():
    q, v = path(400)
    read, velocity, _ = readings(sensing(encoder_resolution=1e-3, velocity_source="encoder"), q, v)
    rounded = 1e-3 * np.round(q / 1e-3)
    np.testing.assert_allclose(read, rounded, atol=1e-12)
    np.testing.assert_allclose(velocity[1:], np.diff(rounded, axis=0) / DT, atol=1e-9)
    np.testing.assert_array_equal(velocity[0], v[0])
    # One step more or less, and the velocity half a period ago.
    middle = np.diff(q, axis=0) / DT
    assert np.abs(velocity[1:] - middle).max() <= 1e-3 / DT + 1e-9


def test_the_drive_filters_velocities_and_nothing_else():
    q, v = np.zeros((40, N)), np.ones((40, N))
    v[0] = 0.0
    read, velocity, effort = readings(sensing(velocity_filter_hz=20.0), q, v, v)
    t = DT * np.arange(40)[:, None]
    expected = np.where(t > 0.0, 1.0 - np.exp(-2.0 * math.pi * 20.0 * t), 0.0)
    np.testing.assert_allclose(velocity, expected * np.ones(N), rtol=1e-12)
    np.testing.assert_array_equal(read, q)
    np.testing.assert_array_equal(effort, v)


@pytest.mark.parametrize("delay", [1, 2, 5])
def test_a_delayed_state_is_that_of_so_many_periods_ago(delay):
    q, v = path(30)
    tau = 2.0 * q
    exact = readings(sensing(state_delay=delay), q, v, tau)
    for read, true in zip(exact, (q, v, tau), strict=True):
        np.testing.assert_array_equal(read[delay:], true[:-delay])
        np.testing.assert_array_equal(read[:delay], np.tile(true[0], (delay, 1)))


def test_noise_of_velocity_and_effort_is_added_to_what_is_reported():
    q, v = path(4000)
    _, velocity, effort = readings(sensing(velocity_noise=0.05, current_noise=0.01), q, v, v)
    assert np.abs(velocity - v).max() <= 0.15 + 1e-12
    np.testing.assert_allclose((velocity - v).std(axis=0), 0.05, rtol=0.05)
    assert (np.abs(effort - v) <= 0.03 * TORQUE_MAX + 1e-12).all()
    np.testing.assert_allclose((effort - v).std(axis=0), 0.01 * TORQUE_MAX, rtol=0.05)


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
    once = list(readings(sensors, q, v, v))
    readings_of_others = list(readings(sensing(**given, imperfection_seed=1), q, v, v))
    for read, again, other in zip(
        once, readings(sensors, q, v, v), readings_of_others, strict=True
    ):
        np.testing.assert_array_equal(read, again)
        assert (read != other).any()


def test_what_is_on_is_told_by_name():
    assert imperfections().names == ()
    assert not imperfections(missed_in_row=9, imperfection_seed=4).names
    some = imperfections(velocity_source="encoder", state_delay=1, torque_constant_error=-0.02)
    assert some.names == ("velocity_source", "state_delay", "torque_constant_error")
    assert some.of_motors
    assert not imperfections(command_delay=1, encoder_resolution=1e-4).of_motors


@pytest.mark.parametrize("cutoff", [50.0, 60.0])
def test_a_filter_above_half_the_rate_is_refused(cutoff):
    imperfections(velocity_filter_hz=cutoff).check_rate(1000.0)
    with pytest.raises(SettingError, match=rf"velocity_filter_hz' is {cutoff:g};.*rate_hz, 50;"):
        imperfections(velocity_filter_hz=cutoff).check_rate(100.0)
