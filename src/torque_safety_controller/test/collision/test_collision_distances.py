# SPDX-License-Identifier: Apache-2.0
"""Distances and their first and second derivatives, against coal, differences and by hand."""

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
    random_states,
    sphere,
    two_links,
    wide_rows,
)

from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.shapes import capsule
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config

NODE = "controller_node"


def test_distances_are_coals():
    """Every pair of capsules, box and half space, by another implementation."""
    avoidance = everything()
    arm, names = avoidance.model.arm, avoidance.model.names
    data = arm.createData()
    shapes = {shape.name: (shape, arm.frames[0]) for shape in SURROUNDINGS}
    for shape in read(ControllerConfiguration, read_config("panda", NODE)).collision.capsules:
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


def test_a_ball_before_a_wall_by_hand():
    """The wall is x = 1; for the planar arm, x of the hand and its derivatives are known."""
    wall = half_space("wall", [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    avoidance, _ = two_links(BALL, 0.4, [wall], influence=5.0)
    q, v, a = np.array([0.3, 0.4]), np.array([0.7, -0.5]), np.array([1.1, 0.6])
    rows = wide_rows(avoidance, q, v)
    both, speed = q.sum(), v.sum()
    x = 0.5 * np.cos(q[0]) + 0.4 * np.cos(both)
    x_dot = -0.5 * np.sin(q[0]) * v[0] - 0.4 * np.sin(both) * speed
    x_bias = -0.5 * np.cos(q[0]) * v[0] ** 2 - 0.4 * np.cos(both) * speed**2
    J = -np.array([0.5 * np.sin(q[0]) + 0.4 * np.sin(both), 0.4 * np.sin(both)])
    assert rows.distance[0] == pytest.approx(1.0 - x - 0.05)
    assert rows.rate[0] == pytest.approx(-x_dot)
    assert rows.G[0] @ a + rows.bias[0] == pytest.approx(-(J @ a + x_bias))


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
