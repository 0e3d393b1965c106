# SPDX-License-Identifier: Apache-2.0
"""What a scenario sends as a trajectory is what the controller follows."""

import numpy as np
import pinocchio as pin
import pytest

from sim_bridge.node.scenario_messages import to_controller
from sim_bridge.scenario.events import TrajectoryGoal, read_trajectory
from sim_bridge.scenario.scenario import Scenario
from torque_safety_controller.node.goal_messages import trajectory_from_message


def received(trajectory, base):
    (message,) = to_controller(Scenario(9.0, (TrajectoryGoal(0.0, trajectory),)), "base", "hand")
    return trajectory_from_message(message.content, "base", "hand", base)


def quaternion(rng):
    q = rng.normal(size=4)
    return (q / np.linalg.norm(q)).tolist()


@pytest.mark.parametrize("seed", range(3))
def test_the_controller_follows_the_trajectory_of_the_scenario(seed):
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
    circle = {
        "start": [1.0, 2.0, 3.0],
        "diameter": 0.6,
        "plane": ["-z", "x"],
        "phase": 0.4,
        "period": 1.5,
        "orientation": quaternion(rng),
    }
    for fields in ({"points": entries}, {"circle": circle}):
        meant = read_trajectory(fields, "")
        followed = received(meant, base)
        assert followed.duration == pytest.approx(meant.duration)
        for t in np.linspace(0.0, meant.duration + 0.5, 41):
            pose = base.actInv(followed.sample(t)[0])
            assert np.abs(pin.log6(pose.actInv(meant.sample(t)[0])).vector).max() < 1e-7
