# SPDX-License-Identifier: Apache-2.0
"""Margins for the change of acceleration while a torque is held, against the worst change."""

import numpy as np
import pytest
from adversary import advance, too_fast
from joint_cases import with_curves

from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.bounds.torque_margin import tightened, torque_margins
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

JOINTS = 200


def random_case(rng):
    """Limits of many joints that differ, a step, and jerks that leave something to brake with."""
    dt = 10.0 ** rng.uniform(-3.0, -2.0)
    a_min, a_max = -rng.uniform(2.0, 20.0, JOINTS), rng.uniform(2.0, 20.0, JOINTS)
    jerk = rng.uniform(0.0, 0.5, JOINTS) * np.minimum(-a_min, a_max) * 18.0 / dt
    half, v_max = rng.uniform(0.3, 3.0, JOINTS), rng.uniform(0.5, 4.0, JOINTS)
    names = [f"joint{i}" for i in range(JOINTS)]
    return JointLimits(names, -half, half, v_max, a_min, a_max), dt, jerk


def excess_in_units_of_d(rng, limits, dt, jerk, margins, factor, change=None):
    """The furthest that any joint goes beyond a limit, an adversary choosing everything.

    Where there is a `change`, accelerations differ from those before by at most that much.
    """
    velocity_error, position_error = jerk * dt**2 / 8.0, jerk * dt**3 / 12.0
    mean_error = jerk * dt / 36.0
    inner = tightened(limits, margins)
    if change is None:
        solver = BoundsSolver(inner, factor * dt, margins.acceleration, period=dt)
    else:
        solver = JerkBoundsSolver(inner, change / dt, dt, factor * dt, margins.with_jerk)
    q, v, a = np.zeros((3, JOINTS))
    target = rng.choice([-1.0, 1.0], JOINTS)
    excess = speed = -np.inf
    for _ in range(400):
        bounds = solver.bounds(q, v) if change is None else solver.bounds(q, v, a)
        # Mostly as fast as allowed towards a limit, now and then the other one.
        target *= np.where(rng.random(JOINTS) < 0.01, -1.0, 1.0)
        a = np.where(target > 0.0, bounds.upper, bounds.lower)
        outward = np.where(rng.random(JOINTS) < 0.8, target, rng.choice([-1.0, 1.0], JOINTS))
        q, v, low, high = advance(q, v, a, dt)
        beyond = np.maximum(high - limits.q_max, limits.q_min - low) + position_error
        excess = max(excess, np.max(beyond / position_error))
        too_far = q + np.sign(v) * position_error
        speed = max(speed, np.max(velocity_error + too_fast(limits, too_far, v)))
        q, v = q + position_error * outward, v + dt * mean_error * outward
    return excess, speed


@pytest.mark.parametrize(
    ("seed", "factor", "curved"),
    [(0, 1.0, False), (1, 2.0, False), (2, 3.3, False), (3, 2.0, True)],
)
def test_margins_keep_the_limits_against_the_worst_deviations(seed, factor, curved):
    rng = np.random.default_rng(seed)
    limits, dt, jerk = random_case(rng)
    limits = with_curves(limits, rng) if curved else limits
    excess, speed = excess_in_units_of_d(rng, limits, dt, jerk, torque_margins(jerk, dt), factor)
    assert excess <= -2.0  # in units of the position error of one step
    assert speed <= 1e-12  # rad/s


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_with_a_limited_jerk_the_margins_keep_the_limits_too(factor):
    rng = np.random.default_rng(4)
    limits, dt, jerk = random_case(rng)
    jerk, change = 0.1 * jerk, 10.0 ** rng.uniform(-0.5, 0.5, JOINTS)
    margins = torque_margins(jerk, dt)
    margins.position[:] /= 5.0  # D is enough
    excess, speed = excess_in_units_of_d(rng, limits, dt, jerk, margins, factor, change)
    assert excess <= 1e-9 and speed <= 1e-12


def test_without_the_position_margin_the_limits_break():
    rng = np.random.default_rng(0)
    limits, dt, jerk = random_case(rng)
    margins = torque_margins(jerk, dt)
    margins.position[:] = 0.0
    assert excess_in_units_of_d(rng, limits, dt, jerk, margins, 1.0)[0] > 1.0


def excess_of_held_torques(rng, limits, dt, jerk, held, rule):
    """The furthest, in rad and rad/s, that any joint goes beyond a limit while commands are lost.

    The adversary chooses the drift, as far as some acceleration leaves both means within the
    bounds, the error of the mean acceleration, and for how many periods a torque is held.

    Args:
        rule: whether the mean of the longest time is kept in the bounds, too.
    """
    margins = torque_margins(jerk, dt).held(held)
    solver = BoundsSolver(tightened(limits, margins), held * dt, margins.acceleration)
    later = 0.5 * (held - 1) * dt
    q, v = np.zeros(JOINTS), np.zeros(JOINTS)
    target = rng.choice([-1.0, 1.0], JOINTS)
    position = speed = -np.inf
    for _ in range(400):
        lower, upper, _ = solver.bounds(q, v)
        target *= np.where(rng.random(JOINTS) < 0.01, -1.0, 1.0)
        width = (upper - lower) / later
        drift = np.where(rng.random(JOINTS) < 0.8, target, rng.choice([-1.0, 0.0, 1.0], JOINTS))
        drift = np.clip(jerk * drift, -width, width)
        shift = later * drift if rule else np.zeros(JOINTS)
        a = np.where(target > 0.0, upper - np.maximum(shift, 0.0), lower - np.minimum(shift, 0.0))
        error = jerk / 36.0 * np.where(rng.random(JOINTS) < 0.8, target, -target)
        end = dt * rng.choice([1, held, rng.integers(1, held + 1)], JOINTS)
        for t in np.linspace(0.0, end, 6 * held + 1)[1:]:
            v_t = v + t * a + t * (t - dt) / 2.0 * drift + t**2 * error
            q_t = (
                q
                + t * v
                + t**2 / 2.0 * a
                + t**2 * (t / 6.0 - dt / 4.0) * drift
                + t**3 / 3.0 * error
            )
            position = max(position, np.maximum(q_t - limits.q_max, limits.q_min - q_t).max())
            speed = max(speed, too_fast(limits, q_t, v_t).max())
        q, v = q_t, v_t
    return position, speed


@pytest.mark.parametrize(
    ("seed", "held", "curved"), [(0, 2, False), (1, 3, False), (2, 9, False), (3, 3, True)]
)
def test_torques_that_are_held_for_several_periods_keep_the_limits(seed, held, curved):
    rng = np.random.default_rng(seed)
    limits, dt, jerk = random_case(rng)
    limits = with_curves(limits, rng) if curved else limits
    jerk *= 2.0 / (1.0 + held)
    position, speed = excess_of_held_torques(rng, limits, dt, jerk, held, rule=True)
    assert position <= 1e-12 and speed <= 1e-12


@pytest.mark.parametrize(("seed", "held"), [(0, 3), (1, 5)])
def test_without_bounds_of_their_mean_acceleration_they_do_not(seed, held):
    rng = np.random.default_rng(seed)
    limits, dt, jerk = random_case(rng)
    jerk *= 2.0 / (1.0 + held)
    position, speed = excess_of_held_torques(rng, limits, dt, jerk, held, rule=False)
    assert position > 1e-3 and speed > 1e-2
