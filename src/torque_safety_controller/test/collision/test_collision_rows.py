# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import numpy as np
import pytest
from collision_arm import (
    BALL,
    box,
    everything,
    half_space,
    panda,
    panda_avoidance,
    random_states,
    two_links,
    wide_rows,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.parts.collision.avoidance import (
    ROW_SCALE,
    Collision,
)
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver


def test_the_bound_is_that_of_a_joint_with_a_lower_limit():
    """A distance moved by a slider alone is a joint: the exact bounds for it must come out."""
    wall = half_space("wall", [2.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    avoidance, _ = two_links(
        BALL, 0.4, [wall], "prismatic", "1 0 0", influence=5.0, speed_max=9.0, dt=0.02
    )
    # The wall limits q2 to 2 - 0.9 - 0.05 - margin and reserve, with a braking of 2 m/s^2.
    limits = JointLimits(("slider",), [-np.inf], [1.05 - 0.022], [1e3], [-2.0], [2.0])
    exact = BoundsSolver(limits, 0.02)
    rng = np.random.default_rng(4)
    braked = 0
    for _ in range(300):
        room = rng.uniform(0.0, 0.2)
        q = np.array([0.0, 1.05 - 0.022 - room])
        v = np.array([0.0, rng.uniform(-0.5, 1.0) * np.sqrt(4.0 * room)])
        upper = exact.bounds(q[1:], v[1:]).upper[0]
        rows = wide_rows(avoidance, q, v)
        if upper < 2.0 and rows.viable[0]:
            assert -rows.lower[0] - rows.bias[0] == pytest.approx(
                upper, abs=2e-3
            )  # rounding with wide bounds
            braked += upper < 0.0
    assert braked > 10


def test_rows_are_left_out_only_if_the_bounds_imply_them():
    avoidance = everything()
    some = 0
    for q, v in random_states(150, speed=1.5, seed=5):
        every = wide_rows(avoidance, q, v)
        every = every._replace(G=every.G.copy(), lower=every.lower.copy())
        _, limits, _ = panda()
        rows = avoidance.rows(q, v, limits.a_min, limits.a_max)
        least = np.where(every.G > 0.0, limits.a_min, limits.a_max)
        assert len(rows.lower) == np.count_nonzero(np.sum(every.G * least, axis=1) < every.lower)
        some += len(rows.lower)
    assert some > 100


def test_pairs_that_are_not_looked_at_have_twice_the_way_to_stop():
    _, limits, collision = panda()
    avoidance = everything()
    usual = panda_avoidance(1000)
    compared = 0
    for q, v in random_states(150, speed=1.5, seed=5):
        near = set(usual.rows(q, v, limits.a_min, limits.a_max).pair)
        every = avoidance.rows(q, v, limits.a_min, limits.a_max)
        for pair, d, rate in zip(every.pair, every.distance, every.rate, strict=True):
            if pair not in near:
                assert d > 0.1
                assert d - 0.022 > rate**2 / 2.0
                compared += 1
    assert compared > 20


def test_of_too_many_rows_the_nearest_are_returned():
    arm, limits, collision = panda()
    few, every = panda_avoidance(3), panda_avoidance(1000)
    cut = 0
    for q, v in random_states(100, speed=2.0, seed=8):
        rows = few.rows(q, v, limits.a_min, limits.a_max)
        all_rows = every.rows(q, v, limits.a_min, limits.a_max)
        nearest = np.sort(all_rows.distance)[: len(rows.lower)]
        np.testing.assert_array_equal(np.sort(rows.distance), nearest)
        assert len(rows.lower) == min(3, len(all_rows.lower)) == len(rows.G) == len(rows.viable)
        cut += len(all_rows.lower) > 3
    assert cut > 10


def test_no_row_asks_for_what_the_bounds_do_not_allow():
    avoidance = everything()
    broken = 0
    rng = np.random.default_rng(6)
    for q, v in random_states(150, speed=2.0, seed=7):
        upper = rng.uniform(-2.0, 5.0, len(q))
        lower = upper - rng.uniform(0.0, 5.0, len(q))
        rows = avoidance.rows(q, v, lower, upper)
        most = np.sum(np.maximum(rows.G * lower, rows.G * upper), axis=1)
        assert (rows.lower <= most).all()
        broken += np.count_nonzero(~rows.viable)
    assert broken > 50


def test_bodies_that_overlap_are_parted_slowly_and_reported():
    wall = half_space("wall", [0.85, 0.0, 0.0], [-1.0, 0.0, 0.0])
    avoidance, _ = two_links(BALL, 0.4, [wall], "prismatic", "1 0 0")
    q, v, limit = np.zeros(2), np.zeros(2), np.full(2, 20.0)
    assert wide_rows(avoidance, q, v).distance[0] == pytest.approx(-0.1)
    speeds, kept = [], []
    for _ in range(3000):
        rows = avoidance.rows(q, v, -limit, limit)
        a = np.zeros(2)
        if len(rows.lower):
            a[1] = max(0.0, -rows.lower[0] / -rows.G[0, 1])
            a[1] = min(0.0, rows.lower[0] / rows.G[0, 1])
            kept.append(bool(rows.viable.all()))
        q, v = q + 1e-3 * v + 5e-7 * a, v + 1e-3 * a
        speeds.append(-v[1])
    assert not kept[0]
    assert max(speeds) == pytest.approx(0.1, abs=1e-3)
    assert avoidance.closest()[0] >= 0.0199


def test_a_wall_that_cannot_be_avoided_is_asked_for_in_vain_but_finitely():
    """Too fast and too near: the row asks for all that the bounds allow."""
    wall = half_space("wall", [0.98, 0.0, 0.0], [-1.0, 0.0, 0.0])
    avoidance, _ = two_links(BALL, 0.4, [wall], "prismatic", "1 0 0")
    limit = np.full(2, 20.0)
    rows = avoidance.rows(np.zeros(2), np.array([0.0, 3.0]), -limit, limit)
    assert rows.lower[0] == pytest.approx(20.0)
    assert not rows.viable[0]


finite = st.floats(-1.0, 1.0, allow_nan=False)


@settings(deadline=None, max_examples=200)
@given(
    st.lists(finite, min_size=7, max_size=7),
    st.lists(finite, min_size=7, max_size=7),
    st.sampled_from([0.0, 1e-8, 1.0, 50.0]),
)
def test_rows_are_finite_in_every_state(position, velocity, speed):
    arm, limits, _ = panda()
    avoidance = _near()
    q = arm.q_min + (np.array(position) + 1.0) * 0.5 * (arm.q_max - arm.q_min)
    rows = avoidance.rows(q, speed * np.array(velocity), limits.a_min, limits.a_max)
    for array in rows:
        assert np.isfinite(array).all()
    assert rows.G.shape == (len(rows.lower), 7)


_cache = []


def _near():
    if not _cache:
        _, limits, collision = panda()
        _cache.append(Collision(collision, limits.a_min, limits.a_max, 2e-3))
    return _cache[0]


def ball_before_a_wall(**changes):
    """An arm in the x-y plane with a ball at its end, and a wall at x = 0.9 m."""
    block = box("block", [1.0, 0.0, 0.0], [0.2, 2.0, 2.0])
    return two_links(BALL, 0.3, [block], dt=4e-3, **changes)[0]


@pytest.mark.parametrize("beyond", [1e-13, 1e-9, 1e-6])
def test_a_distance_just_beyond_its_limit_is_brought_back_without_a_kick(beyond):
    """Both at rest and on its way in; just inside about the same is asked for."""
    q = np.array([0.9, -0.9])  # the forearm along x: the ball's centre at x = 0.5 cos 0.9 + 0.3
    wide = np.full(2, 20.0)
    gap = 0.9 - (0.5 * np.cos(0.9) + 0.3) - 0.05
    for v in (np.zeros(2), np.array([-1e-6, 0.0])):
        asked = []
        for inside in (beyond, -beyond):
            avoidance = ball_before_a_wall(margin=gap - 0.002 + inside, influence=1.0)
            rows = avoidance.rows(q, v, -wide, wide)
            asked.append(rows.lower[np.argmin(rows.distance)])
        assert abs(asked[0]) < 2.1 * beyond / 4e-3**2 + 3e-3  # m/s^2
        assert asked[0] == pytest.approx(asked[1], abs=5.0 * beyond / 4e-3**2 + 3e-3)


def test_what_pushes_towards_a_body_is_asked_for_in_addition():
    avoidance = ball_before_a_wall(margin=0.1, influence=1.0)
    q, v, wide = np.array([0.6, -0.4]), np.array([-0.5, 0.2]), np.full(2, 5000.0)
    plain = avoidance.rows(q, v, -wide, wide)
    G, lower = plain.G.copy(), plain.lower.copy()
    for e in (np.array([-2.0, 1.0]), np.array([2.0, -1.0])):
        pushed = avoidance.rows(q, v, -wide, wide, e)
        assert len(lower) == len(pushed.lower) > 0
        np.testing.assert_allclose(pushed.lower, lower + np.maximum(-G @ e, 0.0), atol=1e-9)


def test_constraints_for_the_qp_are_finite_whatever_it_is_given():
    avoidance = ball_before_a_wall(margin=0.1, influence=1.0)
    q, v, wide = np.array([0.6, -0.4]), np.array([-0.5, 0.2]), np.full(2, 5000.0)
    rows = avoidance.rows(q, v, -wide, wide)
    G, lower = rows.G.copy(), rows.lower.copy()

    def constraint(q, v, bounds):
        step = SimpleNamespace(  # all that it reads
            robot=SimpleNamespace(q=q, v=v),
            disturbance=np.zeros(2),
            bounds=AccelerationRange(-bounds, bounds),
            commanded=lambda bounds: bounds,
            rows={},
        )
        avoidance.prepare(step)
        return step.rows.get(avoidance)

    scaled = constraint(q, v, wide)
    np.testing.assert_allclose(scaled.G, ROW_SCALE * G)
    np.testing.assert_allclose(scaled.lower, ROW_SCALE * lower)
    assert np.isposinf(scaled.upper).all()
    for bad in (np.array([np.nan, 0.0]), np.array([0.0, np.inf])):
        assert constraint(bad, v, wide) is None
        assert constraint(q, bad, wide) is None
    unbounded = constraint(q, v, np.full(2, np.inf))
    np.testing.assert_allclose(unbounded.lower, ROW_SCALE * lower)
