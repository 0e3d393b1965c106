# SPDX-License-Identifier: Apache-2.0
"""TALOS' arm with friction, rotors and mass errors at 1 kHz: what the integral action is for.

Shorter runs of what `scripts/reproduce.sh paper1-integral` plays.
"""

import numpy as np
import pytest
from direct import DirectLoop, column, posture_at_limits
from paper1_integral import (
    PAPER,
    PUSHES,
    ROBOT,
    UNLIMITED,
    Disturbed,
    distance,
    goal,
    push,
)

from torque_safety_controller.parts.integral import Integral
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.state import State

pytestmark = pytest.mark.long


def error_at_rest(changed):
    loop = DirectLoop(ROBOT, changed)
    start = loop.pose()
    errors = []
    for offset in ((0.05, 0.1, 0.15), (0.1, -0.1, -0.05)):
        goal(loop, start, offset)
        errors.append(distance(loop.run(2.5))[-500:].mean())
    return np.mean(errors)


def test_steady_error_is_ten_times_smaller():
    assert error_at_rest({}) < 0.1 * error_at_rest({"integral_action": "none"})


@pytest.mark.parametrize("force", PUSHES)
def test_push_and_release(force):
    without, limited = (
        push(changed, force, seconds=2.0, before=0.5, after=1.2) for changed in (UNLIMITED, PAPER)
    )
    assert limited["share"] <= 1.0 + 1e-9 < 2.0 < without["share"]
    assert limited["overshoot"] <= without["overshoot"] / 3.0
    assert limited["recovery"] <= 1.0


def test_nothing_passes_a_limit_whatever_happens():
    run = Disturbed({})
    run.run(0.1)
    assert run.steps == 6_000
    assert run.not_finite == 0 and run.torque_ratio <= 1.0
    assert run.deepest == 0.0 and run.fastest == 0.0


def test_a_pause_of_the_robot_does_not_kick():
    """It was shoved somewhere else in the meantime."""
    loop = DirectLoop(ROBOT)
    loop.run(0.5)
    before = loop.samples[-1]
    q, v, _ = loop.robot.state()
    loop.robot.reset(q + 0.05, v + 0.2)
    bounds = loop.limits
    step = loop.controller.step(
        State(q + 0.05, v + 0.2), AccelerationRange(bounds.a_min, bounds.a_max), elapsed=3.0
    )
    integral = loop.controller.find(Integral).action.last
    assert np.isfinite(step.tau).all()
    jump = np.abs(integral - before.additional) / loop.config.torque_max
    assert jump.max() < 1e-2


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
    for k in range(6):
        loop.controller.goals.set_posture(posture_at_limits(rng, low, high))
        for _ in range(20 if k > 2 else 1):
            loop.run(0.05 if k > 2 else 1.0)
            if k > 2:
                loop.change(integral_lambda=10.0 ** rng.uniform(0.0, 3.0))
        assert monitor.max_velocity_violation.max() == 0.0
        assert monitor.max_position_violation.max() == 0.0
