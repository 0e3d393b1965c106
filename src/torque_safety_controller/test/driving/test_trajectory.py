# SPDX-License-Identifier: Apache-2.0
"""Trajectories of the joints: between points, at their ends, from a state, refused."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import BPoly

from torque_safety_controller.driving.trajectory import (
    JointPoint,
    JointTrajectory,
    JointTrajectoryError,
    TrajectoryMotion,
    TrajectoryPassed,
)
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, TrajectoryPoint
from viability_bounds_pkg.state import State

RNG = np.random.default_rng(3)
TIMES = np.cumsum(RNG.uniform(0.2, 1.0, 6))
PARTS = RNG.normal(size=(3, 6, 4))  # q, v, a


@pytest.mark.parametrize("parts", [2, 3])
def test_between_points_it_is_the_polynomial_that_meets_both(parts):
    points = [JointPoint(t, *each) for t, *each in zip(TIMES, *PARTS[:parts], strict=True)]
    trajectory = JointTrajectory(points)
    meant = BPoly.from_derivatives(TIMES, np.stack(PARTS[:parts], axis=1))
    for t in np.linspace(TIMES[0], TIMES[-1] - 1e-9, 50):
        for k, found in enumerate(trajectory.sample(t)):
            np.testing.assert_allclose(found, meant.derivative(k)(t) if k else meant(t), atol=1e-8)


def test_positions_alone_are_joined_without_overshoot_from_rest_to_rest():
    q = np.array([0.0, 1.0, 1.0, 0.2, 0.1])
    trajectory = JointTrajectory([JointPoint(k, q[k : k + 1]) for k in range(5)])
    for k in range(4):
        inside = np.array([trajectory.sample(t)[0][0] for t in np.linspace(k, k + 1, 30)])
        assert inside.min() > min(q[k : k + 2]) - 1e-12
        assert inside.max() < max(q[k : k + 2]) + 1e-12
    for t in (0.0, 4.0 - 1e-9):
        assert abs(trajectory.sample(t)[1][0]) < 1e-6


def test_it_begins_at_the_state_and_stays_at_its_end():
    points = [JointPoint(t, *each) for t, *each in zip(TIMES, *PARTS, strict=True)]
    state = State(np.full(4, 0.3), np.full(4, -0.2))
    trajectory = JointTrajectory(points).from_state(state)
    q, v, _ = trajectory.sample(0.0)
    np.testing.assert_allclose((q, v), state)
    q, v, a = trajectory.sample(TIMES[-1] + 1.0)
    np.testing.assert_array_equal(q, PARTS[0, -1])
    assert not v.any() and not a.any()


@pytest.mark.parametrize("first", [0.0, 0.5])
def test_continuous_joints_go_to_the_nearest_turn_of_the_first_point(first):
    q = np.array([[0.1, 0.1], [0.3, 0.3]])
    points = [JointPoint(first + k, q[k]) for k in range(2)]
    state = State(np.array([2.0 * np.pi, 2.0 * np.pi]), np.zeros(2))
    moved = JointTrajectory(points).from_state(state, np.array([True, False]))
    for k in range(2):
        np.testing.assert_allclose(
            moved.sample(first + k)[0], q[k] + [2.0 * np.pi, 0.0], atol=1e-12
        )


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([], "points is empty"),
        ([(0.5, [0.0]), (0.5, [1.0])], r"points\[1\].time is 0.5; allowed: more than 0.5"),
        ([(-0.5, [0.0])], r"points\[0\].time is -0.5"),
        ([(0.5, [0.0]), (1.0, [np.nan])], r"points\[1\] is not finite"),
        ([(0.5, [0.0]), (1.0, [1.0], [0.0])], r"points\[1\] has other parts"),
        ([(0.5, [0.0]), (0.5 + 1e-6, [1.0])], "faster than 1000 rad/s"),
        ([(0.5, [0.0], [1e308]), (1.0, [1.0], [-1e308])], "faster than 1000 rad/s"),
    ],
)
def test_refused(points, reason):
    with pytest.raises(JointTrajectoryError, match=reason), np.errstate(all="ignore"):
        JointTrajectory([JointPoint(t, *map(np.array, parts)) for t, *parts in points])


# Late ones

LATE = [(0.2, 0.0, ""), (3.0, None, ""), (3.0, 0.0, "away from"), (8.0, None, "has ended")]


def refused(why):
    return pytest.raises(TrajectoryPassed, match=why) if why else nullcontext()


@pytest.mark.parametrize(("late", "q", "why"), LATE)
def test_a_late_one_is_joined_only_where_the_joints_are(late, q, why):
    points = [JointPoint(t, np.array([q]), np.zeros(1)) for t, q in ((2.0, 0.9), (6.0, 1.2))]
    trajectory = JointTrajectory(points)
    at = trajectory.sample(late)[0] + 0.05 if q is None else np.array([q])
    with refused(why):
        trajectory.check_late(late, State(at, np.zeros(1)))


@pytest.mark.parametrize(("late", "x", "why"), LATE)
def test_a_late_one_is_joined_only_where_the_hand_is(late, x, why):
    places = ((0.0, 0.0), (2.0, 0.9), (6.0, 1.2))
    points = [
        TrajectoryPoint(t, pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])), np.zeros(6), np.zeros(6))
        for t, x in places
    ]
    trajectory, at = PoseTrajectory(points), pin.SE3.Identity()
    if x is None:
        at.translation = trajectory.sample(late)[0].translation + 0.02
    controller = SimpleNamespace(robot=SimpleNamespace(pose=at))
    begin = 10**9
    with refused(why):
        TrajectoryMotion(trajectory, begin).check_late(
            controller, State(np.zeros(1), np.zeros(1)), begin + round(1e9 * late)
        )
