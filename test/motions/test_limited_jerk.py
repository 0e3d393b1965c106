# SPDX-License-Identifier: Apache-2.0
"""An arm whose jerk is limited, driven to its limits by all nodes in lockstep."""

import numpy as np
import pytest
import yaml
from chain import load_node_values, run_chain
from test_chain import assert_no_limit_broken

from torque_safety_controller.node.periodic import JointCommands
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.testing.ros_harness import config_folder

JERK = 1000.0  # rad/s^3
ELBOW, LIMIT = 3, -3.0718  # rad


def panda(**of_controller):
    values = load_node_values("panda")
    values["bounds_node"]["jerk_max"] = [JERK] * 7
    values["controller_node"] |= {"disturbance_time": 0.0} | of_controller
    return values


def to_the_elbow_s_limit():
    path = config_folder() / "scenarios" / "panda_demo.yaml"
    return {"duration": 0.8, "events": yaml.safe_load(path.read_text())["events"][:1]}


def test_jerk_and_limits_are_kept(monkeypatch):
    told, tell = [], JointCommands.accelerations

    def record(self, a, stamp):
        told.append(a)
        tell(self, a, stamp)

    monkeypatch.setattr(JointCommands, "accelerations", record)
    values = panda()
    result = run_chain({}, to_the_elbow_s_limit(), values, declared=True)
    assert_no_limit_broken(result)
    jerk = values["bounds_node"]["rate_hz"] * np.abs(np.diff(told, axis=0))
    assert 0.999 * JERK < jerk.max() <= JERK * (1.0 + 1e-9)
    assert LIMIT < result.run.q[-1, ELBOW] < LIMIT + 1e-3
    assert np.abs(result.run.v[:, ELBOW]).max() > 1.0  # rad/s


@pytest.mark.parametrize("name", ["disturbance_time", "safety_filter", "collision_avoidance"])
def test_what_knows_nothing_of_the_jerk_is_refused(name):
    values = panda(**{name: 0.01 if name == "disturbance_time" else True})
    with pytest.raises(SettingError, match=f"'{name}' is .* where bounds_node has jerk_max"):
        run_chain({}, to_the_elbow_s_limit(), values, declared=True)
