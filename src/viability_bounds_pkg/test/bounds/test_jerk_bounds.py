# SPDX-License-Identifier: Apache-2.0
"""Bounds of accelerations that change by a limited amount in each step."""

import math
from dataclasses import replace

import numpy as np
import pytest
from adversary import VIOLATION, Violations, advance, choose
from brute_force import EDGE, EXACT, extreme_accelerations
from joint_cases import HOLDING, column, one_joint, states_of

from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

STEPS, STATES, JOINTS = 100, 200, 50
"""One million of steps in all."""


def random_joint(rng, ranges=3):
    """Return limits, jerk and control period of a joint that stops within some hundred steps.

    Its acceleration goes from zero to its limit in a tenth of a step to 30 steps.

    Args:
        rng: random generator.
        ranges: kinds of ranges: both limits, and if there are more of them upper only, or none.
    """
    dt = 10.0 ** rng.uniform(-3.0, -1.0)
    a_min, a_max = -rng.uniform(2.0, 20.0), rng.uniform(2.0, 20.0)
    most, ramp = max(-a_min, a_max), 10.0 ** rng.uniform(-1.0, 1.5)
    v_max = most * dt * (1.0 + ramp) * rng.uniform(0.3, 5.0)
    q_min = rng.uniform(-1.0, 1.0)
    q_max = q_min + v_max**2 / most * 10.0 ** rng.uniform(-1.0, 1.0)
    without = rng.integers(0, ranges)
    q_min, q_max = (-math.inf if without else q_min), (math.inf if without == 2 else q_max)
    return one_joint(q_min, q_max, v_max, a_min, a_max), most / dt / ramp, dt


def states(limits, rng, count, beyond=0.0):
    """Return columns of positions, velocities and accelerations, some of them on limits."""
    reach = limits.v_max[0] ** 2 / min(-limits.a_min[0], limits.a_max[0])
    high = limits.q_max[0] if math.isfinite(limits.q_max[0]) else reach
    low = limits.q_min[0] if math.isfinite(limits.q_min[0]) else high - reach
    more = beyond * min(reach, high - low)
    q = rng.uniform(low - more, high + more, count)
    v = rng.uniform(-1.0 - beyond, 1.0 + beyond, count) * limits.v_max[0]
    a = rng.uniform(limits.a_min[0], limits.a_max[0], count)
    kind = rng.integers(0, 10, count)
    q[kind == 0], q[kind == 1], v[kind < 3], a[kind < 3] = low, high, 0.0, 0.0
    return column(q), column(v), column(a)


def compare(limits, jerk, dt, rng, count=3):
    """Return by how much a linear program allows more, as parts of the accelerations."""
    solver, span = JerkBoundsSolver(limits, [jerk], dt), limits.a_max[0] - limits.a_min[0]
    case = tuple(
        float(getattr(limits, each)[0]) for each in ("q_min", "q_max", "v_max", "a_min", "a_max")
    )
    more = []
    for q, v, a in zip(*states(limits, rng, count), strict=True):
        least, most, margin = extreme_accelerations((*case, dt), q[0], v[0], a[0], jerk * dt)
        lower, upper, viable = solver.bounds(q, v, a)
        if abs(margin) > EDGE:
            assert not viable[0] or margin > 0.0
            assert viable[0] == (margin > 0.0) or not solver.exact[0]
        if viable[0]:
            more += [(most - upper[0]) / span, (lower[0] - least) / span]
    return solver.exact[0], more


def test_they_are_the_largest_that_a_linear_program_finds():
    rng = np.random.default_rng(1)
    exact, reduced = [], []
    while len(exact) < 16 or len(reduced) < 8:
        limits, jerk, dt = random_joint(rng, ranges=1)
        if jerk * dt < (limits.a_max[0] - limits.a_min[0]) / 8.0:
            continue  # many variables
        is_exact, more = compare(limits, jerk, dt, rng)
        (exact if is_exact else reduced).extend(more)
    assert np.abs(exact).max() <= EXACT
    assert min(reduced) >= -EXACT
    assert np.mean(reduced) < 0.1


@pytest.mark.parametrize("horizon", [1.0, 2.0, 1.4])
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_no_limit_is_passed_whatever_is_chosen(horizon, share):
    """Nor where the true acceleration is off, and where messages of the last one are lost."""
    rng = np.random.default_rng(2)
    for _ in range(JOINTS // 5):
        limits, jerk, dt = random_joint(rng)
        w = [share * min(-limits.a_min[0], limits.a_max[0])]
        try:
            solver = JerkBoundsSolver(limits, [jerk], dt, horizon * dt, w)
        except JointLimitsError:
            continue
        q, v, a = states(limits, rng, STATES)
        lower, upper, viable = solver.bounds(q, v, a)
        braking, accelerating = solver.braking[0]
        inside = (viable & (a >= -braking) & (a <= accelerating))[:, 0]
        q, v, a = q[inside], v[inside], a[inside]
        least, most = a, a
        seen = Violations(limits)
        for k in range(STEPS):
            lower, upper, viable = solver.bounds(q, v, least, most)
            assert viable.all()
            chosen = choose(q, v, lower, upper, limits, rng) if k % 40 < 30 else upper
            assert np.abs(chosen - a).max() <= jerk * dt * (1.0 + 1e-9)
            a = chosen
            lost = rng.random(a.shape) < 0.2
            least, most = np.where(lost, lower, a), np.where(lost, upper, a)
            off = np.where(k % 20 < 10, rng.choice([-1.0, 1.0], a.shape), np.sign(v))
            q, v, low, high = advance(q, v, a + w * off, dt)
            seen.see(low, high, q, v)
        assert seen.worst <= VIOLATION


def test_without_a_limit_of_jerk_they_are_those_of_accelerations():
    for case in HOLDING.values():
        limits, dt = one_joint(*case[:5]), case[5]
        q, v = states_of(case, 3000, seed=3)
        plain = BoundsSolver(limits, dt).bounds(q, v)
        bounds = JerkBoundsSolver(limits, [1e12], dt).bounds(q, v, 0.0 * q)
        assert (bounds.viable == plain.viable).mean() > 0.999  # states on the edge
        inside = plain.viable & bounds.viable
        assert inside.mean() > 0.3
        assert np.abs(bounds.lower - plain.lower)[inside].max() <= 1e-6
        assert np.abs(bounds.upper - plain.upper)[inside].max() <= 1e-6


def test_from_outside_they_bring_back_and_keep_the_jerk():
    rng = np.random.default_rng(4)
    for _ in range(15):
        limits, jerk, dt = random_joint(rng)
        solver = JerkBoundsSolver(limits, [jerk], dt)
        q, v, a = states(limits, rng, 60, beyond=0.3)
        back = np.zeros(q.shape, dtype=bool)
        for _ in range(4000):
            lower, upper, viable = solver.bounds(q, v, a)
            assert (lower <= upper).all()
            assert viable[back].all()  # and they stay
            back |= viable
            if back.all():
                break
            assert np.abs(np.stack([lower, upper]) - a).max() <= jerk * dt * (1.0 + 1e-9)
            a = choose(q, v, lower, upper, limits, rng)
            q, v, _, _ = advance(q, v, a, dt)
        assert back.all()


LIMITS = JointLimits(
    ["a", "b"], [-1.0, -math.inf], [1.0, math.inf], [2.0, 1.0], [-9.0, -4.0], [8.0, 4.0]
)
CURVED = replace(LIMITS, deceleration_limit=[5.0, math.inf])
NARROW = replace(LIMITS, q_max=[-0.99999, math.inf])


def test_they_hold_for_all_accelerations_that_may_have_been():
    solver = JerkBoundsSolver(LIMITS, [100.0, 100.0], 0.01)
    none = np.zeros(2)
    lower, upper, _ = solver.bounds(none, none, [1.0, -2.0], [2.5, -0.1])
    assert lower == pytest.approx([1.5, -1.1])
    assert upper == pytest.approx([2.0, -1.0])
    # Unknown by more than may change: nothing is right, the middle is least wrong.
    lower, upper, _ = solver.bounds(none, none, [-3.0, 0.0], [3.0, 0.0])
    assert lower[0] == upper[0] == pytest.approx(0.0)


def test_what_cannot_be_computed_is_told():
    solver = JerkBoundsSolver(LIMITS, [100.0, 100.0], 0.01)
    none = np.zeros(2)
    for state in ((math.nan, 0.0, 0.0), (0.0, math.nan, 0.0), (0.0, 0.0, math.nan)):
        assert not solver.bounds(*(np.full(2, each) for each in state)).viable.any()
    for wrong in ((none, none, [0.0]), (none[:1], none[:1], none[:1]), (0.0, 0.0, 0.0)):
        with pytest.raises(JointLimitsError, match="state"):
            solver.bounds(*wrong)


@pytest.mark.parametrize(
    ("field", "changed", "says"),
    [
        ("jerk", {"jerk": [100.0, 0.0]}, "finite and positive"),
        ("jerk", {"jerk": [100.0]}, "one value for each of the 2 joints"),
        ("jerk", {"limits": NARROW, "margin": [0.4, 0.0]}, "some braking"),
        ("period", {"period": 0.0}, "finite and positive"),
        ("dt", {"dt": 0.009}, "at least period"),
        ("deceleration_limit", {"limits": CURVED}, "inf where the jerk"),
        ("margin", {"margin": [0.0, 3.9], "jerk": [9.0, 9.0]}, "at most 2.1 rad/s"),
        ("margin", {"margin": [-0.1, 0.0]}, "at least 0"),
    ],
)
def test_settings_that_leave_no_bounds_are_refused(field, changed, says):
    with pytest.raises(JointLimitsError, match=says) as refused:
        JerkBoundsSolver(**{"limits": LIMITS, "jerk": [100.0, 100.0], "period": 0.01, **changed})
    assert refused.value.field == field
