"""Circles and points: what is between them, and whether their derivatives are those."""

import math

import numpy as np
import pytest
from pinocchio import Quaternion, log3

from sim_bridge.scenario import pose_path
from sim_bridge.scenario.pose_path import PathPoint, angle_between, circle, sample

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
CENTRE = np.array([0.3, 0.2, 0.1])
# Two axes at right angles, neither along x, y or z.
E_1, E_2 = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])


def make(**changes):
    given = {"period": 2.0, "turns": 2.0, "phase": 0.7} | changes
    return circle(CENTRE, 0.2, (E_1, E_2), UPRIGHT, **given)


def angles(points, phase=0.7):
    out = np.array([point.position for point in points]) - CENTRE
    return np.unwrap(np.arctan2(out @ E_2, out @ E_1)) - phase


@pytest.mark.parametrize("ramp", [None, 0.5, 4.0])
def test_a_circle_goes_round_from_rest_to_rest(ramp):
    points = make(ramp=ramp)
    out = np.array([point.position for point in points]) - CENTRE
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 0.2, rtol=1e-12)
    np.testing.assert_allclose(out @ np.cross(E_1, E_2), 0.0, atol=1e-15)
    turned = angles(points)
    assert turned[0] == pytest.approx(0.0, abs=1e-12)
    assert turned[-1] == pytest.approx(4.0 * math.pi)
    assert (np.diff(turned) > 0.0).all()
    for end in (points[0], points[-1]):
        np.testing.assert_allclose((end.velocity, end.acceleration), 0.0, atol=1e-12)
    assert points[-1].time == pytest.approx(4.0 + (ramp or 0.0))
    speed = max(np.linalg.norm(point.velocity) for point in points)
    # A ramp reaches the speed of one turn a period; the quintic peaks at 15/8 of its mean.
    expected = 0.2 * math.pi * (15.0 / 8.0 if ramp is None else 1.0)
    assert speed == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("ramp", [None, 0.5])
def test_velocities_and_accelerations_are_derivatives(monkeypatch, ramp):
    coarse = make(ramp=ramp, turns=1.0)
    monkeypatch.setattr(pose_path, "POINTS_PER_TURN", 10_000)
    points = make(ramp=ramp, turns=1.0)
    t, p, v, a = (
        np.array([getattr(point, name) for point in points])
        for name in ("time", "position", "velocity", "acceleration")
    )
    np.testing.assert_allclose(np.gradient(p, t, axis=0)[1:-1], v[1:-1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(v, t, axis=0)[1:-1], a[1:-1], atol=1e-5)
    # What the few points of a message stand for is the same curve.
    for k in range(0, len(t), 37):
        place, orientation = sample(coarse, t[k])
        np.testing.assert_allclose(place, p[k], atol=1e-7)
        np.testing.assert_array_equal(orientation, UPRIGHT)


def test_between_points_it_turns_about_one_axis_from_rest_to_rest():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = (q / np.linalg.norm(q) for q in rng.normal(size=(2, 4)))
        points = [PathPoint(1.0, (0, 0, 0), tuple(a)), PathPoint(3.0, (1, 2, 3), tuple(b))]
        whole = log3((Quaternion(a).inverse() * Quaternion(b)).matrix())
        assert angle_between(a, b) == pytest.approx(np.linalg.norm(whole))
        for t, share in ((0.0, 0.0), (1.0, 0.0), (2.0, 0.5), (3.0, 1.0), (9.0, 1.0)):
            place, orientation = sample(points, t)
            turned = log3((Quaternion(a).inverse() * Quaternion(orientation)).matrix())
            np.testing.assert_allclose(turned, share * whole, atol=1e-6)
            np.testing.assert_allclose(place, share * np.array([1, 2, 3]), atol=1e-12)
        slow = sample(points, 1.0 + 1e-3)[1]
        assert angle_between(a, slow) < 1e-8
