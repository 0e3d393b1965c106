# SPDX-License-Identifier: Apache-2.0
"""Bounds against the paper's algorithms and problem (4), and what they do with odd input."""

import math

import numpy as np
import paper_algorithms
import pytest
from against_brute_force import EXACT, compare, merged
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_cases import (
    CASES,
    FAILING,
    HOLDING,
    column,
    discrete_time_condition,
    one_joint,
    random_joint,
    states_of,
)

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import (
    BoundsSolver,
    acceleration_bounds,
    viable_velocity_range,
)


@pytest.mark.parametrize("name", HOLDING)
def test_discrete_time_condition_holds(name):
    case = HOLDING[name]
    limits = one_joint(*case[:5])
    assert discrete_time_condition(limits, case[5])
    assert BoundsSolver(limits, case[5]).exact.all()


@pytest.mark.parametrize("name", FAILING)
def test_discrete_time_condition_fails(name):
    case = FAILING[name]
    limits = one_joint(*case[:5])
    assert not discrete_time_condition(limits, case[5])
    solver = BoundsSolver(limits, case[5])
    assert not solver.exact.any()
    assert (solver.braking < [[-limits.a_min[0], limits.a_max[0]]]).any()


def test_discrete_time_condition_of_the_paper():
    # v_max >= dt a and q_max - q_min >= dt^2 a, for a = 10 and dt = 0.1.
    def holds(length, v_max):
        return bool(discrete_time_condition(one_joint(0.0, length, v_max, -10.0, 10.0), 0.1))

    assert holds(0.1, 1.0)
    assert not holds(0.0999999, 1.0)
    assert not holds(0.1, 0.9999999)


def test_discrete_time_condition_with_a_margin():
    # Thrown back at up to (A + W) dt; then only A - W is there to stop with.
    def holds(length, v_max, margin):
        limits = one_joint(0.0, length, v_max, -10.0, 10.0)
        return bool(discrete_time_condition(limits, 0.1, [margin]))

    room = 0.5 * 0.1**2 * 12.0 * (1.0 + 12.0 / 8.0)
    assert holds(1.001 * room, 1.201, 2.0)
    assert not holds(0.999 * room, 1.201, 2.0)
    assert not holds(1.001 * room, 1.199, 2.0)
    assert holds(0.999 * room, 1.199, 1.9)


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


def assert_exact(outcome):
    assert outcome.misjudged == 0
    assert outcome.undecided <= 0.02 * outcome.states
    assert outcome.difference <= EXACT


@pytest.mark.parametrize("name", HOLDING)
def test_agrees_with_brute_force(name):
    """`bash scripts/reproduce.sh exactness` compares far more states.

    The paper's algorithm is compared in 20,000 states more, above.
    """
    count = 30
    outcome = compare(CASES[name], *states_of(CASES[name], count, seed=2))
    assert_exact(outcome)
    assert outcome.compared > 0.2 * count


def test_agrees_with_brute_force_for_random_joints():
    rng = np.random.default_rng(3)
    cases = [random_joint(rng, True) for _ in range(4)]
    outcome = merged(compare(case, *states_of(case, 30, seed=4)) for case in cases)
    assert_exact(outcome)
    assert outcome.compared > 40


def test_allows_no_more_than_brute_force_where_the_discrete_time_condition_fails():
    rng = np.random.default_rng(3)
    cases = [*FAILING.values(), *(random_joint(rng, False) for _ in range(4))]
    outcome = merged(compare(case, *states_of(case, 30, seed=4)) for case in cases)
    assert outcome.unsafe == 0
    assert outcome.undecided <= 0.02 * outcome.states
    assert outcome.excess <= EXACT
    assert outcome.compared > 100


def test_brute_force_sees_bounds_that_are_a_little_too_wide():
    """The comparison can fail: a braking that is off by 1e-5 is noticed."""
    case = HOLDING["figure 3"]

    def optimistic(q, v, limits, dt):
        stronger = one_joint(*case[:3], *(1.00001 * a for a in case[3:5]))
        return acceleration_bounds(q, v, stronger, dt)

    outcome = compare(case, *states_of(case, 60, seed=2), bounds=optimistic)
    assert outcome.difference > EXACT
    assert outcome.excess > EXACT


def test_velocity_range_is_the_paper_s_kernel():
    limits = one_joint(-0.5, 0.5, 2.0, -10.0, 5.0)
    q = column(np.linspace(-0.5, 0.5, 101))
    lower, upper = viable_velocity_range(q, limits)
    assert upper == pytest.approx(np.minimum(2.0, np.sqrt(20.0 * (0.5 - q))))
    assert lower == pytest.approx(-np.minimum(2.0, np.sqrt(10.0 * (q + 0.5))))
    assert np.isnan(viable_velocity_range([0.6], limits)).all()


@pytest.mark.parametrize("name", CASES)
def test_velocity_range_is_where_states_are_viable(name):
    case = CASES[name]
    limits = one_joint(*case[:5])
    solver = BoundsSolver(limits, case[5])
    q, _ = states_of(case, 500, seed=4)
    q = column(q)
    lower, upper = solver.velocity_range(q)
    step = 1e-6 * case[2]
    assert solver.bounds(q, np.maximum(upper - step, 0.0)).viable.all()
    assert solver.bounds(q, np.minimum(lower + step, 0.0)).viable.all()
    assert not solver.bounds(q, upper + step).viable.any()
    assert not solver.bounds(q, lower - step).viable.any()
    assert solver.velocity_range(q[0]) == (lower[0], upper[0])
    outer = viable_velocity_range(q, limits)
    assert (outer[0] <= lower + 1e-12).all()
    assert (outer[1] >= upper - 1e-12).all()


SIZES = st.floats(1e-3, 1e3)
ANY = st.floats(allow_nan=False, allow_infinity=False)
NEAR = st.one_of(st.floats(-3.0, 3.0), st.sampled_from([0.0, 1.0, -1.0, 1e-300, 5e-324]), ANY)


@st.composite
def joints(draw):
    q_min = draw(st.one_of(st.floats(-3.0, 3.0), st.just(-math.inf)))
    start = q_min if math.isfinite(q_min) else 0.0
    length = draw(st.one_of(st.floats(1e-9, 10.0), st.just(math.inf)))
    q_max = max(start + length, np.nextafter(start, 9.0))
    return one_joint(q_min, q_max, draw(SIZES), -draw(SIZES), draw(SIZES))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    limits=joints(),
    dt=st.one_of(st.floats(1e-4, 1.0), st.sampled_from([5e-324, 1e-300, 1e-12, 1e3, 1e100])),
    q=NEAR,
    v=NEAR,
    on_limit=st.sampled_from([None, "q_min", "q_max"]),
)
def test_any_state_of_any_joint(limits, dt, q, v, on_limit):
    if on_limit is not None and math.isfinite(getattr(limits, on_limit)[0]):
        q = float(getattr(limits, on_limit)[0])
    solver = BoundsSolver(limits, dt)
    lower, upper, viable = (float(part[0]) for part in solver.bounds([q], [v]))
    assert limits.a_min[0] <= lower <= upper <= limits.a_max[0]

    reflected = one_joint(
        -limits.q_max[0], -limits.q_min[0], limits.v_max[0], -limits.a_max[0], -limits.a_min[0]
    )
    mirror = BoundsSolver(reflected, dt).bounds([-q], [-v])
    assert (-mirror.upper[0], -mirror.lower[0], mirror.viable[0]) == (lower, upper, viable)

    batch = solver.bounds(np.full((100, 1), q), np.full((100, 1), v))
    scale = limits.a_max[0] - limits.a_min[0]
    assert np.abs(batch.lower - lower).max() <= 1e-12 * scale
    assert np.abs(batch.upper - upper).max() <= 1e-12 * scale
    assert (batch.viable == viable).all()


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    limits=joints(),
    dt=st.floats(1e-3, 10.0),
    share=st.sampled_from([0.0, 0.01, 0.2]),
    q=st.floats(-5.0, 5.0),
    v=st.floats(-20.0, 20.0),
)
def test_no_speed_beyond_its_limit_from_anywhere(limits, dt, share, q, v):
    """Outside too, where positions are past saving, and whether (11) holds or not."""
    margin = share * min(-limits.a_min[0], limits.a_max[0])
    try:
        solver = BoundsSolver(limits, dt, [margin])
    except JointLimitsError:
        return
    bounds = solver.bounds([q], [v])
    most = max(limits.v_max[0], abs(v)) * (1.0 + 1e-9)
    for a in (bounds.lower[0], bounds.upper[0]):
        for true in (a - margin, a + margin):
            assert abs(v + dt * true) <= most
    if abs(v) > limits.v_max[0] + dt * margin:
        # Braking, as hard as it can unless a step is enough.
        braking = -bounds.upper[0] if v > 0.0 else bounds.lower[0]
        hardest = -limits.a_min[0] if v > 0.0 else limits.a_max[0]
        needed = (abs(v) - limits.v_max[0]) / dt
        assert braking >= min(needed, hardest) * (1.0 - 1e-9)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_a_joint_that_cannot_stop_in_time_keeps_its_speed_limit(mirror):
    """From outside it comes back so fast that it would have to turn round faster than allowed."""
    dt, solver = 0.1, BoundsSolver(one_joint(-0.005, 0.005, 1.0, -100.0, 100.0), 0.1)
    bounds = solver.bounds([0.006 * mirror], [-mirror])
    assert bounds.lower == bounds.upper
    assert dt * bounds.upper[0] == pytest.approx(2.0 * mirror)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize(("q", "v"), [(1.02, 0.0), (1.05, -0.4)])
def test_a_joint_on_its_way_back_is_on_its_limit_after_a_step(q, v, mirror):
    dt, solver = 0.1, BoundsSolver(one_joint(-1.0, 1.0, 5.0, -20.0, 20.0), 0.1)
    bounds = solver.bounds([mirror * q], [mirror * v])
    a = bounds.upper[0] if mirror > 0.0 else -bounds.lower[0]
    assert q + dt * v + 0.5 * dt * dt * a == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("rows", [0, 1, 5, 24, 25, 5000])
def test_batches_of_any_size_are_states_one_by_one(rows):
    limits = JointLimits(
        ["a", "b", "c"],
        [-0.5, -math.inf, -0.02],
        [0.5, 1.0, 0.02],
        [2.0, 2.0, 0.6],
        [-10.0, -5.0, -10.0],
        [8.0, 9.0, 10.0],
    )
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-0.7, 0.7, (rows, 3)), rng.uniform(-2.2, 2.2, (rows, 3))
    batch = acceleration_bounds(q, v, limits, 0.1)
    assert all(part.shape == (rows, 3) for part in batch)
    for i in range(0, rows, 7):
        for one, many in zip(acceleration_bounds(q[i], v[i], limits, 0.1), batch, strict=True):
            assert one == pytest.approx(many[i], rel=1e-12, abs=1e-12)


def test_states_that_are_not_finite_do_no_harm():
    limits = one_joint(-1.0, 1.0, 2.0, -10.0, 8.0)
    for q, v in ((np.nan, 0.0), (0.0, np.nan), (np.nan, 1.0), (np.inf, 0.0), (0.0, -np.inf)):
        for rows in (1, 100):
            bounds = acceleration_bounds(np.full((rows, 1), q), np.full((rows, 1), v), limits, 0.1)
            assert not bounds.viable.any()
            assert (bounds.lower >= -10.0).all()
            assert (bounds.upper <= 8.0).all()
            assert (bounds.lower <= bounds.upper).all()


@pytest.mark.parametrize(
    ("q", "v"),
    [
        ([0.0], [0.0, 0.0]),
        ([0.0, 0.0], [0.0, 0.0]),
        (0.0, 0.0),
        (np.zeros((2, 2)), np.zeros((2, 2))),
    ],
)
def test_refuses_states_of_the_wrong_shape(q, v):
    with pytest.raises(JointLimitsError, match="shape"):
        acceleration_bounds(q, v, one_joint(-1.0, 1.0, 2.0, -10.0, 8.0), 0.1)


@pytest.mark.parametrize("dt", [0.0, -0.1, math.nan, math.inf, "soon", 1e300])
def test_refuses_steps(dt):
    with pytest.raises(JointLimitsError, match="dt"):
        BoundsSolver(one_joint(-1.0, 1.0, 2.0, -10.0, 8.0), dt)


def test_refuses_a_period_above_the_step():
    with pytest.raises(JointLimitsError, match="period"):
        BoundsSolver(one_joint(-1.0, 1.0, 2.0, -10.0, 8.0), 0.1, period=0.2)


@pytest.mark.parametrize(
    ("margin", "dt"),
    [
        ([-1.0], 0.01),
        ([8.0], 0.01),
        ([math.nan], 0.01),
        ([math.inf], 0.01),
        ([1.0, 1.0], 0.01),
        # Within one step the disturbance alone crosses the range.
        ([3.0], 1.0),
    ],
)
def test_refuses_margins(margin, dt):
    with pytest.raises(JointLimitsError, match="margin") as caught:
        BoundsSolver(one_joint(-1.0, 1.0, 2.0, -10.0, 8.0), dt, margin)
    assert caught.value.field == "margin"


def test_a_margin_keeps_the_acceleration_limits():
    limits = one_joint(-1.0, 1.0, 2.0, -10.0, 8.0)
    solver = BoundsSolver(limits, 0.01, [2.0])
    lower, upper, viable = solver.bounds([0.0], [0.0])
    assert (lower[0], upper[0], viable[0]) == (-10.0, 8.0, True)
    lower, upper, _ = solver.bounds([0.0], [2.0])
    assert upper[0] == pytest.approx(-2.0)
