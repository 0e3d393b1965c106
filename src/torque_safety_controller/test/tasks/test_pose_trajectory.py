import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.tasks.pose_trajectory import (
    PoseTrajectory,
    TrajectoryError,
    TrajectoryPoint,
    circle,
)


def random_points(rng, count=4):
    points, pose, t = [], pin.SE3.Random(), 0.0
    for _ in range(count):
        points.append(TrajectoryPoint(t, pose, rng.normal(size=6), rng.normal(size=6)))
        t += rng.uniform(0.3, 1.0)
        pose = pose * pin.exp6(rng.normal(size=6) * 0.5)
    return points


@pytest.mark.parametrize("seed", range(4))
def test_points_are_met(seed):
    pin.seed(seed)
    points = random_points(np.random.default_rng(seed))
    trajectory = PoseTrajectory(points)
    for k, point in enumerate(points[1:-1], start=1):
        for t in (np.nextafter(point.time, 0.0), point.time):
            pose, twist, rate = trajectory.sample(t)
            R = point.pose.rotation
            assert np.abs(pin.log6(pose.actInv(point.pose)).vector).max() < 1e-9, k
            np.testing.assert_allclose(twist[:3], R.T @ point.velocity[:3], atol=1e-6)
            np.testing.assert_allclose(twist[3:], R.T @ point.velocity[3:], atol=1e-6)
            np.testing.assert_allclose(rate[3:], R.T @ point.acceleration[3:], atol=1e-4)
            classical = rate[:3] + np.cross(twist[3:], twist[:3])
            np.testing.assert_allclose(classical, R.T @ point.acceleration[:3], atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_twist_and_its_rate_are_derivatives(seed):
    pin.seed(seed + 10)
    rng = np.random.default_rng(seed)
    trajectory = PoseTrajectory(random_points(rng))
    h = 1e-5
    for t in rng.uniform(0.05, trajectory.duration - 0.05, 20):
        before, now, after = (trajectory.sample(t + k * h) for k in (-1, 0, 1))
        moved = pin.log6(before[0].actInv(after[0])).vector / (2.0 * h)
        np.testing.assert_allclose(now[1], moved, atol=1e-5, rtol=1e-5)
        np.testing.assert_allclose(
            now[2], (after[1] - before[1]) / (2.0 * h), atol=1e-3, rtol=1e-3
        )


def test_it_rests_before_and_after():
    pin.seed(1)
    points = random_points(np.random.default_rng(1))
    trajectory = PoseTrajectory(points)
    for t, point in ((-1.0, points[0]), (1e3, points[-1])):
        pose, twist, rate = trajectory.sample(t)
        assert pose == point.pose and not twist.any() and not rate.any()


def test_circle_is_closed_and_round():
    start = pin.SE3.Identity()
    trajectory = PoseTrajectory(circle(start, 0.4, 3.0, 2))
    assert trajectory.duration == pytest.approx(6.0)
    places = np.array([trajectory.sample(t)[0].translation for t in np.linspace(0, 6, 500)])
    radius = np.linalg.norm(places - [0.0, 0.0, 0.2], axis=1)
    np.testing.assert_allclose(radius, 0.2, atol=1e-6)
    np.testing.assert_allclose(places[[0, -1]], 0.0, atol=1e-12)
    assert np.abs(places[:, 0]).max() == 0.0


@pytest.mark.parametrize(
    ("times", "broken", "message"),
    [
        ([], None, "no points"),
        ([0.0, 0.0], None, "grow"),
        ([-1.0, 0.0], None, "grow"),
        ([0.0, 1.0], "velocity", r"points\[1\] is not finite"),
        ([0.0, 1.0], "turn", "give points in between"),
    ],
)
def test_bad_points(times, broken, message):
    zero = np.zeros(6)
    points = [TrajectoryPoint(t, pin.SE3.Identity(), zero, zero) for t in times]
    if broken == "velocity":
        points[1] = points[1]._replace(velocity=np.full(6, np.nan))
    if broken == "turn":
        half = pin.SE3(pin.utils.rotate("x", np.pi), np.zeros(3))
        points[1] = points[1]._replace(pose=half)
    with pytest.raises(TrajectoryError, match=message):
        PoseTrajectory(points)
