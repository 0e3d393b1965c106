# SPDX-License-Identifier: Apache-2.0
"""A robot that adds the torque against gravity by itself moves as one that does not."""

import numpy as np
import pinocchio as pin
import pytest
from chain import load_node_values, load_values, run_chain
from test_chain import assert_no_limit_broken

from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf

WITHOUT = {"command_includes_gravity": False, "effort_includes_gravity": False}


def goals(values):
    """Return two postures, one after the other."""
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    for time, share in ((0.0, 0.3), (0.6, 0.6)):
        q = low + share * (high - low)
        posture = dict(zip(values["joints"], q.tolist(), strict=True))
        yield {"time": time, "posture": posture}


def test_the_arm_moves_the_same():
    values = load_values("panda") | {"rate_hz": 500.0}
    scenario = {"duration": 1.2, "events": list(goals(values))}
    whole, rest = (run_chain(values | more, scenario, {}) for more in ({}, WITHOUT))
    assert_no_limit_broken(rest)
    assert np.abs(whole.run.v).max() > 0.5
    # The part against gravity follows the arm within a period, instead of being held.
    np.testing.assert_allclose(rest.run.q, whole.run.q, atol=5e-3)  # rad
    model = build_model(read_urdf(values["robot_description"]), values["joints"])
    held = pin.computeGeneralizedGravity(model, model.createData(), whole.run.q[0])
    np.testing.assert_allclose(whole.run.tau[0] - rest.run.tau[0], held, atol=1e-2)  # N m


@pytest.mark.long
def test_an_imperfect_robot_keeps_its_limits():
    nodes = load_node_values("panda", "imperfect/panda")
    values = nodes["bounds_node"]
    scenario = {"duration": 2.0, "events": list(goals(values))}
    per_node = {name: own | WITHOUT for name, own in nodes.items()}
    result = run_chain({}, scenario, per_node)
    assert_no_limit_broken(result)
