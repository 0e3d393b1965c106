"""What a scenario sends as a trajectory is what the controller follows."""

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.nodes.scenario_messages import to_controller
from sim_bridge.scenario.events import TrajectoryGoal
from sim_bridge.scenario.pose_path import circle, sample
from sim_bridge.scenario.scenario import Scenario
from sim_bridge.scenario.trajectory import read_points
from torque_safety_controller.node.goals import trajectory_from_message
from torque_safety_controller.tasks import pose_trajectory


def received(points, base):
    (letter,) = to_controller(Scenario(9.0, (TrajectoryGoal(0.0, points),)), "base", "hand")
    return trajectory_from_message(letter.message, "base", "hand", base)


def quaternion(rng):
    q = rng.normal(size=4)
    return (q / np.linalg.norm(q)).tolist()


def test_a_circle_is_that_of_the_controller():
    pose = pin.SE3(pin.exp3(np.array([0.3, -1.0, 0.5])), np.array([0.4, 0.3, 0.2]))
    orientation = pin.Quaternion(pose.rotation).coeffs()
    expected = pose_trajectory.circle(pose, 0.4, 3.0, 2)
    # From the lowest point, towards y.
    points = read_points(
        {
            "circle": {
                "start": pose.translation.tolist(),
                "diameter": 0.4,
                "plane": ["y", "z"],
                "phase": -0.5 * np.pi,
                "period": 3.0,
                "turns": 2,
                "orientation": orientation.tolist(),
            }
        },
        "",
    )
    assert len(points) == len(expected)
    for ours, theirs in zip(points, expected, strict=True):
        assert ours.time == pytest.approx(theirs.time)
        np.testing.assert_allclose(ours.position, theirs.pose.translation, atol=1e-12)
        np.testing.assert_allclose(ours.velocity, theirs.velocity[:3], atol=1e-12)
        np.testing.assert_allclose(ours.acceleration, theirs.acceleration[:3], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_controller_passes_where_the_report_expects_it(seed):
    rng = np.random.default_rng(seed)
    base = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    entries = [
        {
            "time": 0.5 + k,
            "position": rng.normal(size=3).tolist(),
            "orientation": quaternion(rng),
            "velocity": rng.normal(size=3).tolist(),
            "acceleration": rng.normal(size=3).tolist(),
        }
        for k in range(4)
    ]
    points = read_points({"points": entries}, "")
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    for path in (points, circle([1.0, 2.0, 3.0], 0.3, axes, quaternion(rng), period=1.5)):
        trajectory = received(path, base)
        for t in np.linspace(0.0, path[-1].time + 0.5, 41):
            position, orientation = sample(path, t)
            pose = base.actInv(trajectory.sample(t)[0])
            np.testing.assert_allclose(pose.translation, position, atol=1e-9)
            x, y, z, w = orientation
            turn = pose.rotation.T @ pin.Quaternion(w, x, y, z).matrix()
            assert np.linalg.norm(pin.log3(turn)) < 1e-6
