# SPDX-License-Identifier: Apache-2.0
"""Rows of missed deadlines: torques drift that are held, and the integral action adds to them."""

from contextlib import closing

import numpy as np
import pytest
from direct import DirectLoop, posture_at_limits

from sim_bridge.node.bullet_parameters import make_stop
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.state import State

RATE = 100.0  # Hz; in a row a joint moves far
SECONDS, LONGEST, PROBABILITY = 16.0, 5, 0.1
HASTE = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}


def play(mode: str, seed: int) -> tuple[float, float, int]:
    """Return how far limits were passed, rad and rad/s, and how many commands were missing.

    In a row states get no answer, or one that comes too late.
    """
    rng = np.random.default_rng(seed)
    loop = DirectLoop("panda", HASTE | {"rate_hz": RATE, "integral_action": mode})
    config, robot, law = loop.config, loop.robot, make_stop(loop.config)
    low, high = config.position_min, config.position_max
    tau = np.zeros(low.size)
    row = in_row = missing = unanswered = 0
    with closing(robot):
        for k in range(round(SECONDS * RATE)):
            if k % RATE == 0:
                loop.controller.goals.set_posture(posture_at_limits(rng, low, high))
            if k and row == 0 and rng.random() < PROBABILITY:
                row = int(rng.integers(1, LONGEST + 1))
            lost, row = row > 0, max(0, row - 1)
            unanswered += 1
            if not lost or rng.random() < 0.5:
                q, v, _ = robot.state()
                bounds = AccelerationRange(*loop.bounds(q, v)[:2])
                step = loop.controller.step(State(q, v), bounds, None, unanswered * config.dt)
                unanswered = 0
            if not lost:
                tau, in_row = step.tau, 0
            else:
                in_row, missing = in_row + 1, missing + 1
            loop.act(law, tau, in_row)
        monitor = robot.monitor
        farthest = monitor.max_position_violation.max(), monitor.max_velocity_violation.max()
        return float(farthest[0]), float(farthest[1]), missing


@pytest.mark.parametrize(("mode", "seed"), [("joints", 0), ("task", 1)])
def test_limits_are_kept(mode, seed):
    position, speed, missing = play(mode, seed)
    assert missing > 200
    assert position == 0.0 and speed == 0.0


@pytest.mark.parametrize(
    ("robot", "longest", "seed"),
    [("panda", 2, 2), ("panda", 4, 0), ("baxter_left_arm", 2, 0)],
)
def test_a_torque_that_is_held_drifts_past_no_limit(robot, longest, seed):
    """A third of the commands are missing, and the robot holds the last one."""
    rng = np.random.default_rng(seed)
    loop = DirectLoop(robot, HASTE | {"missed_deadlines": longest})
    low, high = loop.config.position_min, loop.config.position_max
    row = missing = unanswered = 0
    periods = round(4.0 / loop.dt)
    with closing(loop.robot) as arm:
        for k in range(periods):
            if k % round(1.0 / loop.dt) == 0:
                loop.controller.goals.set_posture(posture_at_limits(rng, low, high))
            if k and not unanswered and rng.random() < 0.4:
                row = int(rng.integers(1, longest + 1))
            if row:
                row, missing, unanswered = row - 1, missing + 1, unanswered + 1
            else:
                q, v, _ = arm.state()
                bounds = AccelerationRange(*loop.bounds(q, v)[:2])
                elapsed, unanswered = (1 + unanswered) * loop.dt, 0
                tau = loop.controller.step(State(q, v), bounds, None, elapsed).tau
            arm.step(tau, loop.config.substeps)
        assert missing > 0.3 * periods
        assert not arm.monitor.violated
