"""Bounds against the paper's algorithms, against problem (4), and in motion."""

import os

import brute_force
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viability_bounds_pkg import paper_algorithms
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import (
    BoundsSolver,
    acceleration_bounds,
    condition_11,
    viable_velocity_range,
)

EXACT = 1e-6
"""Largest error of a bound, as a part of the acceleration range."""

EDGE = 1e-6
"""Distance from the edge of the kernel within which states are not told apart, see `Extremes`."""

VIOLATION = 1e-9
"""Largest violation in motion, rad and rad/s."""


def one_joint(q_min, q_max, v_max, a_min, a_max):
    return JointLimits(["joint"], [q_min], [q_max], [v_max], [a_min], [a_max])


def column(values):
    return np.asarray(values, dtype=float).reshape(-1, 1)


# Joints and steps: (q_min, q_max, v_max, a_min, a_max, dt).
HOLDING = {
    "figure 3": (-0.5, 0.5, 2.0, -10.0, 10.0, 0.1),
    "asymmetric": (-0.4, 0.8, 2.0, -6.0, 14.0, 0.1),
    "asymmetric, mirrored": (-0.8, 0.4, 2.0, -14.0, 6.0, 0.1),
    "condition (11) just holds": (-0.05, 0.05, 1.0, -10.0, 10.0, 0.1),
    "no lower limit": (-np.inf, 0.5, 2.0, -10.0, 7.0, 0.1),
    "continuous": (-np.inf, np.inf, 2.0, -10.0, 7.0, 0.5),
}
FAILING = {
    "too fast": (-0.5, 0.5, 0.6, -10.0, 6.0, 0.1),
    "too fast, one limit": (-np.inf, 0.5, 0.4, -10.0, 6.0, 0.1),
    "narrow": (-0.03, 0.03, 2.0, -10.0, 10.0, 0.1),
    "narrow and asymmetric": (-0.06, 0.06, 2.0, -10.0, 4.0, 0.1),
    "weak one way": (-0.2, 0.3, 3.0, -10.0, 1.0, 0.1),
    "narrow and too fast": (-0.02, 0.02, 0.6, -10.0, 10.0, 0.1),
    "far too narrow": (-0.002, 0.002, 2.0, -10.0, 8.0, 0.1),
}
CASES = {**HOLDING, **FAILING}


def states_of(case, count, seed):
    """Return random states, more than enough of them viable, some on the limits."""
    q_min, q_max, v_max, a_min, a_max, dt = case
    rng = np.random.default_rng(seed)
    low = q_min if np.isfinite(q_min) else -1.0
    high = q_max if np.isfinite(q_max) else 1.0
    # No speed that crosses the range within a quarter of a step is viable.
    fastest = min(v_max, 4.0 * (q_max - q_min) / dt)
    q, v = rng.uniform(low, high, count), rng.uniform(-fastest, fastest, count)
    kind = rng.integers(0, 20, count)
    q[kind == 0], q[kind == 1] = low, high
    v[kind == 2], v[kind == 3] = fastest, -fastest
    v[kind == 4] = 0.0
    return q, v


@pytest.mark.parametrize("name", HOLDING)
def test_condition_11_holds(name):
    case = HOLDING[name]
    limits = one_joint(*case[:5])
    assert condition_11(limits, case[5]).all()
    assert BoundsSolver(limits, case[5]).exact.all()


@pytest.mark.parametrize("name", FAILING)
def test_condition_11_fails(name):
    case = FAILING[name]
    assert not condition_11(one_joint(*case[:5]), case[5]).any()


def test_condition_11_of_the_paper():
    # v_max >= dt a and q_max - q_min >= dt^2 a, for a = 10 and dt = 0.1.
    def holds(length, v_max):
        return bool(condition_11(one_joint(0.0, length, v_max, -10.0, 10.0), 0.1)[0])

    assert holds(0.1, 1.0)
    assert not holds(0.0999999, 1.0)
    assert not holds(0.1, 0.9999999)


@pytest.mark.parametrize("name", HOLDING)
@pytest.mark.parametrize("steps_per_second", [10, 100, 1000])
def test_agrees_with_algorithm_3(name, steps_per_second):
    case = (*HOLDING[name][:5], 1.0 / steps_per_second)
    limits = one_joint(*case[:5])
    q, v = (column(x) for x in states_of(case, 20_000, seed=1))
    bounds = acceleration_bounds(q, v, limits, case[5])
    paper = paper_algorithms.combined_bounds(q, v, limits, case[5])
    assert bounds.viable.mean() > 0.5
    scale = limits.a_max - limits.a_min
    # Where the room is no more than rounding, the paper's v^2 / (2 room) is, too.
    room = np.minimum(limits.q_max - q, q - limits.q_min)
    fair = bounds.viable & (room > 1e-9)
    assert np.abs(bounds.upper - paper.upper)[fair].max() <= 1e-9 * scale
    assert np.abs(bounds.lower - paper.lower)[fair].max() <= 1e-9 * scale


def check_against_brute_force(case, count, seed, steps, block=30):
    """Compare viability and bounds with problem (4); return the number of viable states."""
    limits = one_joint(*case[:5])
    q, v = states_of(case, count, seed)
    bounds = acceleration_bounds(column(q), column(v), limits, case[5])
    scale = case[4] - case[3]
    viable_states = 0
    for first in range(0, count, block):
        rows = slice(first, first + block)
        ours = [part[rows, 0] for part in bounds]
        outer, inner = (
            brute_force.extreme_accelerations(
                brute_force.Joint(*case), q[rows], v[rows], steps, end_at_rest
            )
            for end_at_rest in (False, True)
        )
        for reference in (outer, inner):
            clear = np.abs(reference.margin) > EDGE
            undecided = np.isnan(reference.margin) | (clear & ours[2] & np.isnan(reference.upper))
            assert undecided.sum() <= 1
            assert np.array_equal(ours[2][clear], (reference.margin >= 0.0)[clear])
        both = ours[2] & np.isfinite(inner.lower) & np.isfinite(outer.lower)
        viable_states += both.sum()
        for reference in (outer, inner):
            assert np.abs(ours[0] - reference.lower)[both].max(initial=0.0) <= EXACT * scale
            assert np.abs(ours[1] - reference.upper)[both].max(initial=0.0) <= EXACT * scale
    return viable_states


HORIZON = {"continuous": 3, "weak one way": 32}
"""Steps within which the joint can come to rest, where it is not 9."""


@pytest.mark.parametrize("name", CASES)
def test_agrees_with_brute_force(name):
    count = 120 if name in HOLDING else 30
    steps = HORIZON.get(name, 9)
    assert check_against_brute_force(CASES[name], count, 2, steps) > 0.2 * count


@pytest.mark.skipif("BRUTE_FORCE_STATES" not in os.environ, reason="takes an hour")
def test_agrees_with_brute_force_everywhere():
    """Random joints, asymmetric, (11) holding or not: BRUTE_FORCE_STATES viable states."""
    wanted = int(os.environ["BRUTE_FORCE_STATES"])
    rng = np.random.default_rng(int(os.environ.get("BRUTE_FORCE_SEED", "3")))
    found = failing = 0
    while found < wanted:
        dt = 10.0 ** rng.uniform(-3.0, 0.0)
        a_min, a_max = -rng.uniform(2.0, 20.0), rng.uniform(2.0, 20.0)
        unit = max(-a_min, a_max) * dt
        v_max = unit * rng.uniform(0.3, 3.0)
        length = unit * dt * 10.0 ** rng.uniform(-1.5, 1.5)
        q_min = rng.uniform(-1.0, 1.0) * length
        case = (q_min, q_min + length, v_max, a_min, a_max, dt)
        holds = bool(condition_11(one_joint(*case[:5]), dt)[0])
        steps = 8 + int(np.ceil(v_max / (min(-a_min, a_max) * dt)))
        number = check_against_brute_force(case, 300 if holds else 60, rng.integers(2**31), steps)
        found += number
        failing += 0 if holds else number
    print(f"{found} viable states, {failing} of them where condition (11) fails")
