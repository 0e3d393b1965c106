# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import coal
import numpy as np
import pinocchio as pin
import pytest
from collision_arm import panda, two_links, with_constants
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.collision.avoidance import (
    ROW_SCALE,
    CollisionAvoidance,
    CollisionSettings,
)
from torque_safety_controller.collision.bodies import box, capsule, half_space, sphere
from torque_safety_controller.qp.constraints import AccelerationRange
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

BALL = '<sphere radius="0.05"/>'
ROD = '<cylinder radius="0.05" length="0.4"/>'
WIDE = 1e6  # rad/s^2; with such bounds no row is implied by them


def everything() -> CollisionAvoidance:
    """Panda among all obstacles, near and far."""
    return with_constants(panda_avoidance(1000), influence=5.0)


def panda_avoidance(rows_max: int) -> CollisionAvoidance:
    _, limits, collision, _ = panda()
    avoidance = CollisionAvoidance(collision, limits.a_min, limits.a_max, 2e-3)
    avoidance._rows_max = rows_max
    return avoidance


def random_states(count, speed=1.0, seed=0):
    arm = panda()[0]
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(arm.q_min, arm.q_max), speed * rng.uniform(-1.0, 1.0, arm.n)


def wide_rows(avoidance, q, v):
    wide = np.full(len(q), WIDE)
    return avoidance.rows(q, v, -wide, wide)


def names_of(avoidance, rows):
    return [avoidance.model.names[k] for k in rows.pair]


def test_the_motion_of_the_joints_is_pinocchios():
    """Velocity and bias of points fixed to the joints."""
    arm = panda()[0]
    avoidance, data = everything(), arm.model.createData()
    motion = avoidance._work.motion
    for q, v in random_states(20):
        wide_rows(avoidance, q, v)
        pin.forwardKinematics(arm.model, data, q, v, np.zeros(arm.n))
        for i in range(1, arm.model.njoints):
            placement = data.oMi[i]
            np.testing.assert_allclose(motion.placements[i, :3], placement.rotation, atol=1e-13)
            np.testing.assert_allclose(motion.placements[i, 3], placement.translation, atol=1e-13)
            for ours, theirs in ((motion.velocity, data.v), (motion.bias, data.a)):
                spatial = placement.act(theirs[i])
                np.testing.assert_allclose(ours[i, 0], spatial.linear, atol=1e-12)
                np.testing.assert_allclose(ours[i, 1], spatial.angular, atol=1e-12)


def test_distances_are_coals():
    """Every pair of capsules, box and half space, by another implementation."""
    avoidance = everything()
    bodies, pairs = avoidance.model.bodies, avoidance.model.pairs
    compared = 0
    for q, v in random_states(60, seed=1):
        wide_rows(avoidance, q, v)
        for i, j, d in zip(pairs.first, pairs.second, avoidance.distances, strict=True):
            if d == np.inf:
                continue
            first, second = _coal_body(avoidance, i), _coal_body(avoidance, j)
            request, result = coal.DistanceRequest(), coal.DistanceResult()
            expected = coal.distance(*first, *second, request, result)
            box_like = isinstance(second[0], coal.Box)
            # A capsule whose axis is inside a box is measured otherwise: from its deepest point.
            if box_like and d < -bodies.radius[i]:
                assert expected < 0.0
            else:
                # coal goes by GJK for boxes, to 1e-6 m
                assert d == pytest.approx(expected, abs=2e-6 if box_like else 1e-9)
            compared += 1
    assert compared > 2000


def _coal_body(avoidance, i):
    bodies, motion = avoidance.model.bodies, avoidance._work.motion
    half = bodies.half[bodies.first[i]]
    R, centre = motion.rotation[i].copy(), motion.centre[i].copy()
    if bodies.plane[i]:
        surface = R[:, 2] @ centre + half[2]
        return coal.Halfspace(R[:, 2], surface), coal.Transform3s()
    if half.all():
        return coal.Box(2.0 * half), coal.Transform3s(R, centre)
    return coal.Capsule(float(bodies.radius[i]), 2.0 * half[2]), coal.Transform3s(R, centre)


def test_rate_and_acceleration_by_finite_differences():
    """Of the closest points of each pair, along motions: curvature and sliding included."""
    avoidance = everything()
    h = 2e-4  # s
    found = avoidance.distances
    compared, off = 0, 0
    rng = np.random.default_rng(2)
    for q, v in random_states(60, seed=3):
        a = rng.uniform(-3.0, 3.0, len(q))
        nearby = []
        for t in (-h, 0.0, h):
            rows = wide_rows(avoidance, q + v * t + 0.5 * a * t * t, v + a * t)
            nearby.append(found.copy())
        rows = wide_rows(avoidance, q, v)
        before, now, after = nearby
        rate, acceleration = (after - before) / (2.0 * h), (after + before - 2.0 * now) / h**2
        for k, p in enumerate(rows.pair):
            if rows.distance[k] != pytest.approx(now[p], abs=1e-12) or now[p] <= 0.0:
                continue  # of other features than the closest points, or overlapping
            compared += 1
            error = abs(rows.G[k] @ a + rows.bias[k] - acceleration[p])
            if abs(rows.rate[k] - rate[p]) > 1e-4 or error > 1e-2 * (1.0 + abs(acceleration[p])):
                off += 1
    # Where the closest points come to an end or an edge in between, the difference is not d''.
    assert compared > 2000
    assert off <= compared // 500


@pytest.mark.parametrize("kind, axis", [("revolute", "0 0 1"), ("prismatic", "1 0 0")])
def test_a_ball_before_a_wall_by_hand(kind, axis):
    """The wall is x = 1; for the planar arm, x of the hand and its derivatives are known."""
    wall = half_space("wall", [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    avoidance, _ = two_links(BALL, 0.4, [wall], kind, axis, influence=5.0)
    q, v, a = np.array([0.3, 0.4]), np.array([0.7, -0.5]), np.array([1.1, 0.6])
    rows = wide_rows(avoidance, q, v)
    if kind == "revolute":
        both, speed = q.sum(), v.sum()
        x = 0.5 * np.cos(q[0]) + 0.4 * np.cos(both)
        x_dot = -0.5 * np.sin(q[0]) * v[0] - 0.4 * np.sin(both) * speed
        x_bias = -0.5 * np.cos(q[0]) * v[0] ** 2 - 0.4 * np.cos(both) * speed**2
        J = -np.array([0.5 * np.sin(q[0]) + 0.4 * np.sin(both), 0.4 * np.sin(both)])
    else:
        length = 0.9 + q[1]
        x = length * np.cos(q[0])
        x_dot = -length * np.sin(q[0]) * v[0] + np.cos(q[0]) * v[1]
        x_bias = -length * np.cos(q[0]) * v[0] ** 2 - 2.0 * np.sin(q[0]) * v[0] * v[1]
        J = np.array([-length * np.sin(q[0]), np.cos(q[0])])
    assert names_of(avoidance, rows) == ["fore - wall"]
    assert rows.distance[0] == pytest.approx(1.0 - x - 0.05)
    assert rows.rate[0] == pytest.approx(-x_dot)
    assert rows.G[0] @ a + rows.bias[0] == pytest.approx(-(J @ a + x_bias))


def test_a_ball_around_a_ball_by_hand():
    """On a circle about the other ball nothing changes; past it, on a line, d'' = v^2 / d."""
    about = sphere("ball", [0.0, 0.0, 0.0], 0.1)
    avoidance, _ = two_links(BALL, 0.4, [about], influence=5.0)
    rows = wide_rows(avoidance, np.array([0.3, 0.5]), np.array([2.0, 0.0]))
    assert rows.rate[0] == pytest.approx(0.0, abs=1e-12)
    assert rows.bias[0] == pytest.approx(0.0, abs=1e-12)
    slider, _ = two_links(
        BALL, 0.4, [sphere("ball", [0.9, 0.5, 0.0], 0.1)], "prismatic", "1 0 0", influence=5.0
    )
    rows = wide_rows(slider, np.zeros(2), np.array([0.0, 0.8]))
    assert rows.bias[0] == pytest.approx(0.8**2 / 0.5)


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
        _, limits, _, _ = panda()
        rows = avoidance.rows(q, v, limits.a_min, limits.a_max)
        least = np.where(every.G > 0.0, limits.a_min, limits.a_max)
        assert len(rows.lower) == np.count_nonzero(np.sum(every.G * least, axis=1) < every.lower)
        some += len(rows.lower)
    assert some > 100


def test_pairs_that_are_not_looked_at_have_twice_the_way_to_stop():
    _, limits, collision, _ = panda()
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
    arm, limits, collision, _ = panda()
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


def test_ends_have_rows_before_the_closest_point_jumps_there():
    """A rod parallel to a wall of a box turns in its plane: one end comes, the other goes."""
    block = box("block", [0.7, 0.2, 0.0], [1.0, 0.1, 1.0])
    avoidance, _ = two_links(ROD, 0.2, [block], influence=5.0)
    for tilt in (-1e-9, 1e-9):
        rows = wide_rows(avoidance, np.array([0.0, tilt]), np.array([0.0, 1.0]))
        near = rows.distance < rows.distance.min() + 1e-6
        rates = rows.rate[near]
        assert rates.min() == pytest.approx(-0.4, abs=1e-6)
        assert rates.max() > -1e-6


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
    arm, limits, _, _ = panda()
    avoidance = _near()
    q = arm.q_min + (np.array(position) + 1.0) * 0.5 * (arm.q_max - arm.q_min)
    rows = avoidance.rows(q, speed * np.array(velocity), limits.a_min, limits.a_max)
    for array in rows:
        assert np.isfinite(array).all()
    assert rows.G.shape == (len(rows.lower), 7)


_cache = []


def _near():
    if not _cache:
        _, limits, collision, _ = panda()
        _cache.append(CollisionAvoidance(collision, limits.a_min, limits.a_max, 2e-3))
    return _cache[0]


@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-7])
@pytest.mark.parametrize(
    "obstacle",
    [
        lambda o: capsule("it", [0.3, -0.2 + o, 0.0], [0.3, 0.2 + o, 0.0], 0.01),  # crossing
        lambda o: capsule("it", [0.5, o, 0.0], [0.9, o, 0.0], 0.01),  # one in the other
        lambda o: capsule("it", [0.5, 0.2 + o, 0.0], [0.9, 0.2 + o, 0.0], 0.01),  # parallel
        lambda o: sphere("it", [0.7, o, 0.0], 0.01),  # on the axis
        lambda o: box("it", [0.7, o, 0.0], [0.2, 0.2, 0.2]),  # pierced
        lambda o: box("it", [0.7, 0.2 + o, 0.0], [0.1, 0.1, 0.1]),  # parallel to faces and edges
        lambda o: half_space("it", [0.0, o, 0.0], [0.0, 1.0, 0.0]),  # half of it inside
    ],
)
def test_degenerate_places_give_finite_rows(obstacle, offset):
    avoidance, _ = two_links(ROD, 0.2, [obstacle(offset)])
    limit = np.full(2, 20.0)
    for v in (np.zeros(2), np.array([1.0, -2.0])):
        rows = avoidance.rows(np.zeros(2), v, -limit, limit)
        assert np.isfinite(rows.G).all()
        assert np.isfinite(rows.lower).all()
        assert np.isfinite(rows.bias).all()
        assert not np.isnan(avoidance.closest()[0])


@pytest.mark.parametrize(
    "changes, word",
    [
        ({"margin": -0.1}, "margin"),
        ({"margin": float("nan")}, "margin"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, word):
    with pytest.raises(SettingError, match=word):
        CollisionSettings(**changes)


def test_limits_and_steps_that_cannot_be_are_refused():
    _, limits, collision, _ = panda()
    with pytest.raises(SettingError, match="acceleration_max"):
        CollisionAvoidance(collision, limits.a_min, -limits.a_max, 1e-3)
    with pytest.raises(SettingError, match="acceleration_min"):
        CollisionAvoidance(collision, limits.a_min[:3], limits.a_max, 1e-3)
    with pytest.raises(SettingError, match="dt"):
        CollisionAvoidance(collision, limits.a_min, limits.a_max, 0.0)


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
        robot = SimpleNamespace(q=q, v=v)  # all that it looks at
        return avoidance.constraint(robot, AccelerationRange(-bounds, bounds))

    scaled = constraint(q, v, wide)
    np.testing.assert_allclose(scaled.G, ROW_SCALE * G)
    np.testing.assert_allclose(scaled.lower, ROW_SCALE * lower)
    assert np.isposinf(scaled.upper).all()
    for bad in (np.array([np.nan, 0.0]), np.array([0.0, np.inf])):
        assert constraint(bad, v, wide) is None
        assert constraint(q, bad, wide) is None
    unbounded = constraint(q, v, np.full(2, np.inf))
    np.testing.assert_allclose(unbounded.lower, ROW_SCALE * lower)
