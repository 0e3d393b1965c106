# SPDX-License-Identifier: Apache-2.0
"""The bounds keep the limits, in motion and on the way back from outside."""

import numpy as np
import paper_algorithms
import pytest
from adversary import (
    VIOLATION,
    Violations,
    advance,
    bring_back,
    choose,
    drive,
    states_in_kernel,
    states_outside,
)
from joint_cases import CASES, ODD_STEPS, column, condition_holds, one_joint, solver_of, states_of

from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

CASES = {**CASES, **ODD_STEPS}


@pytest.mark.parametrize("shortest", [1.0, 0.05], ids=["of full length", "cut short"])
@pytest.mark.parametrize("name", CASES)
def test_limits_hold_for_ever(name, shortest):
    """In steps of the length that the bounds are for, or of any shorter one."""
    solver, rng = solver_of(CASES[name]), np.random.default_rng(1)
    seen = drive(solver, *states_in_kernel(solver, CASES[name], 600, rng), 50, rng, shortest)
    assert seen.lost == 0
    assert seen.worst <= VIOLATION


@pytest.mark.parametrize("name", ["too fast", "narrow"])
def test_algorithm_3_breaks_the_limits_where_the_discrete_time_condition_fails(name):
    """Which is why the braking is reduced there, and shows that these tests can fail."""
    case = CASES[name]
    limits, dt, rng = one_joint(*case[:5]), case[5], np.random.default_rng(1)
    q, _ = states_of(case, 600, seed=2)
    v, seen = np.zeros_like(q), Violations(limits)
    for _ in range(50):
        lower, upper = paper_algorithms.combined_bounds(q, v, limits, dt)
        lower, upper = (np.clip(b, limits.a_min, limits.a_max) for b in (lower, upper))
        a = choose(q, v, np.minimum(lower, upper), upper, limits, rng)
        q, v, low, high = advance(q, v, a, dt)
        seen.see(low, high, q, v)
    assert seen.worst > 1e-3 * min(case[2], case[1] - case[0])


@pytest.mark.parametrize(("name", "share"), [("asymmetric", 0.02), ("1 kHz", 0.0)])
def test_limits_hold_while_the_step_changes(name, share):
    """A state that suits a short step may allow nothing that can be held for a long one."""
    *limits, dt = case = CASES[name]
    limits, w, rng = one_joint(*limits), share * min(-case[3], case[4]), np.random.default_rng(10)
    solvers = [
        BoundsSolver(limits, factor * dt, [w], period=dt) for factor in (1.0, 1.5, 4.0, 30.0)
    ]
    q, v = states_in_kernel(solvers[0], case, 600, rng)
    seen = Violations(limits)
    for _ in range(100):
        assert solvers[0].bounds(q, v).viable.all()
        lower, upper, _ = solvers[rng.integers(4)].bounds(q, v)
        a = choose(q, v, lower, upper, limits, rng) + rng.choice([-w, w], v.shape)
        q, v, low, high = advance(q, v, a, dt)
        seen.see(low, high, q, v)
    assert seen.worst <= VIOLATION


@pytest.mark.parametrize("margin", [0.0, 0.05])
@pytest.mark.parametrize("name", [name for name in CASES if name != "tiny step"])
def test_every_joint_returns(name, margin):
    case, rng = CASES[name], np.random.default_rng(7)
    try:
        solver = solver_of(case, margin)
    except JointLimitsError:
        return
    run = bring_back(solver, *states_outside(solver, case, 600, rng), 3000, rng)
    assert run.stray == 0
    assert max(run.again, run.speed) <= VIOLATION
    # Where (11) fails, braking at the limit would throw a joint against the other limit.
    if condition_holds(solver.limits, case[5], [margin * min(-case[3], case[4])]):
        assert run.position <= VIOLATION


def test_return_to_a_range_that_one_step_may_cross():
    """It neither rushes through to the other side nor breaks its speed limit to avoid that."""
    solver = solver_of(CASES["huge step"])
    q, v = column([0.51, 0.51, -5.0, 3.0]), column([-2.07, 2.0, 2.0, -1.0])
    run = bring_back(solver, np.repeat(q, 6, 0), np.repeat(v, 6, 0), 30, np.random.default_rng(0))
    assert run.stray == 0
    assert run.speed <= VIOLATION
