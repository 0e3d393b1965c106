# SPDX-License-Identifier: Apache-2.0
"""Imperfect robots and the nodes that know what is wrong with them, in lockstep."""

import numpy as np
import pytest
from chain import run_chain
from imperfect import CASES, STIFF, Course, node_values


def play(robot, case, duration, seed=1):
    """Play the begin of a minute of `imperfect.py`; return what came of it."""
    values = node_values(robot, CASES[case], seed)
    course = Course(values["controller_node"], robot, seed)
    values["controller_node"] |= STIFF
    events = [event for event in course.scenario["events"] if event["time"] < duration]
    return run_chain({}, {"duration": duration, "events": events}, values)


@pytest.mark.parametrize(
    ("robot", "case", "duration"),
    [
        pytest.param("talos_left_arm", "outage_stop", 3.0, marks=pytest.mark.long),
        ("baxter_left_arm", "all", 4.0),
    ],
)
def test_no_limit_is_passed_by_a_robot_as_bad_as_declared(robot, case, duration):
    result = play(robot, case, duration)
    assert result.vector("position_violation_rad").max() == 0.0
    assert result.vector("velocity_violation_rad_s").max() == 0.0
    assert result.vector("torque_ratio").max() <= 1.0 + 1e-9
    values = node_values(robot, CASES[case], 1)["controller_node"]
    # The bounds leave TALOS 80 % of its top speed, the rest is for errors and friction.
    assert (np.abs(result.run.v) / values["velocity_max"]).max() > 0.65, "it was hardly driven"
    reach = np.array(values["position_max"]) - values["position_min"]
    nearest = [result.vector(f"{end}_clearance_rad") for end in ("lower", "upper")]
    assert (np.minimum(*nearest) < 0.05 * reach).any(), "no joint came near a limit"
    assert int(result.robot["missed_deadlines_injected"]) > 5
    stopped = int(result.robot["braked_periods"])
    assert stopped > 50 if case == "outage_stop" else stopped == 0
    assert result.refused == 0, "states that can be were taken for others"


def test_without_what_is_done_about_it_a_limit_is_passed():
    result = play("baxter_left_arm", "nothing", 6.0)
    assert result.vector("velocity_violation_rad_s").max() > 0.05
    assert result.refused == 0
