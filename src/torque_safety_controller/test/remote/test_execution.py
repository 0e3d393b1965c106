# SPDX-License-Identifier: Apache-2.0
"""How far a trajectory's execution has come."""

import math

import numpy as np
import pytest

from torque_safety_controller.driving.trajectory import JointPoint, JointTrajectory
from torque_safety_controller.remote.execution import Execution, Progress, Tolerances
from viability_bounds_pkg.state import State

FREE = np.full(2, math.inf)
ANY = Tolerances(FREE, FREE)
NEAR = Tolerances(np.array([0.01, 0.02]), FREE)
START, END = np.array([0.1, -0.2]), np.array([0.5, 0.6])
MIDDLE, FASTEST = (START + END) / 2, 1.5 * (END - START) / 2.0  # of the cubic in two seconds
BEGIN = 7_000_000_000


def execution(path=ANY, begin=0):
    trajectory = JointTrajectory([JointPoint(2.0, END)])
    made = Execution(["a", "b"], trajectory, path, NEAR, patience=1.0, begin=begin)
    made.start(State(START, np.zeros(2)), BEGIN)
    return made


def judged(made, t, q, v=(0.0, 0.0)):
    return made.judge(State(np.asarray(q), np.array(v)), BEGIN + round(1e9 * t))


def test_it_begins_where_the_arm_is():
    made = execution()
    assert judged(made, 1.0, START, (0.1, 0.0)) is Progress.MOVING
    np.testing.assert_allclose(made.off, [MIDDLE - START, FASTEST - [0.1, 0.0]], atol=1e-12)


def test_it_is_reached_when_its_time_is_over_and_the_arm_near():
    made = execution()
    assert judged(made, 1.999, END) is Progress.MOVING
    assert judged(made, 2.0, END + [0.0, 0.021]) is Progress.MOVING
    assert made.why == "b is -0.021 rad off; allowed: 0.02"
    assert judged(made, 2.5, END + [0.009, 0.019]) is Progress.REACHED
    assert not made.why


def test_it_is_not_reached_when_patience_ends():
    made = execution()
    assert judged(made, 2.999, END + 0.1) is Progress.MOVING
    assert judged(made, 3.0, END + 0.1) is Progress.NOT_REACHED
    assert made.why == "a is -0.1 rad off; allowed: 0.01"


@pytest.mark.parametrize("part", [0, 1], ids=["position", "velocity"])
def test_it_leaves_its_path(part):
    allowed = [FREE.copy(), FREE.copy()]
    allowed[part][1] = 0.3
    made = execution(Tolerances(*allowed))
    for off, progress in ((0.29, Progress.MOVING), (0.31, Progress.OFF_PATH)):
        state = [MIDDLE, FASTEST]
        state[part] = state[part] + [5.0, off]
        assert judged(made, 1.0, *state) is progress
    assert made.why.startswith("b is -0.31 rad")


def test_one_with_a_time_of_its_own_waits():
    made = execution(NEAR, begin=BEGIN + 1_000_000_000)
    assert judged(made, 0.5, START + 1.0) is Progress.MOVING
    assert judged(made, 1.5, START + 1.0) is Progress.OFF_PATH
    assert judged(made, 2.9, END + 0.1) is Progress.OFF_PATH
    assert judged(made, 3.0, END) is Progress.REACHED
