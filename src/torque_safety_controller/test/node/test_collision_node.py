# SPDX-License-Identifier: Apache-2.0
"""The controller node with collision avoidance: what it says, and what it does."""

import numpy as np
import pytest
from arms import load_arm
from controller_chain import NODE, ControllerChain, patient_values
from diagnostic_msgs.msg import DiagnosticStatus

from viability_bounds_pkg.state import State

ARM = load_arm("panda")
BALL = "{name: ball, shape: sphere, size: [0.2, 0.2, 0.2], position: [0.42, 0.0, 0.6]}"
AWAY = ARM.q_start + np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_an_overlap_is_reported_and_countered_until_it_is_over(ros, capfd):
    chain = ControllerChain(
        ros, patient_values("panda", collision_avoidance=True, obstacles=[BALL])
    )
    at_rest = np.zeros(ARM.n)
    tau = np.array(chain.ask(10, ARM.q_start, at_rest, -2.0, 2.0).effort)
    assert (np.abs(tau) <= ARM.tau_max).all()
    robot = ARM.robot()
    robot.update(State(ARM.q_start, at_rest), at_rest)
    assert np.abs(tau - robot.h).max() > 0.1, "it does not move out"
    ros.wait_until(lambda: "nearer than" in chain.reported("message"), "a report")
    report = ros.diagnostics[NODE]
    assert report["level"] == DiagnosticStatus.WARN
    assert report["closest_pair"] == "panda_link7 - ball"
    assert float(report["closest_distance_m"]) == pytest.approx(-0.034, abs=1e-3)
    assert int(report["collision_rows"]) > 0
    assert report["collision_viable"] == "False"
    assert int(report["collision_not_viable_steps"]) == 1
    tau = np.array(chain.ask(220, AWAY, at_rest, -2.0, 2.0).effort)  # after a gap, elsewhere
    assert (np.abs(tau) <= ARM.tau_max).all()
    ros.wait_until(lambda: chain.reported("closest_pair") != "panda_link7 - ball", "a report")
    report = ros.diagnostics[NODE]
    assert "nearer than" not in report["message"]
    assert report["collision_viable"] == "True"
    said = capfd.readouterr().err
    for part in (
        f"collision avoidance keeps {report['collision_pairs']} pairs of shapes 0.02 m apart",
        "not kept apart, as near each other in collision_posture: panda_link7 - panda_link5",
    ):
        assert part in said
