# SPDX-License-Identifier: Apache-2.0
"""States that are wrong at any moment of a motion: limits are kept, and the arm goes on."""

from collections.abc import Callable
from contextlib import closing
from typing import NamedTuple

import numpy as np
import pytest
from direct import DirectLoop, posture_at_limits

from sim_bridge.node.bullet_parameters import make_stop
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.ramp import Ramp
from torque_safety_controller.supervisor import Order
from viability_bounds_pkg.node.bounds_parameters import make_plausibility_check
from viability_bounds_pkg.state import State

HASTE = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
LASTS = 0.6  # s of a fault
EVERY = 3.5  # s from one to the next
SECONDS = 9.0

Lie = Callable[[State, State], State]
"""Returns what is said of a state; the second one is that in which the fault began."""

LIES: dict[str, Lie] = {
    "states frozen": lambda state, first: first,
    "positions frozen": lambda state, first: state._replace(q=first.q),
    "a bias of velocities": lambda state, first: state._replace(v=state.v - 1.5),
    "zeros": lambda state, first: State(0.0 * state.q, 0.0 * state.v),
}


class Played(NamedTuple):
    """What happened: how far limits were passed, rad and rad/s, and when faults were told.

    `after` and `again` have for each fault how long it took until a state was refused, and from
    its end until states were accepted, s.
    """

    position: float
    speed: float
    after: list[float]
    again: list[float]


def play(robot: str, seed: int, lie: Lie, checked: bool = True) -> Played:
    """Let faults begin in motion, and treat states as a node does.

    States that are refused are not answered, and the robot stops itself.
    """
    rng = np.random.default_rng(seed)
    loop = DirectLoop(robot, HASTE)
    config, arm, law = loop.config, loop.robot, make_stop(loop.config)
    check = make_plausibility_check(loop._controller_configuration(), None)
    ramp, low, high = Ramp(config.dt), config.position_min, config.position_max
    tau, in_row, answered = np.zeros(low.size), 0, 0.0
    begins = 2.0 + EVERY * np.arange(int((SECONDS - 2.0) / EVERY))
    begins += rng.uniform(0.0, 0.1, begins.size)
    first, after, again = None, {}, {}
    with closing(arm):
        for k in range(round(SECONDS / config.dt)):
            t = k * config.dt
            if k % round(0.7 / config.dt) == 0:
                loop.controller.goals.set_posture(posture_at_limits(rng, low, high))
            q, v, _ = arm.state()
            state = State(q.copy(), v.copy())
            last = int(np.count_nonzero(begins <= t)) - 1
            if last >= 0 and t < begins[last] + LASTS:
                first = first or state
                state = lie(state, first)
            else:
                first = None
            wrong = check.fault(state, 1.0 + t) if checked else ""
            if wrong:
                ramp.fall(at_once=True)
                in_row += 1
            else:
                in_row = 0
                ramp.advance(t - answered, at_rest=True)
                answered, order = t, Order(ramp.share)
                bounds = AccelerationRange(*loop.bounds(*state)[:2])
                tau = loop.controller.step(state, bounds, order, config.dt).tau
            if first and wrong:
                after.setdefault(last, t - begins[last])
            elif not first and not wrong and last in after:
                again.setdefault(last, t - begins[last] - LASTS)
            loop.act(law, tau, in_row)
        position = float(arm.monitor.max_position_violation.max())
        speed = float(arm.monitor.max_velocity_violation.max())
        assert not checked or len(after) == begins.size
        return Played(position, speed, list(after.values()), list(again.values()))


@pytest.mark.parametrize("lie", LIES)
def test_faults_in_motion_are_told_and_the_arm_goes_on(lie):
    played = play("baxter_left_arm", 3, LIES[lie])
    assert max(played.after) < 0.1
    assert len(played.again) == len(played.after) and max(played.again) < 1.0
    if lie != "a bias of velocities":  # 1.5 rad/s are obeyed for tens of ms
        # What freezes is obeyed until it contradicts itself.
        assert played.position == 0.0 and played.speed <= (0.0 if lie == "zeros" else 0.02)


def test_untold_they_pass_limits():
    played = play("baxter_left_arm", 3, LIES["states frozen"], checked=False)
    assert played.position > 0.1 or played.speed > 0.5
