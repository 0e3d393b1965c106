# SPDX-License-Identifier: Apache-2.0
"""Braking plans: where they end, what is left of them after a step, and how torques change."""

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.whole_arm.braking_plan import (
    JointLimitsOfPlans,
    make_course,
    new_course,
    rest_of,
    viable_range,
)
from viability_bounds_pkg.whole_arm.joint_plan import joint_course, joint_excess
from viability_bounds_pkg.whole_arm.plan_samples import (
    FIRST,
    REST,
    UNIFORM_SMOOTH,
    fill_plan,
    samples,
    sensitivity,
)

DT = 0.01
N = 7
LOW, HIGH = np.full(N, -1.0), np.full(N, 1.2)
BRAKING = np.linspace(3.0, 15.0, N)
TOLERANCE = np.full(N, 1e-3)
SPEED = np.full(N, 2.0)
CHANGE = np.full(N, 1.5)
FREE = np.full(N, np.inf)
CHANGES = [FREE, CHANGE, 0.4 * CHANGE]


def limits_of(change):
    return JointLimitsOfPlans(LOW, HIGH, TOLERANCE, SPEED, BRAKING, change)


def by_hand(v, a, moving, rising, falling):
    """Accelerations of one joint, as the module's docstring defines them."""
    k = np.arange(moving)
    r = np.minimum((k + 1) / rising, 1.0)
    p = np.minimum(r, (moving - k) / falling)
    return a * (1.0 - r) - p * (v / DT + (a * (1.0 - r)).sum()) / p.sum()


def played(q, v, accelerations):
    """States at the beginning of each period, and at the end."""
    states = [(q, v)]
    for a in accelerations:
        q, v = q + DT * v + 0.5 * DT * DT * a, v + DT * a
        states.append((q, v))
    return np.array(states)


class Plan:
    """A plan, its samples and, by hand, its periods."""

    def __init__(self, q, v, a, T=None, change=FREE, course=None):
        self.q, self.v, self.a = q, v, a
        if course is None:
            course = new_course(N)
            make_course(q, v, a, T, change, limits_of(change), DT, course)
        self.course = course
        most = samples(N, True)
        rows = (np.zeros(most, dtype=np.int64), *(np.zeros((most, N)) for _ in range(3)))
        count, self.beyond, self.excess = fill_plan(
            q, v, a, course, limits_of(change), DT, True, *rows
        )
        self.clock, self.positions, self.velocities, self.accelerations = (
            each[:count] for each in rows
        )
        self.hand = [by_hand(v[j], a[j], *(each[j] for each in course)) for j in range(N)]
        self.states = [played(q[j], v[j], self.hand[j]) for j in range(N)]

    def at(self, k):
        """State and acceleration in period k."""
        states = np.array([each[min(k, len(each) - 1)] for each in self.states])
        a = np.array([each[k] if k < len(each) else 0.0 for each in self.hand])
        return states[:, 0], states[:, 1], a


def random_state(rng, share=1.0):
    """A state from which no joint has to brake harder than it can within a step."""
    q = rng.uniform(LOW, HIGH)
    room = np.where(rng.random(N) < 0.5, HIGH - q, LOW - q)
    hardest = share * np.sqrt(2.0 * BRAKING * np.abs(room))
    v = np.sign(room) * rng.uniform(0.0, 1.0, N) * np.minimum(hardest, 2.0)
    return q, v, rng.uniform(-0.3, 0.3, N) * BRAKING


@pytest.mark.parametrize("change", CHANGES, ids=["any", "gentle", "gentler"])
@pytest.mark.parametrize("seed", range(8))
def test_a_plan_is_what_its_definition_says(seed, change):
    rng = np.random.default_rng(seed)
    plan = Plan(*random_state(rng), rng.uniform(DT, 1.0), change)
    assert (np.diff(plan.clock) > 0).all()
    longest = plan.course.moving.max()
    looked_at = {k * longest // UNIFORM_SMOOTH for k in range(UNIFORM_SMOOTH)} | {-1, REST}
    for moving, rising, falling in zip(*plan.course, strict=True):
        looked_at |= {moving - falling, moving, rising - 1}
    assert looked_at == set(plan.clock.tolist())
    for k, clock in enumerate(plan.clock.tolist()):
        if k >= FIRST:
            q, v, a = plan.at(clock)
            np.testing.assert_allclose(plan.positions[k], q, atol=1e-10)
            np.testing.assert_allclose(plan.velocities[k], v, atol=1e-10)
            np.testing.assert_allclose(plan.accelerations[k], a, atol=1e-9)
    np.testing.assert_array_equal(plan.velocities[-1], 0.0)
    _, v, a = plan.at(REST)
    np.testing.assert_allclose(v, 0.0, atol=1e-10)
    np.testing.assert_array_equal(a, 0.0)


@pytest.mark.parametrize("change", CHANGES, ids=["any", "gentle", "gentler"])
@pytest.mark.parametrize("seed", range(8))
def test_what_a_plan_passes_is_told(seed, change):
    """Against every period of it: an excess is never missed, and seldom larger than it is."""
    rng = np.random.default_rng(100 + seed)
    tight = np.full(N, 0.3)
    for _ in range(20):
        q, v, a = random_state(rng, 1.2)
        plan = Plan(q, v, a, rng.uniform(DT, 0.6), change)
        for j in range(N):
            course = [int(each[j]) for each in plan.course]
            place, fast = joint_excess(
                q[j], v[j], a[j], *course, DT, LOW[j], HIGH[j], SPEED[j], tight[j]
            )
            states = plan.states[j]
            worst = max(states[:, 0].max() - HIGH[j], LOW[j] - states[:, 0].min())
            assert worst - 1e-10 <= place <= worst + 0.5 * DT * np.abs(states[:, 1]).max()
            changes = np.diff(np.concatenate([[a[j]], plan.hand[j], [0.0]]))
            speeds = np.abs(states[:, 1]).max() / SPEED[j] - 1.0
            expected = max(speeds, np.abs(changes).max() / tight[j] - 1.0)
            assert fast == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_a_plan_of_constant_braking_ends_within_the_limits(seed):
    rng = np.random.default_rng(seed)
    plan = Plan(*random_state(rng), rng.uniform(DT, 1.0))
    assert plan.beyond == 0.0
    slack = TOLERANCE + 1e-12
    assert (plan.positions[FIRST:] >= LOW - slack).all()
    assert (plan.positions[FIRST:] <= HIGH + slack).all()
    assert (np.abs(plan.velocities[FIRST:]) <= np.abs(plan.v) + 1e-12).all()


@pytest.mark.parametrize("seed", range(10))
def test_smooth_plans_end_within_the_limits_where_there_is_room(seed):
    """From states that leave the room for a ramp, at any time T that is asked for."""
    rng = np.random.default_rng(seed)
    q, v, _ = random_state(rng, 0.3)
    for T in (DT, 0.2, 0.9):
        plan = Plan(q, v, np.zeros(N), T, CHANGE)
        assert plan.beyond == 0.0
        assert plan.excess == 0.0
        for each in plan.hand:
            changes = np.diff(np.concatenate([[0.0], each, [0.0]]))
            assert np.abs(changes).max() <= CHANGE[0] + 1e-9


def periods(place, speed, T):
    """How many periods joint 3 takes."""
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    return Plan(q, v, np.zeros(N), T).course.moving[3]


A = BRAKING[3]


@pytest.mark.parametrize(
    ("place", "speed", "T", "expected"),
    [
        (0.0, 0.1, 0.3, 30),  # the time of the plan
        (0.0, 0.1, 0.305, 31),  # rounded up
        (0.0, 1.0, 0.05, np.ceil(1.0 / A / DT)),  # no harder than A
        (1.1, 1.0, 0.3, 20),  # stands at the limit
        (1.1, -1.0, 0.3, 30),  # which is not ahead
        (-0.9, -1.0, 0.3, 20),  # the lower one
        (1.2 - 0.0595, 1.0, 0.3, 12),  # with A, though it stands 0.5 mrad beyond
        (1.2 - 0.02, 1.0, 0.3, 4),  # harder than A, as nothing else helps
        (1.2, 0.0, 0.3, 30),  # at rest at the limit
        (1.3, 0.0, 0.3, 30),  # and beyond
        (1.3, 0.1, 0.3, 1),  # at once
    ],
)
def test_what_decides_how_long_a_joint_takes(place, speed, T, expected):
    assert A == 9.0
    assert periods(place, speed, T) == expected


@pytest.mark.parametrize(
    ("place", "speed", "beyond"),
    [
        (1.2, 0.1, 0.0),
        (1.2, 1.0, 0.5 * 1.0 * DT - 1e-3),
        (1.21, 0.0, 0.01 - 1e-3),
        (-1.02, -0.5, 0.02 + 0.5 * 0.5 * DT - 1e-3),
        (-1.02, 0.5, 0.02 - 1e-3),
    ],
)
def test_a_limit_that_cannot_be_kept_is_told(place, speed, beyond):
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    assert Plan(q, v, np.zeros(N), 0.3).beyond == pytest.approx(beyond)


@pytest.mark.parametrize(
    ("v", "a", "T", "change"),
    [
        (1.0, 0.0, 0.5, 5.0),
        (1.0, 0.0, 0.5, 0.4),
        (-1.0, 4.0, 0.1, 0.4),
        (1.0, 4.0, 0.5, 0.1),
        (0.0, 4.0, 0.5, 0.4),
        (0.05, 0.0, 0.01, 0.2),
    ],
)
def test_a_gentle_course_keeps_to_a_and_to_the_changes(v, a, T, change):
    moving, rising, falling = joint_course(0.0, v, a, T, -np.inf, np.inf, 0.0, A, change, DT)
    assert moving >= round(T / DT)
    assert rising + falling <= moving + 1
    hand = by_hand(v, a, moving, rising, falling)
    assert -hand[rising - 1] * np.sign(v + 0.5 * a * DT * rising) <= A + 1e-9
    changes = np.diff(np.concatenate([[a], hand, [0.0]]))
    assert np.abs(changes).max() <= change + 1e-9


@pytest.mark.parametrize("change", CHANGES, ids=["any", "gentle", "gentler"])
@pytest.mark.parametrize("seed", range(8))
def test_the_rest_of_a_plan_is_a_plan(seed, change):
    """What makes one plan, once found, enough for ever: period by period until it stands."""
    rng = np.random.default_rng(seed)
    plan = Plan(*random_state(rng), rng.uniform(3.0 * DT, 0.8), change)
    first, course = plan, plan.course
    for k in range(1, int(first.course.moving.max()) + 2):
        rest = new_course(N)
        rest_of(course, rest)
        q, v, _ = first.at(k)
        left = Plan(q, v, first.at(k - 1)[2], change=change, course=rest)
        assert left.beyond <= first.beyond + 1e-12
        assert left.excess <= first.excess + 1e-6
        for mine, other in zip(left.at(0), first.at(k), strict=True):
            np.testing.assert_allclose(mine, other, atol=1e-7)
        course = rest


def can_stop(q, v, a, course, j):
    """Whether a joint's plan keeps its limits."""
    far, fast = joint_excess(q, v, a, *course, DT, LOW[j], HIGH[j], SPEED[j], CHANGE[j])
    return far <= TOLERANCE[j] and fast <= 1e-6


@pytest.mark.parametrize("seed", range(5))
def test_after_every_end_of_the_viable_range_a_joint_can_stop(seed):
    """Played with the ends for ever, at random: neither limit nor change is passed."""
    rng = np.random.default_rng(seed)
    limits = limits_of(CHANGE)
    q, v, last = 0.5 * (LOW + HIGH), np.zeros(N), np.zeros(N)
    course = Plan(q, v, last, 0.2, CHANGE).course  # in hand
    most, free = 0.0, 0
    for k in range(300):
        if k % 40 == 0:
            up = rng.random(N) < 0.5
        plan = Plan(q, v, last, course=course).at(0)[2]
        low, high = -BRAKING.copy(), BRAKING.copy()
        viable_range(q, v, plan, last, 0.2, CHANGE, limits, DT, low, high)
        assert (low <= high).all()
        a = np.where(up, high, low)
        rest = new_course(N)
        rest_of(course, rest)
        q, v, last = q + DT * v + 0.5 * DT * DT * a, v + DT * a, a
        made = Plan(q, v, last, 0.2, CHANGE).course
        for j in range(N):
            fresh = can_stop(q[j], v[j], a[j], [each[j] for each in made], j)
            free += fresh
            for mine, new in zip(course, made if fresh else rest, strict=True):
                mine[j] = new[j]
            assert can_stop(q[j], v[j], a[j], [each[j] for each in course], j)
        assert (q <= HIGH + TOLERANCE).all()
        assert (q >= LOW - TOLERANCE).all()
        assert (np.abs(v) <= SPEED * (1.0 + 1e-6)).all()
        most = max(most, np.abs(v).max())
    assert most > 1.5
    assert free > 0.5 * 300 * N


@pytest.mark.parametrize("change", CHANGES, ids=["any", "gentle", "gentler"])
@pytest.mark.parametrize("seed", range(4))
def test_torques_change_as_the_derivatives_say(seed, change):
    """Against the torques of plans from states a little apart, at each kind of sample."""
    rng = np.random.default_rng(seed)
    model = pin.buildSampleModelManipulator()
    joints = [model.addJoint(model.njoints - 1, pin.JointModelRX(), pin.SE3.Random(), "more")]
    model.appendBodyToJoint(joints[0], pin.Inertia.Random(), pin.SE3.Identity())
    assert model.nv == N
    data = model.createData()
    step = 1e-4
    q, v, a = random_state(rng)
    plan = Plan(q, v, a, 0.4, change)
    left = new_course(N)
    rest_of(plan.course, left)
    begin = plan.at(0)[2]

    def torque(a, k):
        after = Plan(q + v * DT + 0.5 * DT * DT * a, v + DT * a, a, course=left)
        return pin.rnea(model, data, *after.at(k))

    ends = np.unique(plan.course.moving)
    for clock in (1, 5, int(ends[0] + ends[-1]) // 2, int(ends[-1]) - 1, REST):
        by_q, by_v, M = pin.computeRNEADerivatives(model, data, *plan.at(clock))
        gradient = np.zeros((N, N))
        sensitivity(DT, plan.course, clock, by_q, by_v, M, gradient)
        for j in np.flatnonzero(plan.course.moving > 1):
            da = np.zeros(N)
            da[j] = step
            high, low = (torque(begin + s * da, clock - 1) for s in (1.0, -1.0))
            measured = (high - low) / (2.0 * step)
            scale = max(np.abs(measured).max(), 1e-6)
            np.testing.assert_allclose(gradient[:, j], measured, atol=1e-4 * scale)
