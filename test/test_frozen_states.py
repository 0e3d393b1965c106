# SPDX-License-Identifier: Apache-2.0
"""States that freeze at any moment, also while the arm stands and goals go on."""

from contextlib import closing

import numpy as np
import pytest
from direct import DirectLoop

from sim_bridge.nodes.bullet_parameters import make_stop
from torque_safety_controller.node.assembly import make_state_check
from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.safety.rate_watch import RateWatch
from viability_bounds_pkg.state import State

HASTE = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
SECONDS, FREEZE, APART, GOALS = 12.5, 0.6, 3.5, 2.0  # s


def play(robot: str, seed: int, told: bool = True) -> tuple[float, float, list[float], int]:
    """Return how far limits were passed, after how long freezes were told, and how often not.

    With goals `GOALS` apart the arm stands in about half of the freezes when they begin. States
    that are refused are not answered, and the robot stops itself.
    """
    rng = np.random.default_rng(seed)
    loop = DirectLoop(robot, HASTE)
    config, arm, law = loop.config, loop.robot, make_stop(loop.config)
    check = make_state_check(loop._controller_configuration(), loop.model, None)
    watch, low, high = RateWatch(config.dt, 1), config.position_min, config.position_max
    tau, in_row, answered = np.zeros(low.size), 0, 0.0
    begins = 2.0 + APART * np.arange(int((SECONDS - 2.0) / APART)) + rng.uniform(0.0, 0.5)
    frozen, after, missed = None, {}, 0
    with closing(arm):
        for k in range(round(SECONDS / config.dt)):
            t = k * config.dt
            if k % round(GOALS / config.dt) == 0:
                goal, side = rng.uniform(low, high), rng.random(low.size)
                goal = np.where(side < 0.3, low, np.where(side < 0.6, high, goal))
                loop.controller.set_posture_goal(goal)
            q, v, _ = arm.state()
            state = State(q.copy(), v.copy())
            now = np.flatnonzero((begins <= t) & (t < begins + FREEZE))
            frozen = (frozen or state) if now.size else None
            state = frozen or state
            wrong = check.look(state, 1.0 + t) if told else ""
            if wrong:
                watch.slow(wrong)
                in_row += 1
                if now.size:
                    after.setdefault(int(now[0]), t - begins[now[0]])
            else:
                in_row = 0
                watch.note(t - answered)
                answered, loop.controller.share = t, watch.share
                bounds = AccelerationRange(*loop.bounds(*state)[:2])
                tau = loop.controller.step(state, bounds, config.dt).tau
                check.expect(loop.controller.expected())
            if in_row > config.command_timeout:
                arm.stop(law, config.substeps)
            elif in_row or arm.returning:
                arm.follow(law, tau, config.substeps)
            else:
                arm.step(tau, config.substeps)
        monitor = arm.monitor
        missed = len(begins) - len(after)
        farthest = monitor.max_position_violation.max(), monitor.max_velocity_violation.max()
        return float(farthest[0]), float(farthest[1]), list(after.values()), missed


@pytest.mark.parametrize(
    "robot", [pytest.param("panda", marks=pytest.mark.long), "baxter_left_arm"]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_they_are_told_before_a_limit_is_passed(robot, seed):
    position, speed, after, missed = play(robot, seed)
    # At a speed limit the arm goes on for as long as it takes to tell.
    assert position == 0.0 and speed < 0.05
    assert missed == 0 and max(after) < 0.1


@pytest.mark.long
def test_untold_they_pass_limits():
    position, speed, *_ = play("panda", 0, told=False)
    assert position > 0.1 or speed > 0.5
