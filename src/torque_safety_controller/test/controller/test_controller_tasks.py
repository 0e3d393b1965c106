# SPDX-License-Identifier: Apache-2.0
"""What the controller does with goals, gains and bounds, and without a goal."""

from dataclasses import replace

import numpy as np
import pytest
from controllers import (
    GAINS,
    SOLVED,
    assert_may_be_sent,
    gravity,
    make,
    pose_at,
    strong,
    wide,
)

from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST
from torque_safety_controller.tasks.pose_task import pose_error
from viability_bounds_pkg.state import State


def at_rest(arm) -> State:
    return State(arm.q_start, np.zeros(arm.n))


def within(arm, a) -> AccelerationRange:
    return AccelerationRange(np.full(arm.n, -a), np.full(arm.n, a))


def test_bounds_that_the_motors_cannot_keep_are_relaxed_and_reported(arm):
    controller = make(arm)
    controller.goals.set_posture(arm.q_start)
    lower = np.full(arm.n, 300.0)
    step = controller.step(at_rest(arm), AccelerationRange(lower, lower + 1.0))
    assert_may_be_sent(step, arm)
    assert step.tracking
    assert (step.relaxation > 0.0).any()
    outside = np.maximum(np.maximum(lower - step.a, step.a - lower - 1.0), 0.0)
    np.testing.assert_allclose(step.relaxation, outside, atol=SOLVED)
    assert controller.step(at_rest(arm), wide(arm)).relaxation is None


def test_without_a_goal_it_rests_by_the_damping_of_hold(arm):
    v = 0.01 * arm.v_max
    for kd in (5.0, 40.0):
        controller = strong(arm, gains=replace(GAINS, hold_kd=kd))
        controller.reset(arm.q_start)
        for limits, order in ((wide(arm), None), (wide(arm), REST), (None, REST)):
            step = controller.step(State(arm.q_start, v), limits, order)
            assert not step.tracking
            assert not step.failure
            np.testing.assert_allclose(step.a, -kd * v, rtol=1e-4, atol=SOLVED)


def simulate(arm, q, v, seconds, act):
    """Play the arm; yields state and step at each period."""
    for _ in range(round(seconds / arm.dt)):
        step = act(State(q, v))
        yield q, v, step
        q, v = arm.move(q, v, step.tau, arm.dt, steps=2)


@pytest.mark.parametrize("bounded", [True, False])
def test_hold_damps_and_carries_the_arm(arm, bounded):
    controller = make(arm)
    v = 0.3 * arm.v_max * np.array([1, -1, 1, -1, 1, -1, 1])
    limits = within(arm, 8.0) if bounded else None
    speeds = []
    for q_now, v_now, step in simulate(
        arm, arm.q_start, v, 1.0, lambda state: controller.step(state, limits, REST)
    ):
        assert_may_be_sent(step, arm)
        assert not step.tracking
        speeds.append(np.abs(v_now).max())
        carried = gravity(arm, q_now)
    assert speeds[-1] < 2e-3 * speeds[0]
    assert max(speeds) <= speeds[0] * 1.01
    np.testing.assert_allclose(step.tau, carried, atol=0.05 * arm.tau_max.max())


def test_a_pose_goal_is_reached(arm):
    controller = make(arm)
    goal = pose_at(arm, arm.q_start + np.array([0.2, -0.1, 0.2, 0.1, -0.2, 0.1, 0.1]))
    controller.reset(arm.q_start)
    controller.goals.set_pose(goal)
    errors = [
        np.linalg.norm(pose_error(pose_at(arm, q), goal))
        for q, _, _ in simulate(
            arm,
            *at_rest(arm),
            6.0,
            lambda state: controller.step(state, within(arm, 3.0)),
        )
    ]
    assert errors[0] > 0.05
    assert errors[-1] < 1e-4  # m, rad


def test_the_posture_is_where_it_started_until_one_is_asked_for(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.goals.set_pose(pose_at(arm, arm.q_start))  # a goal without a weight
    for off in (0.1, -0.1):
        controller.reset(arm.q_start + off)
        step = controller.step(at_rest(arm), wide(arm))
        np.testing.assert_allclose(step.a, GAINS.posture_kp * off, atol=1e-3)
    controller.goals.set_posture(arm.q_start + 0.05)
    step = controller.step(at_rest(arm), wide(arm))
    np.testing.assert_allclose(step.a, GAINS.posture_kp * 0.05, atol=1e-3)


@pytest.mark.parametrize(
    "changed",
    [
        {"pose_kp": 20.0},
        {"pose_kd": 12.0},
        {"pose_weight": 1e-4},
        {"posture_kp": 16.0},
        {"posture_kd": 10.0},
        {"posture_weight": 1.0},
        {"pose_speed_max": np.array([0.01, 0.05])},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_each_gain_reaches_the_torque_also_while_the_controller_runs(arm, changed):
    def tau(first, then):
        controller = make(arm, gains=first)
        controller.reset(arm.q_start + 0.1)
        controller.goals.set_pose(pose_at(arm, arm.q_start + 0.05))
        controller.goals.gains = then
        return controller.step(State(arm.q_start, 0.02 * arm.v_max), wide(arm)).tau

    other = replace(GAINS, **changed)
    assert np.abs(tau(other, other) - tau(GAINS, GAINS)).max() > 1e-3
    np.testing.assert_allclose(tau(GAINS, other), tau(other, other), atol=1e-6)
