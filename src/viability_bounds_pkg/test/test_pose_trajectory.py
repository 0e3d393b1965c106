# SPDX-License-Identifier: Apache-2.0
"""Trajectories of the end effector meet their points, smoothly."""

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.pose_trajectory import (
    PoseTrajectory,
    TrajectoryError,
    TrajectoryPoint,
    circle,
)


def random_points(seed):
    pin.seed(seed)
    rng = np.random.default_rng(seed)
    points, pose, t = [], pin.SE3.Random(), 0.5
    for _ in range(5):
        points.append(TrajectoryPoint(t, pose, rng.normal(size=6), rng.normal(size=6)))
        t += rng.uniform(0.3, 1.0)
        pose = pose * pin.exp6(rng.normal(size=6) * 0.5)
    return points


def distance(one, other):
    return np.abs(pin.log6(one.actInv(other)).vector).max()


def test_points_are_met():
    points = random_points(0)
    trajectory = PoseTrajectory(points)
    for point in points[1:-1]:
        for t in (np.nextafter(point.time, 0.0), point.time):
            pose, twist, rate = trajectory.sample(t)
            R = point.pose.rotation
            assert distance(pose, point.pose) < 1e-9
            np.testing.assert_allclose(twist[:3], R.T @ point.velocity[:3], atol=1e-6)
            np.testing.assert_allclose(twist[3:], R.T @ point.velocity[3:], atol=1e-6)
            np.testing.assert_allclose(rate[3:], R.T @ point.acceleration[3:], atol=1e-4)
            classical = rate[:3] + np.cross(twist[3:], twist[:3])
            np.testing.assert_allclose(classical, R.T @ point.acceleration[:3], atol=1e-4)


def test_twist_and_its_rate_are_derivatives():
    trajectory, h = PoseTrajectory(random_points(10)), 1e-5
    for t in np.random.default_rng(0).uniform(0.55, trajectory.duration - 0.05, 40):
        before, now, after = (trajectory.sample(t + k * h) for k in (-1, 0, 1))
        moved = pin.log6(before[0].actInv(after[0])).vector / (2.0 * h)
        np.testing.assert_allclose(now[1], moved, atol=1e-5, rtol=1e-5)
        change = (after[1] - before[1]) / (2.0 * h)
        np.testing.assert_allclose(now[2], change, atol=1e-5, rtol=1e-5)


def test_between_points_at_rest_it_turns_about_one_axis():
    first = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.9])), np.array([1.0, 0.0, 0.0]))
    turn, way = np.array([1.0, -2.0, 0.5]), np.array([0.1, 0.2, -0.3])
    second = pin.SE3(first.rotation @ pin.exp3(turn), first.translation + way)
    trajectory = PoseTrajectory([TrajectoryPoint(1.0, first), TrajectoryPoint(3.0, second)])
    # Quintics from rest to rest, before and after which it rests.
    for t, share in ((-1.0, 0.0), (1.5, 0.103515625), (2.0, 0.5), (3.0, 1.0), (99.0, 1.0)):
        pose = trajectory.sample(t)[0]
        turned = pin.log3(first.rotation.T @ pose.rotation)
        np.testing.assert_allclose(turned, share * turn, atol=1e-6)
        np.testing.assert_allclose(pose.translation - first.translation, share * way, atol=1e-9)


def test_a_circle_goes_round_from_rest_to_rest():
    """Its velocities and accelerations are derivatives."""
    # Two axes at right angles, neither along x, y or z.
    e_1, e_2 = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    start = pin.SE3(pin.exp3(np.array([0.3, -1.0, 0.5])), np.array([0.4, 0.3, 0.2]))
    points = circle(start, 0.2, (e_1, e_2), period=2.0, turns=2.0, points_per_turn=3000)
    t = np.array([point.time for point in points])
    p = np.array([point.pose.translation for point in points])
    v = np.array([point.velocity[:3] for point in points])
    a = np.array([point.acceleration[:3] for point in points])
    outward = p - (start.translation - 0.2 * e_1)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 0.2, rtol=1e-12)
    np.testing.assert_allclose(outward @ np.cross(e_1, e_2), 0.0, atol=1e-15)
    np.testing.assert_allclose(outward[0], 0.2 * e_1, atol=1e-15)
    angles = np.unwrap(np.arctan2(outward @ e_2, outward @ e_1))
    assert (t[-1], angles[-1]) == pytest.approx((4.0, 4.0 * np.pi))
    assert (np.diff(angles) > 0.0).all()
    np.testing.assert_allclose((v[0], a[0], v[-1], a[-1]), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.gradient(p, t, axis=0)[1:-1], v[1:-1], atol=4e-6)
    np.testing.assert_allclose(np.gradient(v, t, axis=0)[1:-1], a[1:-1], atol=4e-5)
    # The few points of a message make the same curve.
    coarse = PoseTrajectory(circle(start, 0.2, (e_1, e_2), period=2.0, turns=2.0))
    for k in range(0, len(t), 37):
        pose = coarse.sample(t[k])[0]
        np.testing.assert_allclose(pose.translation, p[k], atol=1e-7)
        np.testing.assert_allclose(pose.rotation, start.rotation, atol=1e-12)


HALF_TURN = pin.SE3(pin.utils.rotate("x", np.pi), np.zeros(3))


@pytest.mark.parametrize(
    ("times", "last", "message"),
    [
        ([], {}, "at least one point"),
        ([0.5, 0.5], {}, r"points\[1\].time is 0.5; allowed: more than 0.5"),
        ([-1.0, 0.0], {}, r"points\[0\].time is -1; allowed: at least 0"),
        ([0.0, 1.0], {"velocity": np.full(6, np.nan)}, r"points\[1\] is not finite"),
        ([0.0, 1.0], {"pose": HALF_TURN}, r"points\[1\] is turned by 3.14 rad"),
    ],
)
def test_points_that_make_no_trajectory_are_refused(times, last, message):
    points = [TrajectoryPoint(t, pin.SE3.Identity()) for t in times]
    points[1:] = [point._replace(**last) for point in points[1:]]
    with pytest.raises(TrajectoryError, match=message):
        PoseTrajectory(points)
