# SPDX-License-Identifier: Apache-2.0
"""What the controller does with goals, bounds and none of them."""

import itertools
from collections import deque
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
from scipy.optimize import nnls

from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST
from torque_safety_controller.tasks.pose_task import pose_error
from viability_bounds_pkg.state import State


def test_accelerations_stay_inside_their_bounds(arm):
    rng = np.random.default_rng(4)
    controller = make(arm)
    controller.goals.set_posture(arm.q_max - 0.1)
    at_bound = 0
    for _ in range(50):
        lower, upper = -rng.uniform(0.1, 1.0, arm.n), rng.uniform(0.1, 1.0, arm.n)
        step = controller.step(
            State(arm.q_start, np.zeros(arm.n)), AccelerationRange(lower, upper)
        )
        assert step.relaxation is None
        assert (step.a >= lower - SOLVED).all()
        assert (step.a <= upper + SOLVED).all()
        at_bound += (step.a >= upper - 1e-3).any()
    assert at_bound > 40, "the bounds are hardly felt"


def test_the_torque_gives_the_acceleration_asked_for(arm):
    rng = np.random.default_rng(5)
    controller = strong(arm)
    controller.goals.set_pose(pose_at(arm, arm.q_start + 0.1))
    for _ in range(10):
        q, v = arm.random_state(rng)
        controller.reset(q)
        step = controller.step(State(q, v), wide(arm))
        _, v_end = arm.move(q, v, step.tau, arm.dt, steps=8)
        asked = step.a * arm.dt
        np.testing.assert_allclose(v_end - v, asked, atol=0.02 * np.abs(asked).max() + 1e-4)


def test_bounds_that_the_motors_cannot_keep_are_relaxed_and_reported(arm):
    controller = make(arm)
    controller.goals.set_posture(arm.q_start)
    lower = np.full(arm.n, 300.0)
    step = controller.step(
        State(arm.q_start, np.zeros(arm.n)), AccelerationRange(lower, lower + 1.0)
    )
    assert_may_be_sent(step, arm)
    assert step.tracking
    assert (step.relaxation > 0.0).any()
    outside = np.maximum(np.maximum(lower - step.a, step.a - lower - 1.0), 0.0)
    np.testing.assert_allclose(step.relaxation, outside, atol=SOLVED)
    free = controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm))
    assert free.relaxation is None


def test_without_a_goal_it_rests(arm):
    controller = strong(arm)
    controller.reset(arm.q_start)
    assert not controller.goals.any
    v = 0.1 * arm.v_max
    step = controller.step(State(arm.q_start, v), wide(arm))
    assert not step.tracking
    assert not step.failure
    np.testing.assert_allclose(step.a, -GAINS.hold_kd * v, rtol=1e-4, atol=SOLVED)


@pytest.mark.parametrize("goal", ["pose", "posture"])
def test_with_a_goal_it_tracks(arm, goal):
    controller = strong(arm)
    controller.reset(arm.q_start)
    if goal == "pose":
        controller.goals.set_pose(pose_at(arm, arm.q_start + 0.1))
    else:
        controller.goals.set_posture(arm.q_start + 0.1)
    step = controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm))
    assert step.tracking
    assert not step.failure
    assert np.abs(step.a).max() > 0.1


def simulate(arm, controller, q, v, seconds, act):
    """Play the arm under the controller; yields state and step at each period."""
    for _ in range(round(seconds / arm.dt)):
        step = act(q, v)
        yield q, v, step
        q, v = arm.move(q, v, step.tau, arm.dt, steps=2)


@pytest.mark.parametrize("way", ["hold", "brake"])
def test_hold_and_brake_damp_and_carry_the_arm(arm, way):
    controller = make(arm)
    q, v = arm.q_start, 0.3 * arm.v_max * np.array([1, -1, 1, -1, 1, -1, 1])
    bounds = AccelerationRange(np.full(arm.n, -8.0), np.full(arm.n, 8.0))
    act = {
        "hold": lambda q, v: controller.step(State(q, v), None, REST),
        "brake": lambda q, v: controller.step(State(q, v), bounds, REST),
    }[way]
    speeds = []
    for q_now, v_now, step in simulate(arm, controller, q, v, 1.0, act):
        assert_may_be_sent(step, arm)
        assert not step.tracking
        speeds.append(np.abs(v_now).max())
        carried = gravity(arm, q_now)
    assert speeds[-1] < 2e-3 * speeds[0]
    assert max(speeds) <= speeds[0] * 1.01
    # At rest the motors carry the arm.
    np.testing.assert_allclose(step.tau, carried, atol=0.05 * arm.tau_max.max())


def test_the_programs_of_a_run_are_solved_to_optimality(arm, monkeypatch):
    """By Karush, Kuhn and Tucker, towards a goal beyond the limits of position."""
    controller = make(arm)
    programs = []
    solve = controller._qp.solve

    def recorded(program):
        programs.append((program, solve(program)))
        return programs[-1][1]

    monkeypatch.setattr(controller._qp, "solve", recorded)
    controller.reset(arm.q_start)
    controller.goals.set_pose(pose_at(arm, arm.q_start + 0.8))
    bounds = AccelerationRange(-0.3 * arm.v_max, 0.3 * arm.v_max)
    turns = itertools.cycle([bounds, wide(arm)])
    start = arm.q_start, np.zeros(arm.n), 1.0
    deque(
        simulate(arm, controller, *start, lambda q, v: controller.step(State(q, v), next(turns))),
        maxlen=0,
    )
    limited = 0
    for program, solution in programs:
        if solution.relaxation is not None:
            continue
        x = np.r_[solution.a, solution.rho]
        assert program.violations(x).max() < 1e-7
        N = np.vstack([np.eye(len(x)), program.C])
        at_lower, at_upper = (N @ x < program.lower + 1e-7), (N @ x > program.upper - 1e-7)
        normals = np.vstack([N[at_lower], -N[at_upper]])
        slope = program.H @ x + program.g
        left = nnls(normals.T, slope)[1] if len(normals) else np.linalg.norm(slope)
        assert left < 1e-6 * (1.0 + np.linalg.norm(program.g))
        limited += len(normals) > 0
    assert limited > 0.3 * len(programs)


def test_a_pose_goal_is_reached(arm):
    controller = make(arm)
    goal = pose_at(arm, arm.q_start + np.array([0.2, -0.1, 0.2, 0.1, -0.2, 0.1, 0.1]))
    controller.reset(arm.q_start)
    controller.goals.set_pose(goal)
    bounds = np.full(arm.n, -3.0), np.full(arm.n, 3.0)
    first = last = None
    for q, _, _ in simulate(
        arm,
        controller,
        arm.q_start,
        np.zeros(arm.n),
        6.0,
        lambda q, v: controller.step(State(q, v), AccelerationRange(*bounds)),
    ):
        last = pose_error(pose_at(arm, q), goal)
        first = last if first is None else first
    assert np.linalg.norm(first) > 0.05
    assert np.linalg.norm(last) < 1e-4  # m, rad
    np.testing.assert_allclose(controller.goals.error(controller.robot.pose), last, atol=1e-12)


def test_the_posture_is_where_it_started_until_one_is_asked_for(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.goals.set_pose(pose_at(arm, arm.q_start))
    at_rest = State(arm.q_start, np.zeros(arm.n)), wide(arm)
    controller.reset(arm.q_start + 0.1)
    np.testing.assert_allclose(controller.step(*at_rest).a, GAINS.posture_kp * 0.1, atol=1e-3)
    controller.reset(arm.q_start - 0.1)
    np.testing.assert_allclose(controller.step(*at_rest).a, -GAINS.posture_kp * 0.1, atol=1e-3)
    controller.goals.set_posture(arm.q_start + 0.05)
    np.testing.assert_allclose(controller.step(*at_rest).a, GAINS.posture_kp * 0.05, atol=1e-3)


def test_start_keeps_a_copy_of_the_state(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.goals.set_pose(pose_at(arm, arm.q_start))
    q = arm.q_start.copy()
    controller.reset(q)
    q += 1.0  # a reader may use its array again
    step = controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm))
    np.testing.assert_allclose(step.a, 0.0, atol=1e-3)
