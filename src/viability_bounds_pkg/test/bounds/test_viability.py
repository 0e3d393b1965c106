# SPDX-License-Identifier: Apache-2.0
"""Bounds against the paper's algorithms and problem (4), and what they do with odd input."""

import math

import numpy as np
import paper_algorithms
import pytest
from brute_force import EXACT, compare
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_cases import (
    CASES,
    FAILING,
    HOLDING,
    column,
    one_joint,
    random_joint,
    solver_of,
    states_of,
)

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import (
    BoundsSolver,
    acceleration_bounds,
    viable_velocity_range,
)


@pytest.mark.parametrize("name", HOLDING)
def test_agrees_with_algorithm_3(name):
    for dt in (HOLDING[name][5], 0.01):
        case = (*HOLDING[name][:5], dt)
        limits = one_joint(*case[:5])
        q, v = states_of(case, 20_000, seed=1)
        bounds = acceleration_bounds(q, v, limits, dt)
        lower, upper = paper_algorithms.combined_bounds(q, v, limits, dt)
        assert bounds.viable.mean() > 0.5
        # Where the room is no more than rounding, the paper's v^2 / (2 room) is, too.
        room = np.minimum(limits.q_max - q, q - limits.q_min)
        fair = bounds.viable & (room > 1e-9)
        scale = limits.a_max - limits.a_min
        assert np.abs(bounds.upper - upper)[fair].max() <= 1e-9 * scale
        assert np.abs(bounds.lower - lower)[fair].max() <= 1e-9 * scale


def random_cases(holds, count=4):
    rng = np.random.default_rng(3)
    return [random_joint(rng, holds) for _ in range(count)]


@pytest.mark.parametrize("case", [*HOLDING.values(), *random_cases(True)])
def test_agrees_with_brute_force(case):
    outcome = compare(case, *states_of(case, 15, seed=2))
    assert outcome.misjudged == 0
    assert outcome.undecided <= 1  # other versions of the solver may give up now and then
    assert outcome.difference <= EXACT
    assert outcome.compared >= 3


@pytest.mark.parametrize("case", [*FAILING.values(), *random_cases(False)])
def test_allows_no_more_than_brute_force_where_the_discrete_time_condition_fails(case):
    outcome = compare(case, *states_of(case, 12, seed=4))
    assert outcome.unsafe == 0
    assert outcome.undecided <= 1  # other versions of the solver may give up now and then
    assert outcome.excess <= EXACT


def test_brute_force_sees_bounds_that_are_a_little_too_wide():
    """The comparison can fail: a braking that is off by 1e-5 is noticed."""
    case = HOLDING["figure 3"]

    def optimistic(q, v, limits, dt):
        stronger = one_joint(*case[:3], *(1.00001 * a for a in case[3:5]))
        return acceleration_bounds(q, v, stronger, dt)

    outcome = compare(case, *states_of(case, 15, seed=2), bounds=optimistic)
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
    solver = solver_of(case)
    q, _ = states_of(case, 500, seed=4)
    lower, upper = solver.velocity_range(q)
    step = 1e-6 * case[2]
    assert solver.bounds(q, np.maximum(upper - step, 0.0)).viable.all()
    assert solver.bounds(q, np.minimum(lower + step, 0.0)).viable.all()
    assert not solver.bounds(q, upper + step).viable.any()
    assert not solver.bounds(q, lower - step).viable.any()
    # Where condition (11) fails, it is smaller than in continuous time.
    slowest, fastest = viable_velocity_range(q, solver.limits)
    assert (slowest <= lower + 1e-12).all()
    assert (fastest >= upper - 1e-12).all()


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
    """Bounds are ordered, within their limits, mirror symmetric, and the same in batches."""
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


@settings(max_examples=200, deadline=None, derandomize=True)
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


def test_a_batch_of_several_joints_is_states_one_by_one():
    limits = JointLimits(
        ["a", "b", "c"],
        [-0.5, -math.inf, -0.02],
        [0.5, 1.0, 0.02],
        [2.0, 2.0, 0.6],
        [-10.0, -5.0, -10.0],
        [8.0, 9.0, 10.0],
    )
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-0.7, 0.7, (30, 3)), rng.uniform(-2.2, 2.2, (30, 3))
    batch = acceleration_bounds(q, v, limits, 0.1)
    for i in range(30):
        for one, many in zip(acceleration_bounds(q[i], v[i], limits, 0.1), batch, strict=True):
            assert one == pytest.approx(many[i], rel=1e-12, abs=1e-12)
    assert all(part.shape == (0, 3) for part in acceleration_bounds(q[:0], v[:0], limits, 0.1))


@pytest.mark.parametrize(("q", "v"), [(1.02, 0.0), (1.05, -0.4)])
def test_a_joint_on_its_way_back_is_on_its_limit_after_a_step(q, v):
    dt, solver = 0.1, BoundsSolver(one_joint(-1.0, 1.0, 5.0, -20.0, 20.0), 0.1)
    a = solver.bounds([q], [v]).upper[0]
    assert q + dt * v + 0.5 * dt * dt * a == pytest.approx(1.0, abs=1e-12)


LIMITS = one_joint(-1.0, 1.0, 2.0, -10.0, 8.0)


def test_a_step_beyond_the_limit_by_rounding_is_no_emergency():
    lower, upper, viable = BoundsSolver(LIMITS, 0.01).bounds([np.nextafter(1.0, 2.0)], [0.0])
    assert viable[0]
    assert upper[0] == pytest.approx(0.0, abs=1e-10)
    assert lower[0] == -10.0


def test_a_margin_keeps_the_acceleration_limits():
    solver = BoundsSolver(LIMITS, 0.01, [2.0])
    lower, upper, viable = solver.bounds([0.0], [0.0])
    assert (lower[0], upper[0], viable[0]) == (-10.0, 8.0, True)
    assert solver.bounds([0.0], [2.0]).upper[0] == pytest.approx(-2.0)


def test_states_that_are_not_finite_do_no_harm():
    for q, v in ((np.nan, 0.0), (0.0, np.nan), (np.inf, 0.0), (0.0, -np.inf)):
        lower, upper, viable = acceleration_bounds([q], [v], LIMITS, 0.1)
        assert not viable[0]
        assert -10.0 <= lower[0] <= upper[0] <= 8.0


@pytest.mark.parametrize(
    ("q", "v"), [([0.0], [0.0, 0.0]), (0.0, 0.0), (np.zeros((2, 2)), np.zeros((2, 2)))]
)
def test_states_of_the_wrong_shape_are_refused(q, v):
    with pytest.raises(JointLimitsError, match="shape"):
        acceleration_bounds(q, v, LIMITS, 0.1)


@pytest.mark.parametrize(
    ("field", "changed", "says"),
    [
        ("dt", {"dt": 0.0}, "finite and positive"),
        ("dt", {"dt": math.nan}, "finite and positive"),
        ("dt", {"dt": "soon"}, "finite and positive"),
        ("dt", {"dt": 1e300}, "shorter"),
        ("period", {"period": 0.2}, "at most dt"),
        ("margin", {"margin": [-1.0]}, "at least 0"),
        ("margin", {"margin": [8.0]}, "below min"),
        ("margin", {"margin": [math.nan]}, "a number"),
        ("margin", {"margin": [1.0, 1.0]}, "one value for each of the 1 joints"),
        # Within one step the disturbance alone crosses the range.
        ("margin", {"margin": [3.0], "dt": 1.0}, "must be smaller"),
        ("position_error", {"position_error": [1.0]}, "below half the range, 1 rad"),
        ("velocity_error", {"velocity_error": [math.inf]}, "finite"),
        ("velocity_error", {"velocity_error": [1.01]}, "must be smaller"),
    ],
)
def test_settings_that_leave_no_bounds_are_refused(field, changed, says):
    with pytest.raises(JointLimitsError, match=says) as refused:
        BoundsSolver(**{"limits": LIMITS, "dt": 0.1, **changed})
    assert refused.value.field == field
