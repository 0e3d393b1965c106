# SPDX-License-Identifier: Apache-2.0
"""State-dependent limits on whole arms, racing from limit to limit: faster, nothing broken."""

import numpy as np
import pytest
from arms import load_arm
from controllers import posture_only

from torque_safety_controller.controller import Controller
from torque_safety_controller.qp.constraints import AccelerationRange
from viability_bounds_pkg.estimation.discretisation_margin import discretisation_margin
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.torque_margin import tightened, torque_margins
from viability_bounds_pkg.viability import BoundsSolver

pytestmark = pytest.mark.long

DT = 0.002
RACING = posture_only(2000.0, 90.0)


class Race:
    """An arm that is sent, as hard as it can, to one corner of its range after the other."""

    def __init__(self, name, slower=1.0):
        self.arm = load_arm(name)
        values = read_config(name, "bounds_node")
        a_min, a_max = (np.array(values[f"acceleration_{end}"]) for end in ("min", "max"))
        self.limits = JointLimits(
            values["joints"],
            self.arm.q_min,
            self.arm.q_max,
            slower * self.arm.v_max,
            a_min,
            a_max,
        )
        self.peak = 3.0 * np.maximum(-a_min, a_max)
        jerk = discretisation_margin(
            self.arm.model,
            self.arm.q_min,
            self.arm.q_max,
            self.limits.v_max,
            -self.peak,
            self.peak,
            self.arm.tau_max,
            DT,
            2000,
        ).jerk
        self.margins = torque_margins(1.1 * jerk, DT)
        self.tight = tightened(self.limits, self.margins)

    def worst_case(self):
        return BoundsSolver(self.tight, 2 * DT, self.margins.acceleration, DT)

    def state_dependent(self):
        return StateDependentBounds(
            self.arm.model,
            self.tight,
            self.arm.tau_max,
            self.peak,
            2 * DT,
            self.margins.acceleration,
            DT,
            self.margins.position,
        )

    def run(self, solver, steps, seed):
        """Return distances to the goal, shape (steps, n), worst violations, and relaxations."""
        arm, limits = self.arm, self.limits
        controller = Controller(arm.robot(DT), arm.tau_max, RACING)
        rng = np.random.default_rng(seed)
        q, v = arm.q_start.copy(), np.zeros(arm.n)
        controller.reset(q)
        distances, broken, relaxed = [], np.zeros(2), 0
        for k in range(steps):
            if k % 300 == 0:
                goal = np.where(rng.random(arm.n) < 0.5, arm.q_min, arm.q_max)
                goal = np.clip(goal, -2.0, 2.0)
                controller.set_posture_goal(goal)
            bounds = solver.bounds(q, v)
            step = controller.step(State(q, v), AccelerationRange(bounds.lower, bounds.upper))
            relaxed += step.relaxation is not None
            q, v = arm.move(q, v, step.tau, DT, 2)
            broken[0] = max(broken[0], (q - limits.q_max).max(), (limits.q_min - q).max())
            broken[1] = max(broken[1], (np.abs(v) - limits.v_max).max())
            distances.append(np.abs(q - goal))
        return np.array(distances), broken, relaxed


@pytest.fixture(scope="module")
def panda():
    return Race("panda")


def test_faster_with_nothing_broken(panda):
    steps, seed = 3000, 1
    ours = panda.state_dependent()
    near, broken, relaxed = panda.run(ours, steps, seed)
    assert broken.max() <= 0.0 and relaxed == 0
    assert ours.outcomes["certified"] > 20
    assert ours.outcomes["outside"] == 0
    usual, broken, relaxed = panda.run(panda.worst_case(), steps, seed)
    assert broken.max() <= 0.0 and relaxed == 0
    assert near.mean() < 0.995 * usual.mean()
