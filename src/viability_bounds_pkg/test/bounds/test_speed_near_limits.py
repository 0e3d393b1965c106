# SPDX-License-Identifier: Apache-2.0
"""Speed limits that depend on position, beside a fine simulation, and in motion."""

import numpy as np
import pytest
from adversary import VIOLATION, bring_back, drive, states_in_kernel, states_outside
from imperfect_robot import ImperfectRobot, random_declarations
from joint_cases import column, with_curves

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver, viable_velocity_range

# q_min, q_max, v_max, a_min, a_max, dt; velocity_offset, deceleration_limit
HOLDING = {
    "enough braking": ((-0.5, 0.5, 2.0, -10.0, 12.0, 0.05), (0.5, 6.0)),
    "too little braking": ((-0.5, 0.5, 2.0, -6.0, 7.0, 0.02), (0.6, 17.0)),
    "too little towards one limit": ((-0.4, 0.8, 2.0, -6.0, 14.0, 0.05), (0.4, 10.0)),
    "long step": ((-0.5, 0.5, 2.0, -6.0, 14.0, 0.1), (0.05, 8.0)),
    "no offset": ((-0.5, 0.5, 2.0, -10.0, 12.0, 0.05), (0.0, 6.0)),
    "no offset, too little braking": ((-0.5, 0.5, 2.0, -6.0, 7.0, 0.05), (0.0, 17.0)),
    "no lower limit": ((-np.inf, 0.5, 2.0, -10.0, 7.0, 0.05), (0.3, 9.0)),
}
FAILING = {
    "narrow": ((-0.06, 0.06, 2.0, -10.0, 4.0, 0.1), (0.3, 8.0)),
    "too fast": ((-0.5, 0.5, 0.4, -10.0, 6.0, 0.1), (0.2, 9.0)),
    "weak one way": ((-0.2, 0.3, 3.0, -10.0, 1.0, 0.1), (0.2, 4.0)),
}
CASES = HOLDING | FAILING


def limits_of(name):
    (*limits, _), curve = CASES[name]
    return JointLimits(["joint"], *([value] for value in (*limits, *curve)))


def solver_of(name, **more):
    dt = CASES[name][0][-1]
    return BoundsSolver(limits_of(name), dt, period=dt, **more)


def simulated(limits, q, v, a, time):
    """Return which states can keep the upper limits after a time of constant acceleration.

    Nothing here comes from the theory: after that time the joint brakes as hard as it can, and
    speed and position are compared with their limits at 120 instants of each part.
    """
    kept = np.ones(q.shape, dtype=bool)
    end, speed = q + time * v + 0.5 * time**2 * a, v + time * a
    brake = float(limits.a_min[0])
    for q0, v0, a0, span in (
        (q, v, a, np.full(q.shape, time)),
        (end, speed, np.full(q.shape, brake), np.maximum(speed, 0.0) / -brake),
    ):
        for share in np.linspace(0.0, 1.0, 120):
            t = share * span
            at = q0 + t * v0 + 0.5 * t * t * a0
            highest = limits.velocities(at)[1]
            kept &= (v0 + t * a0 <= highest + 1e-9) & (at <= limits.q_max + 1e-9)
    return kept


@pytest.mark.parametrize("name", HOLDING)
def test_the_largest_acceleration_is_that_of_a_fine_simulation(name):
    limits, solver = limits_of(name), solver_of(name)
    assert solver.exact.all()
    q, v = states_in_kernel(solver, CASES[name][0], 100, np.random.default_rng(1))
    low, high = (np.full(q.shape, end) for end in (limits.a_min, limits.a_max))
    upper, time = solver.bounds(q, v).upper, float(solver.steps[0])
    free = simulated(limits, q, v, high, time)
    low[free] = high[free]
    for _ in range(18):
        middle = 0.5 * (low + high)
        kept = simulated(limits, q, v, middle, time)
        low, high = np.where(kept, middle, low), np.where(kept, high, middle)
    assert 0.05 < free.mean() < 0.95
    # The simulation tolerates 1e-9 rad/s, on the curve the way has that as a square.
    share = (upper - low) / (limits.a_max - limits.a_min)
    assert share.max() < 1e-5 and share.min() > -1e-3


@pytest.mark.parametrize("name", CASES)
def test_the_kernel_is_that_of_a_fine_simulation(name):
    limits, rng = limits_of(name), np.random.default_rng(2)
    q = column(rng.uniform(max(-0.5, limits.q_min[0]), limits.q_max[0], 1000))
    fastest = viable_velocity_range(q, limits)[1]
    rest = np.zeros_like(q)
    assert simulated(limits, q, fastest, rest, 0.0).all()
    beyond = fastest + 1e-4
    assert not simulated(limits, q, beyond, rest, 0.0).any()
    solver = solver_of(name)
    if name in HOLDING:
        assert solver.bounds(q, fastest).viable.all() and not solver.bounds(q, beyond).viable.any()
    assert (solver.velocity_range(q)[1] <= fastest + 1e-12).all()


@pytest.mark.parametrize("shortest", [1.0, 0.05], ids=["of full length", "cut short"])
@pytest.mark.parametrize("name", CASES)
def test_limits_hold_for_ever(name, shortest):
    """Steps that are cut short show the states within them."""
    solver, rng = solver_of(name), np.random.default_rng(3)
    q, v = states_in_kernel(solver, CASES[name][0], 600, rng)
    seen = drive(solver, q, v, 60, rng, shortest)
    assert seen.lost == 0
    assert seen.worst <= VIOLATION


@pytest.mark.parametrize("name", CASES)
def test_every_joint_returns(name):
    solver, rng = solver_of(name), np.random.default_rng(4)
    run = bring_back(solver, *states_outside(solver, CASES[name][0], 300, rng), 3000, rng)
    assert run.stray == 0
    assert max(run.again, run.speed) <= VIOLATION


def test_a_joint_comes_to_rest_where_the_speed_limit_ends():
    """FR3's second joint at 1 kHz, driven to either limit; it stands c^2 / (2 d) before it."""
    c, d = 0.25, 2.585
    limits = JointLimits(["j"], [-1.8361], [1.8361], [2.62], [-4.0], [4.0], [c], [d])
    solver, q, v = BoundsSolver(limits, 0.002, period=0.001), np.zeros(2), np.zeros(2)
    for _ in range(6000):
        bounds = solver.bounds(column(q), column(v))
        a = np.array([bounds.upper[0, 0], bounds.lower[1, 0]])
        q, v = q + 1e-3 * v + 0.5e-6 * a, v + 1e-3 * a
    np.testing.assert_allclose(1.8361 - np.abs(q), c * c / (2.0 * d), rtol=1e-3)
    np.testing.assert_allclose(v, 0.0, atol=1e-6)


def test_between_its_last_place_of_rest_and_the_limit_a_joint_may_only_move_away():
    solver = solver_of("enough braking")
    q, v = column([0.495, 0.495, 0.495, 0.505]), column([0.0, -0.3, 0.2, 0.0])
    upper, viable = solver.bounds(q, v).upper[:, 0], solver.bounds(q, v).viable[:, 0]
    np.testing.assert_allclose(upper[:3], [0.0, 6.0, -4.0])  # at rest when the step ends
    assert upper[3] < 0.0  # beyond the limit it comes back
    assert viable.tolist() == [True, True, False, False]


MISTAKES = {"errors of the states": {}, "late, and missed": {"delay": 2, "missed_deadlines": 1}}


@pytest.mark.parametrize("kind", [*MISTAKES, "motors with a lag"])
def test_limits_hold_within_what_is_declared(kind):
    rng = np.random.default_rng(5)
    limits, declared = random_declarations(rng, **MISTAKES.get(kind, {"motor_bandwidth": 10.0}))
    seen = ImperfectRobot(with_curves(limits, rng), declared, 0.003, rng).run(200).seen
    assert seen.lost == 0
    assert seen.worst <= VIOLATION


@pytest.mark.parametrize("kind", MISTAKES)
def test_half_of_the_margin_of_the_velocity_does_not_keep_them(kind):
    rng = np.random.default_rng(6)
    limits, declared = random_declarations(rng, **MISTAKES[kind])
    robot = ImperfectRobot(with_curves(limits, rng), declared, 0.003, rng, shares=(1.0, 0.5))
    assert robot.run(200).seen.worst > 1e-4


@pytest.mark.parametrize(("w", "error"), [(0.0, 0.0), (1.0, 0.02)])
def test_the_condition_of_discrete_time_counts_with_the_speed_limit(w, error):
    dt, a, c, d = 0.1, 10.0, 0.3, 6.0
    b = d + 2.0 * w + 2.0 * error / dt
    room = 0.5 * dt**2 * b * (1.0 + 2.0 * c / (d * dt) + b / d) + dt * error + c * c / d

    def holds(length):
        limits = JointLimits(["j"], [0.0], [length], [9.0], [-a], [a], [c], [d])
        try:
            return bool(BoundsSolver(limits, dt, [w], velocity_error=[error]).exact.all())
        except JointLimitsError:
            return False

    assert holds(1.001 * room) and not holds(0.999 * room)
