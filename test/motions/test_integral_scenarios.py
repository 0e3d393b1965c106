# SPDX-License-Identifier: Apache-2.0
"""TALOS' arm with friction, rotors and mass errors at 1 kHz: what the integral action is for.

Shorter runs of what `scripts/reproduce.sh paper1-integral` plays.
"""

import numpy as np
import pytest
from direct import DirectLoop, column, distance, posture_at_limits
from paper1_integral import PAPER, PUSHES, ROBOT, UNLIMITED, Disturbed, goal, push

pytestmark = pytest.mark.long


def error_at_rest(changed):
    loop = DirectLoop(ROBOT, changed)
    goal(loop, loop.pose(), (0.05, 0.1, 0.15))
    return distance(loop.run(2.5))[-500:].mean()


def test_steady_error_is_ten_times_smaller():
    assert error_at_rest({}) < 0.1 * error_at_rest({"integral_action": "none"})


def test_a_push_winds_nothing_up_and_the_release_does_not_overshoot():
    without, limited = (
        push(changed, PUSHES[0], seconds=2.0, before=0.5, after=1.2)
        for changed in (UNLIMITED, PAPER)
    )
    assert limited["share"] <= 1.0 + 1e-9 < 2.0 < without["share"]
    assert limited["overshoot"] <= without["overshoot"] / 3.0
    assert limited["recovery"] <= 1.0


def test_nothing_passes_a_limit_whatever_happens():
    """Pushes, goals and gains, at random."""
    run = Disturbed({})
    run.run(minutes=0.05)
    assert run.not_finite == 0 and run.torque_ratio <= 1.0
    assert run.deepest == 0.0 and run.fastest == 0.0


def test_the_handover_does_not_jolt():
    loop = DirectLoop(ROBOT)
    q = loop.config.start_positions.copy()
    for k in range(1200):
        q[5] = loop.config.start_positions[5] + 0.1 * min(1.0, k / 1000)
        loop.move(q)
    loop.resume(q)
    loop.run(0.2)
    samples = tuple(loop.samples[1000:])
    jumps = np.abs(np.diff(column(samples, "tau"), axis=0)) / loop.config.torque_max
    # The drives' last step is 1200, counted from the beginning.
    assert jumps[200].max() < np.delete(jumps, 200, axis=0).max() + 0.01
    assert np.ptp(column(samples, "q")[200:], axis=0).max() < 1e-3


def test_no_limit_is_passed_whatever_the_gain_and_however_often_it_changes():
    """Panda with K = lambda diag(M) passed all limits but those of its torques."""
    loop = DirectLoop(
        "panda",
        {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
        | {"integral_action": "joints", "integral_lambda": 50.0},
    )
    rng, monitor = np.random.default_rng(4), loop.robot.monitor
    low, high = loop.config.position_min, loop.config.position_max
    for k in range(3):
        loop.controller.goals.set_posture(posture_at_limits(rng, low, high))
        for _ in range(20):
            loop.run(0.05)
            if k > 0:
                loop.change(integral_lambda=10.0 ** rng.uniform(0.0, 3.0))
    assert not monitor.violated
