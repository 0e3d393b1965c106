# SPDX-License-Identifier: Apache-2.0
"""The controller node with collision avoidance: what it says, and what it does."""

import numpy as np
import pytest
from arms import load_arm
from controller_chain import NODE, ControllerChain
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log

from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

ARM = load_arm("panda")
VALUES = read_config("panda", NODE) | {
    "bounds_timeout": 20.0,
    "state_timeout": 40.0,
    "collision_avoidance": True,
    "obstacles": [
        "{name: ball, shape: sphere, size: [0.2, 0.2, 0.2], position: [0.42, 0.0, 0.6]}"
    ],
}
AWAY = ARM.q_start + np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


class Talk(ControllerChain):
    """The other side of the controller, and what this says."""

    def __init__(self, ros) -> None:
        self.said = []
        ros.probe.create_subscription(Log, "/rosout", self.said.append, 100)
        ros.hears("/rosout", 1)
        super().__init__(ros, VALUES)

    def answer(self, stamp, q) -> np.ndarray:
        """The torques for a state at rest with this stamp, ms."""

        def ask():
            self.send_limits(stamp, np.full(ARM.n, -2.0), np.full(ARM.n, 2.0))
            self.send_state(stamp, q, np.zeros(ARM.n))

        return np.array(self.await_command(stamp, ask).effort)


def test_an_overlap_is_reported_and_countered_until_it_is_over(ros):
    talk = Talk(ros)
    tau = talk.answer(10, ARM.q_start)
    assert (np.abs(tau) <= ARM.tau_max).all()
    robot = ARM.robot()
    robot.update(State(ARM.q_start, np.zeros(ARM.n)), np.zeros(ARM.n))
    assert np.abs(tau - robot.h).max() > 0.1, "it does not move out"
    ros.wait_until(lambda: "nearer than" in ros.reported(NODE, "message"), "a report")
    report = ros.diagnostics[NODE]
    assert report["level"] == DiagnosticStatus.WARN
    assert report["closest_pair"] == "panda_link7 - ball"
    assert float(report["closest_distance_m"]) == pytest.approx(-0.034, abs=1e-3)
    assert int(report["collision_rows"]) > 0
    assert report["collision_viable"] == "False"
    assert int(report["collision_not_viable_steps"]) == 1
    tau = talk.answer(220, AWAY)  # after a gap, elsewhere
    assert (np.abs(tau) <= ARM.tau_max).all()
    ros.wait_until(lambda: ros.reported(NODE, "closest_pair") != "panda_link7 - ball", "a report")
    report = ros.diagnostics[NODE]
    assert "nearer than" not in report["message"]
    assert report["collision_viable"] == "True"
    text = " ".join(message.msg for message in talk.said)
    for part in (
        f"collision avoidance keeps {report['collision_pairs']} pairs of shapes 0.02 m apart",
        "not kept apart, as near each other in collision_posture: panda_link7 - panda_link5",
    ):
        assert part in text, text
