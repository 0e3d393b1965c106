# SPDX-License-Identifier: Apache-2.0
"""The bounds with the limits and margins of the configured arms."""

import numpy as np
import pytest

from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config


@pytest.mark.parametrize(
    "robot", [pytest.param("baxter_left_arm", marks=pytest.mark.long), "panda"]
)
def test_the_configured_margins_only_narrow_the_bounds(robot):
    values = dict.fromkeys(("acceleration_drift", "position_margin"))
    margins = read_config(robot, "bounds_node")
    assert all(margins[name] for name in values)

    def solver(parameters):
        config = read(BoundsConfiguration, parameters)
        return config.limits, make_bounds(config)

    _, with_margins = solver(margins)
    limits, without = solver(margins | {"acceleration_drift": [], "position_margin": 0.0})
    rng = np.random.default_rng(2)
    q = rng.uniform(limits.q_min, limits.q_max, (2000, len(limits)))
    v = rng.uniform(-limits.v_max, limits.v_max, (2000, len(limits)))
    narrow, wide = with_margins(q, v), without(q, v)
    inside = narrow.viable
    assert inside.mean() > 0.2
    assert (wide.viable | ~inside).all()
    slack = 1e-9  # rad/s^2
    assert (narrow.upper <= wide.upper + slack)[inside].all()
    assert (narrow.lower >= wide.lower - slack)[inside].all()
    assert (narrow.upper < wide.upper - 1e-3)[inside].any()
