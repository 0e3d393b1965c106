# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from viability_bounds_pkg.bounds.torque_margin import tightened, torque_margins
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

JOINTS = 200
STEPS = 400


def random_case(rng):
    """Limits of many joints that differ, a step, and jerks that leave something to brake with."""
    dt = 10.0 ** rng.uniform(-3.0, -2.0)
    a_min, a_max = -rng.uniform(2.0, 20.0, JOINTS), rng.uniform(2.0, 20.0, JOINTS)
    jerk = rng.uniform(0.0, 0.5, JOINTS) * np.minimum(-a_min, a_max) * 18.0 / dt
    half = rng.uniform(0.3, 3.0, JOINTS)
    limits = JointLimits(
        [f"joint{i}" for i in range(JOINTS)],
        -half,
        half,
        rng.uniform(0.5, 4.0, JOINTS),
        a_min,
        a_max,
    )
    return limits, dt, jerk


def excess_in_units_of_d(rng, limits, dt, jerk, margins, factor):
    """The furthest that any joint goes beyond a limit, an adversary choosing everything."""
    velocity_error, position_error = jerk * dt**2 / 8.0, jerk * dt**3 / 12.0
    mean_error = jerk * dt / 36.0
    inner = tightened(limits, margins)
    solver = BoundsSolver(inner, factor * dt, margins.acceleration, period=dt)
    q, v = np.zeros(JOINTS), np.zeros(JOINTS)
    target = rng.choice([-1.0, 1.0], JOINTS)
    excess = speed = -np.inf
    for _ in range(STEPS):
        bounds = solver.bounds(q, v)
        # Mostly as fast as allowed towards a limit, now and then the other one.
        target *= np.where(rng.random(JOINTS) < 0.01, -1.0, 1.0)
        a = np.where(target > 0.0, bounds.upper, bounds.lower)
        outward = np.where(rng.random(JOINTS) < 0.8, target, rng.choice([-1.0, 1.0], JOINTS))
        turn = np.clip(np.divide(-v, a, out=np.zeros(JOINTS), where=a != 0.0), 0.0, dt)
        ends = q + dt * v + 0.5 * dt**2 * a
        extremes = q + turn * v + 0.5 * turn**2 * a
        high = np.maximum(ends, extremes) + position_error - limits.q_max
        low = limits.q_min - np.minimum(ends, extremes) + position_error
        excess = max(excess, np.max(np.maximum(high, low) / position_error))
        speed = max(speed, np.max(np.abs(v + dt * a) + velocity_error - limits.v_max))
        q = ends + position_error * outward
        v = v + dt * (a + mean_error * outward)
    return excess, speed


@pytest.mark.parametrize("factor", [1.0, 2.0, 3.3])
@pytest.mark.parametrize("seed", range(4))
def test_margins_keep_the_limits_against_the_worst_deviations(seed, factor):
    rng = np.random.default_rng(seed)
    limits, dt, jerk = random_case(rng)
    excess, speed = excess_in_units_of_d(rng, limits, dt, jerk, torque_margins(jerk, dt), factor)
    assert excess <= -2.0  # in units of the position error of one step
    assert speed <= 1e-12  # rad/s


def test_without_the_position_margin_the_limits_break():
    rng = np.random.default_rng(0)
    limits, dt, jerk = random_case(rng)
    margins = torque_margins(jerk, dt)
    margins.position[:] = 0.0
    excess, _ = excess_in_units_of_d(rng, limits, dt, jerk, margins, 1.0)
    assert excess > 1.0


def test_margins_shrink_with_the_step():
    jerk = np.array([100.0, 2000.0])
    coarse, fine = torque_margins(jerk, 0.01), torque_margins(jerk, 0.001)
    np.testing.assert_allclose(coarse.acceleration / fine.acceleration, 10.0)
    np.testing.assert_allclose(coarse.velocity / fine.velocity, 100.0)
    np.testing.assert_allclose(coarse.position / fine.position, 1000.0)


def test_deviations_are_those_of_constant_jerk():
    J, dt = 300.0, 0.01
    t = np.linspace(0.0, dt, 10001)
    velocity = J * (t**2 - t * dt) / 2.0
    position = J * (t**3 / 6.0 - t**2 * dt / 4.0)
    E, D = np.array([J]) * dt**2 / 8.0, np.array([J]) * dt**3 / 12.0
    np.testing.assert_allclose(E[0], np.abs(velocity).max(), rtol=1e-6)
    np.testing.assert_allclose(D[0], np.abs(position).max(), rtol=1e-6)
