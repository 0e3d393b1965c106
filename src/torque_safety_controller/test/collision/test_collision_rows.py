# SPDX-License-Identifier: Apache-2.0
"""Distances, against coal and finite differences, and the rows of the QP that keep them."""

import numpy as np
import pinocchio as pin
import pytest
from collision_arm import (
    BALL,
    ROD,
    SURROUNDINGS,
    box,
    everything,
    half_space,
    panda,
    panda_avoidance,
    random_states,
    sphere,
    two_links,
    wide_rows,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.controller import Controller
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.shapes import capsule
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.viability import BoundsSolver

LIMIT = np.full(2, 20.0)  # rad/s^2
KEPT = 0.022  # m; the margin with its reserve


# Distances and their derivatives


def test_distances_are_coals():
    """Every pair of capsules, box and half space, by another implementation."""
    avoidance = everything()
    arm, names = avoidance.model.arm, avoidance.model.names
    data = arm.createData()
    shapes = {shape.name: (shape, arm.frames[0]) for shape in SURROUNDINGS}
    for shape in read(
        ControllerConfiguration, read_config("panda", "controller_node")
    ).collision.capsules:
        shapes[shape.name] = (shape, arm.frames[arm.getFrameId(shape.name)])
    geometry = pin.GeometryModel()
    index = {
        name: geometry.addGeometryObject(shape.geometry(frame.parentJoint, frame.placement))
        for name, (shape, frame) in shapes.items()
    }
    for name in names:
        geometry.addCollisionPair(pin.CollisionPair(*(index[each] for each in name.split(" - "))))
    found = geometry.createData()
    compared = 0
    for q, v in random_states(30, seed=1):
        wide_rows(avoidance, q, v)
        pin.computeDistances(arm, data, geometry, found, q)
        for name, d, result in zip(names, avoidance.distances, found.distanceResults, strict=True):
            if d == np.inf:
                continue
            shape, other = (shapes[each][0] for each in name.split(" - "))
            # Of a capsule whose axis is inside a box, its ends and the middle of the part inside
            # are measured.
            if other.is_box and d < -shape.radius:
                assert result.min_distance < 0.0
            else:
                # coal goes by GJK for boxes, to 1e-6 m
                tolerance = 2e-6 if other.is_box else 1e-9
                assert d == pytest.approx(result.min_distance, abs=tolerance)
            compared += 1
    assert compared > 1000


def test_rate_and_acceleration_by_finite_differences():
    """Of the closest points of each pair, along motions: curvature and sliding included."""
    avoidance = everything()
    h = 2e-4  # s
    found = avoidance.distances
    compared, off = 0, 0
    rng = np.random.default_rng(2)
    for q, v in random_states(30, seed=3):
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
    assert compared > 1000
    assert off <= compared // 500


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


@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-7])
@pytest.mark.parametrize(
    "obstacle",
    [
        lambda o: capsule("crossing", [0.3, -0.2 + o, 0.0], [0.3, 0.2 + o, 0.0], 0.01),
        lambda o: capsule("inside", [0.5, o, 0.0], [0.9, o, 0.0], 0.01),
        lambda o: capsule("parallel", [0.5, 0.2 + o, 0.0], [0.9, 0.2 + o, 0.0], 0.01),
        lambda o: sphere("on the axis", [0.7, o, 0.0], 0.01),
        lambda o: box("pierced", [0.7, o, 0.0], [0.2, 0.2, 0.2]),
        lambda o: box("parallel faces", [0.7, 0.2 + o, 0.0], [0.1, 0.1, 0.1]),
        lambda o: half_space("half inside", [0.0, o, 0.0], [0.0, 1.0, 0.0]),
    ],
    ids=lambda make: make(0.0).name,
)
def test_degenerate_places_give_finite_rows(obstacle, offset):
    avoidance, _ = two_links(ROD, 0.2, [obstacle(offset)])
    limit = np.full(2, 20.0)
    for v in (np.zeros(2), np.array([1.0, -2.0])):
        rows = avoidance.rows(np.zeros(2), v, -limit, limit)
        assert all(np.isfinite(each).all() for each in (rows.G, rows.lower, rows.bias))
        assert not np.isnan(avoidance.closest()[0])


# Rows


def test_the_bound_is_that_of_a_joint_with_a_lower_limit():
    """A distance moved by a slider alone is a joint: the exact bounds for it must come out."""
    wall = half_space("wall", [2.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    avoidance, _ = two_links(
        BALL, 0.4, [wall], "prismatic", "1 0 0", influence=5.0, speed_max=9.0, dt=0.02
    )
    # The wall limits the slider to 2 - 0.9 - 0.05 less what is kept, with a braking of 2 m/s^2.
    end = 1.05 - KEPT
    exact = BoundsSolver(JointLimits(("slider",), [-np.inf], [end], [1e3], [-2.0], [2.0]), 0.02)
    rng = np.random.default_rng(4)
    braked = 0
    for _ in range(300):
        room = rng.uniform(0.0, 0.2)
        q = np.array([0.0, end - room])
        v = np.array([0.0, rng.uniform(-0.5, 1.0) * np.sqrt(4.0 * room)])
        upper = exact.bounds(q[1:], v[1:]).upper[0]
        rows = wide_rows(avoidance, q, v)
        if upper < 2.0 and rows.viable[0]:
            # But for rounding with wide bounds.
            assert -rows.lower[0] - rows.bias[0] == pytest.approx(upper, abs=2e-3)
            braked += upper < 0.0
    assert braked > 10


def test_of_too_many_rows_the_nearest_are_returned():
    limits, few, every = panda()[1], panda_avoidance(rows_max=3), panda_avoidance(rows_max=1000)
    cut = 0
    for q, v in random_states(60, speed=2.0, seed=8):
        nearest = np.sort(every.rows(q, v, limits.a_min, limits.a_max).distance)
        rows = few.rows(q, v, limits.a_min, limits.a_max)
        np.testing.assert_array_equal(np.sort(rows.distance), nearest[:3])
        cut += len(nearest) > 3
    assert cut > 5


def test_no_row_asks_for_what_the_bounds_do_not_allow():
    avoidance = everything()
    broken = 0
    rng = np.random.default_rng(6)
    for q, v in random_states(80, speed=2.0, seed=7):
        upper = rng.uniform(-2.0, 5.0, len(q))
        lower = upper - rng.uniform(0.0, 5.0, len(q))
        rows = avoidance.rows(q, v, lower, upper)
        most = np.sum(np.maximum(rows.G * lower, rows.G * upper), axis=1)
        assert (rows.lower <= most).all()
        broken += np.count_nonzero(~rows.viable)
    assert broken > 20
    # A wall too fast and too near to be avoided: all that the bounds allow.
    wall = half_space("wall", [0.98, 0.0, 0.0], [-1.0, 0.0, 0.0])
    slider, _ = two_links(BALL, 0.4, [wall], "prismatic", "1 0 0")
    rows = slider.rows(np.zeros(2), np.array([0.0, 3.0]), -LIMIT, LIMIT)
    assert rows.lower[0] == pytest.approx(20.0)
    assert not rows.viable[0]


PANDA = panda_avoidance()
seven = st.lists(st.floats(-1.0, 1.0, allow_nan=False), min_size=7, max_size=7).map(np.array)


@settings(deadline=None, max_examples=100)
@given(seven, seven, st.sampled_from([0.0, 1e-8, 1.0, 50.0]))
def test_rows_are_finite_in_every_state(position, velocity, speed):
    arm, limits, _ = panda()
    q = arm.q_min + (position + 1.0) * 0.5 * (arm.q_max - arm.q_min)
    rows = PANDA.rows(q, speed * velocity, limits.a_min, limits.a_max)
    for array in rows:
        assert np.isfinite(array).all()
    assert rows.G.shape == (len(rows.lower), 7)


def ball_before_a_wall(**changes):
    """An arm in the x-y plane with a ball at its end, and a wall at x = 0.9 m."""
    block = box("block", [1.0, 0.0, 0.0], [0.2, 2.0, 2.0])
    return two_links(BALL, 0.3, [block], dt=4e-3, influence=1.0, **changes)


@pytest.mark.parametrize("beyond", [1e-13, 1e-9, 1e-6])
def test_a_distance_just_beyond_its_limit_is_brought_back_without_a_kick(beyond):
    """Both at rest and on its way in; just inside about the same is asked for."""
    q = np.array([0.9, -0.9])  # the forearm along x: the ball's centre at x = 0.5 cos 0.9 + 0.3
    gap = 0.9 - (0.5 * np.cos(0.9) + 0.3) - 0.05
    for v in (np.zeros(2), np.array([-1e-6, 0.0])):
        asked = []
        for inside in (beyond, -beyond):
            avoidance, _ = ball_before_a_wall(margin=gap - 0.002 + inside)
            rows = avoidance.rows(q, v, -LIMIT, LIMIT)
            asked.append(rows.lower[np.argmin(rows.distance)])
        assert abs(asked[0]) < 2.1 * beyond / 4e-3**2 + 3e-3  # m/s^2
        assert asked[0] == pytest.approx(asked[1], abs=5.0 * beyond / 4e-3**2 + 3e-3)


def test_what_pushes_towards_a_body_is_asked_for_in_addition():
    avoidance, _ = ball_before_a_wall(margin=0.1)
    q, v, wide = np.array([0.6, -0.4]), np.array([-0.5, 0.2]), np.full(2, 5000.0)
    plain = avoidance.rows(q, v, -wide, wide)
    G, lower = plain.G.copy(), plain.lower.copy()
    for e in (np.array([-2.0, 1.0]), np.array([2.0, -1.0])):
        pushed = avoidance.rows(q, v, -wide, wide, e)
        assert len(lower) == len(pushed.lower) > 0
        np.testing.assert_allclose(pushed.lower, lower + np.maximum(-G @ e, 0.0), atol=1e-9)


def test_the_controller_keeps_the_rows_and_survives_states_that_are_not_finite():
    avoidance, model = ball_before_a_wall(margin=0.1)
    goals = Goals(2, Gains(pose_kp=0.0, pose_weight=0.0, posture_kp=1e3, posture_weight=1.0))
    parts = [goals, JointBounds(), avoidance]
    controller = Controller(RobotModel(model, "fore", 4e-3), parts, np.full(2, 1e4))
    q, v, wide = np.array([0.6, -0.4]), np.array([-0.5, 0.2]), np.full(2, 5000.0)
    controller.reset(q)
    goals.set_posture(np.zeros(2))  # the ball in the wall
    for bounds in (wide, np.full(2, np.inf)):
        a = controller.step(State(q, v), AccelerationRange(-bounds, bounds)).a
        rows = avoidance.rows(q, v, -wide, wide)
        assert (rows.G @ a >= rows.lower - 1e-3).all()
        assert (rows.G @ a <= rows.lower + 1e-3).any()
    for bad in (np.array([np.nan, 0.0]), np.array([0.0, np.inf])):
        with np.errstate(all="ignore"):
            step = controller.step(State(bad, v), AccelerationRange(-wide, wide))
        assert step.failure
        assert np.isfinite(step.tau).all()
