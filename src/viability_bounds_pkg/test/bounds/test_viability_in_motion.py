# SPDX-License-Identifier: Apache-2.0
"""The bounds keep the limits: in motion, under disturbances, and on the way back from outside."""

from contextlib import suppress

import numpy as np
import paper_algorithms
import pytest
from adversary import (
    POLICIES,
    VIOLATION,
    Violations,
    advance,
    bring_back,
    drive,
    states_in_kernel,
    states_outside,
)
from joint_cases import (
    CASES,
    FAILING,
    FAST_LOOP,
    HOLDING,
    ODD_STEPS,
    column,
    discrete_time_condition,
    one_joint,
    states_of,
)

from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

CASES = {**CASES, **FAST_LOOP, **ODD_STEPS}

MOTIONS = 400
STEPS = 50


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", CASES)
def test_limits_hold_for_ever(name, policy):
    """In all, 2 million joint-steps; `bash scripts/reproduce.sh exactness` makes far more."""
    case = CASES[name]
    solver = BoundsSolver(one_joint(*case[:5]), case[5])
    rng = np.random.default_rng(1)
    q, v = states_in_kernel(solver, case, MOTIONS, rng)
    kept = drive(solver, q, v, policy, STEPS, rng)
    assert kept.lost == 0
    assert max(kept.position, kept.speed) <= VIOLATION


@pytest.mark.parametrize("name", FAILING)
def test_algorithm_3_breaks_the_limits_where_the_discrete_time_condition_fails(name):
    """Which is why the braking is reduced there, and shows that this harness can tell."""
    case = FAILING[name]
    limits, dt = one_joint(*case[:5]), case[5]
    worst = -np.inf
    for policy in POLICIES.values():
        rng = np.random.default_rng(1)
        q, _ = (column(x) for x in states_of(case, 200, seed=2))
        v = np.zeros_like(q)
        seen = Violations(limits)
        for _ in range(STEPS):
            lower, upper = paper_algorithms.combined_bounds(q, v, limits, dt)
            lower, upper = (np.clip(b, limits.a_min, limits.a_max) for b in (lower, upper))
            a = policy(q, v, np.minimum(lower, upper), upper, limits, rng)
            q, v, low, high = advance(q, v, a, dt)
            seen.see(low, high, v)
        worst = max(worst, seen.worst)
    assert worst > 1e-3 * min(case[2], case[1] - case[0])


@pytest.mark.parametrize("name", CASES)
def test_limits_hold_for_any_shorter_period(name):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    solver = BoundsSolver(limits, dt)
    rng = np.random.default_rng(3)
    for policy in POLICIES.values():
        q, v = states_in_kernel(solver, case, 100, rng)
        seen = Violations(limits)
        for _ in range(60):
            lower, upper, viable = solver.bounds(q, v)
            assert viable.all()
            a = policy(q, v, lower, upper, limits, rng)
            q, v, low, high = advance(q, v, a, dt * rng.uniform(0.05, 1.0))
            seen.see(low, high, v)
        assert seen.worst <= VIOLATION


def solvers(case, margin, factors):
    """Return the bounds of a joint for steps of several times its period; some steps have none."""
    limits, dt = one_joint(*case[:5]), case[5]
    for factor in factors:
        with suppress(JointLimitsError):
            yield BoundsSolver(limits, factor * dt, [margin], period=dt)


JUST = "condition (11) just holds"  # and with a margin it does not


@pytest.mark.parametrize(
    ("name", "share"),
    [(name, w) for name in (*HOLDING, "1 kHz") for w in (0.0, 0.02) if w == 0.0 or name != JUST],
)
def test_limits_hold_while_the_step_changes(name, share):
    """A state that suits a short step may allow nothing that can be held for a long one."""
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    w = share * min(-case[3], case[4])
    found = list(solvers(case, w, (1.0, 1.5, 4.0, 30.0, 300.0)))
    assert len(found) >= 2
    for policy in POLICIES.values():
        rng = np.random.default_rng(10)
        q, v = states_in_kernel(found[0], case, 100, rng)
        seen = Violations(limits)
        for _ in range(100):
            lower, upper, _ = found[rng.integers(len(found))].bounds(q, v)
            assert found[0].bounds(q, v).viable.all()
            a = policy(q, v, lower, upper, limits, rng) + rng.choice([-w, w], v.shape)
            q, v, low, high = advance(q, v, a, dt)
            seen.see(low, high, v)
        assert seen.worst <= VIOLATION


def test_the_step_is_as_long_as_the_discrete_time_condition_allows():
    limits, dt = one_joint(-2.9, 2.9, 2.6, -15.0, 15.0), 0.004
    long = BoundsSolver(limits, 105.0 * dt, period=dt)
    assert dt <= long.steps[0] < 105.0 * dt
    assert long.exact.all()
    assert discrete_time_condition(limits, long.steps[0])
    assert not discrete_time_condition(limits, 2.0 * long.steps[0])
    assert BoundsSolver(limits, 2.0 * dt, period=dt).steps == 2.0 * dt  # it suits all states
    case = CASES[JUST]
    limits, dt = one_joint(*case[:5]), case[5]
    assert BoundsSolver(limits, 1.5 * dt, period=dt).steps == dt  # no shorter than they act for


DISTURBANCES = {
    "pushes up": lambda v, sign, w, rng: w + 0.0 * v,
    "pushes down": lambda v, sign, w, rng: -w + 0.0 * v,
    "pushes on": lambda v, sign, w, rng: w * np.sign(v),
    "pushes where it is told to go": lambda v, sign, w, rng: w * sign,
    "changes within the step": lambda v, sign, w, rng: w * rng.choice([-1.0, 1.0], v.shape),
    "any": lambda v, sign, w, rng: rng.uniform(-w, w, v.shape),
}


@pytest.mark.parametrize("period", [1.0, 0.5])
@pytest.mark.parametrize("share", [0.02, 0.3])
@pytest.mark.parametrize("name", CASES)
def test_a_margin_holds_against_any_disturbance(name, share, period):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    w = share * min(-case[3], case[4])
    try:
        solver = BoundsSolver(limits, dt, [w], period=period * dt)
    except JointLimitsError:
        # Then indeed the disturbance alone can throw the joint out within a few steps.
        assert w * dt > 0.1 * min(case[2], (case[1] - case[0]) / dt)
        return
    for policy in POLICIES.values():
        for disturbance in DISTURBANCES.values():
            rng = np.random.default_rng(5)
            q, v = states_in_kernel(solver, case, 40, rng)
            seen = Violations(limits)
            for _ in range(20):
                lower, upper, viable = solver.bounds(q, v)
                assert viable.all()
                assert (upper >= lower).all()
                a = policy(q, v, lower, upper, limits, rng)
                sign = np.where(a > 0.5 * (lower + upper), 1.0, -1.0)
                for part in (0.4, 0.1, 0.5):
                    true = a + disturbance(v, sign, w, rng)
                    q, v, low, high = advance(q, v, true, part * period * dt)
                    seen.see(low, high, v)
            assert seen.worst <= VIOLATION


def test_without_a_margin_the_disturbance_breaks_the_limits():
    case = HOLDING["figure 3"]
    limits, dt = one_joint(*case[:5]), case[5]
    solver = BoundsSolver(limits, dt)
    q, v = states_in_kernel(solver, case, 100, np.random.default_rng(6))
    seen = Violations(limits)
    for _ in range(20):
        q, v, low, high = advance(q, v, solver.bounds(q, v).upper + 0.2, dt)
        seen.see(low, high, v)
    assert seen.worst > 1e-3


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", [name for name in CASES if name != "tiny step"])
@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_every_joint_returns(name, policy, margin):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    w = margin * min(-case[3], case[4])
    try:
        solver = BoundsSolver(limits, dt, [w])
    except JointLimitsError:
        return
    rng = np.random.default_rng(7)
    q, v = states_outside(solver, case, 300, rng)
    assert q.size == 300
    run = bring_back(solver, q, v, policy, 3000, rng)
    assert run.stray == 0
    assert max(run.again, run.speed) <= VIOLATION
    if discrete_time_condition(limits, dt, [w]):
        assert run.position <= VIOLATION


def test_return_to_a_range_that_one_step_may_cross():
    """It neither rushes through to the other side nor breaks its speed limit to avoid that."""
    limits, dt = one_joint(-0.5, 0.5, 2.0, -12.0, 9.0), 10.0
    solver = BoundsSolver(limits, dt)
    q, v = column([0.51, 0.51, -5.0, 3.0]), column([-2.07, 2.0, 2.0, -1.0])
    for policy in POLICIES:
        run = bring_back(solver, q, v, policy, 30, np.random.default_rng(0))
        assert run.stray == 0
        assert run.speed <= VIOLATION


def test_a_step_beyond_the_limit_by_rounding_is_no_emergency():
    limits = one_joint(-1.0, 1.0, 2.0, -10.0, 10.0)
    lower, upper, viable = BoundsSolver(limits, 0.01).bounds([np.nextafter(1.0, 2.0)], [0.0])
    assert viable[0]
    assert upper[0] == pytest.approx(0.0, abs=1e-10)
    assert lower[0] == -10.0
