# SPDX-License-Identifier: Apache-2.0
"""A machine that does not keep the control rate: what its line says to set moves the arm."""

import re
from contextlib import closing

import numpy as np
import pytest
from direct import DirectLoop

from sim_bridge.node.bullet_parameters import make_stop
from torque_safety_controller.node.declared import covered_misses
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import Supervisor
from viability_bounds_pkg.state import State

POSTURE = {"posture_kp": 20.0, "posture_kd": -1.0, "posture_weight": 1.0, "pose_weight": 0.0}
TURN = np.array([0.3, -0.2, 0.3, 0.2, -0.3, 0.2, 0.3])  # rad
ARRIVED = 0.01  # rad


def play(work, stall, often, rate):
    """Return how far joints are from their goal after 2.5 s, rad, what was told, and a verdict.

    A command that comes when its period has ended is not obeyed.

    Args:
        work: time from the start of an answer to its command, s.
        stall: by which some take longer, s.
        often: share of these.
        rate: of control, Hz.
    """
    rng = np.random.default_rng(0)
    loop = DirectLoop("panda", POSTURE | {"rate_hz": rate})
    dt, law, told = loop.dt, make_stop(loop.config), []
    covered = covered_misses(loop.declared)
    supervisor = Supervisor(dt, "torque", covered, 0.05, None, lambda *_: None, told.append)
    supervisor.robot_returned("")
    goal = loop.robot.state().q + TURN
    loop.controller.goals.set_posture(goal)
    tau, free, answered, in_row = np.zeros(7), 0.0, None, 0
    with closing(loop.robot) as robot:
        for k in range(round(2.5 / dt)):
            in_row += k > 0
            if free <= k * dt + 1e-9:
                q, v, _ = robot.state()
                elapsed = None if answered is None else (k - answered) * dt
                order = supervisor.state(elapsed, v, None)
                limits = AccelerationRange(*loop.bounds(q, v)[:2])
                step = loop.controller.step(State(q, v), limits, order, elapsed)
                supervisor.answered(step.tau)
                free = k * dt + work + stall * (rng.random() < often)
                answered = k
                if free <= (k + 1) * dt:
                    tau, in_row = step.tau, 0
            loop.act(law, tau, in_row)
        left = float(np.abs(robot.state().q - goal).max())
        return left, [line for line in told if "keeps" in line], robot.monitor.violated


@pytest.mark.parametrize(
    "machine",
    [(0.0025, 0.005, 0.05), (0.0005, 0.006, 0.1)],
    ids=["each command is late", "many are"],
)
def test_an_arm_that_stands_moves_at_the_rate_of_the_line(machine):
    left, (line,), violated = play(*machine, 1000.0)
    assert left > 0.9 * np.abs(TURN).max() and not violated
    rate = re.search(r"set rate_hz to ([\d.]+)", line)[1]
    left, _, violated = play(*machine, float(rate))
    assert left < ARRIVED and not violated
