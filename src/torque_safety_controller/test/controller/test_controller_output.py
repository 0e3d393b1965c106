# SPDX-License-Identifier: Apache-2.0
"""What the controller sends: finite and within the limits, whatever comes."""

import math
from dataclasses import replace

import numpy as np
from arms import load_arm
from controllers import (
    EXACT,
    GAINS,
    SOLVED,
    VECTORS,
    assert_may_be_sent,
    integral,
    make,
    pose_at,
    posture_only,
    strong,
    wide,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.parts.integral import Integral
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST, Order
from viability_bounds_pkg.state import State


class Fixed:
    """An additional torque that is always the same."""

    def __init__(self, torque) -> None:
        self.last = torque

    def reset(self) -> None:
        """Nothing to forget."""

    def torque(self, robot, a_last, elapsed):
        return self.last


def at_rest(arm) -> State:
    return State(arm.q_start, np.zeros(arm.n))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    q=VECTORS,
    v=VECTORS,
    a=VECTORS,
    width=VECTORS,
    additional=st.one_of(st.none(), VECTORS),
    pose=st.booleans(),
    posture=st.booleans(),
    after=st.sampled_from(["step", "brake", "hold"]),
)
def test_torques_are_finite_and_within_their_limits_whatever_comes(
    q, v, a, width, additional, pose, posture, after
):
    arm = load_arm("baxter_left_arm")
    controller = make(arm, integral=None if additional is None else Fixed(additional))
    if pose:
        controller.goals.set_pose(pose_at(arm, arm.q_start + 0.2))
    if posture:
        controller.goals.set_posture(arm.q_start - 0.2)
    controller.reset(arm.q_start)
    with np.errstate(all="ignore"):
        step = controller.step(State(q, v), AccelerationRange(a, a + np.abs(width)))
        assert_may_be_sent(step, arm)
        # The same afterwards, when the state is sane and only the past is not.
        limits = None if after == "hold" else wide(arm)
        order = None if after == "step" else REST
        assert_may_be_sent(controller.step(at_rest(arm), limits, order), arm)
        if additional is None:
            # The acceleration of the last step may still be beyond sense, but not for long.
            assert not controller.step(at_rest(arm), wide(arm)).failure


def test_the_last_torque_is_held_where_a_state_is_not_finite(arm):
    controller = make(arm)
    controller.goals.set_pose(pose_at(arm, arm.q_start))
    before = controller.step(at_rest(arm), wide(arm))
    for bad in (math.nan, math.inf, 1e200):
        v = np.zeros(arm.n)
        v[2] = bad
        with np.errstate(all="ignore"):
            step = controller.step(State(arm.q_start, v), wide(arm))
        assert step.failure
        assert not step.tracking
        np.testing.assert_array_equal(step.tau, before.tau)
        assert not controller.step(at_rest(arm), wide(arm)).failure


def test_the_torque_limits_hold_with_the_additional_torque_in_them(arm):
    push = 0.8 * arm.tau_max
    rng = np.random.default_rng(2)
    controller = make(arm, integral=Fixed(push))
    controller.goals.set_posture(arm.q_max)
    exact = limited = 0
    for _ in range(60):
        q, v = arm.random_state(rng)
        controller.reset(q)
        step = controller.step(State(q, 0.1 * v), wide(arm))
        assert_may_be_sent(step, arm)
        # It is in there once: what is left is the torque of the model.
        rest = step.tau - push - controller.robot.torque(step.a)
        exact += np.abs(rest).max() < EXACT
        limited += (step.tau > 0.999 * arm.tau_max).any()
    assert exact > 10
    assert limited > 10


def test_the_rate_of_torque_is_limited_whatever_comes(arm):
    rng = np.random.default_rng(3)
    rate = rng.uniform(50.0, 500.0, arm.n)
    rate[2] = np.inf
    controller = make(arm, torque_rate_max=rate)
    controller.goals.set_pose(pose_at(arm, arm.q_start))
    last, reached = None, np.zeros(arm.n, dtype=bool)
    for k in range(300):
        q, v = arm.random_state(rng)
        if k % 7 == 3:
            v[1] = math.nan
        lower = rng.uniform(-30.0, 20.0, arm.n)
        with np.errstate(all="ignore"):
            step = controller.step(State(q, v), AccelerationRange(lower, lower + 5.0))
        assert_may_be_sent(step, arm)
        if last is not None:
            change = np.abs(step.tau - last)
            assert (change <= rate * arm.dt + EXACT).all()
            reached |= change > 0.99 * rate * arm.dt
        last = step.tau
    assert reached[np.isfinite(rate)].all(), "the limit is not felt"
    # A robot that was away begins anew.
    controller.reset(arm.q_start)
    state = State(*arm.random_state(rng))
    free = make(arm).step(state, None, REST).tau
    np.testing.assert_allclose(controller.step(state, None, REST).tau, free, atol=EXACT)


# The share of the goals


def test_a_share_of_the_goals_mixes_their_accelerations_with_those_of_braking(arm):
    controller = make(arm)
    controller.reset(arm.q_start)
    controller.goals.set_pose(pose_at(arm, arm.q_start + 0.01))
    state = State(arm.q_start, np.full(arm.n, 0.02))
    none, part, all_of_it = (
        controller.step(state, wide(arm), Order(share)).a for share in (0.0, 0.25, 1.0)
    )
    rest = -GAINS.hold_kd * state.v
    np.testing.assert_allclose(none, rest, atol=1e-3)
    np.testing.assert_allclose(part, 0.25 * all_of_it + 0.75 * rest, atol=1e-3)
    assert np.abs(all_of_it - rest).max() > 0.1


def test_a_far_goal_gets_its_effect_back_without_a_jolt(arm):
    """However far away it is, and however stiff the gains: the bounds open with the share."""
    bounds = AccelerationRange(np.full(arm.n, -15.0), np.full(arm.n, 15.0))
    controller = strong(arm, gains=posture_only(400.0, 40.0))
    controller.goals.set_posture(arm.q_start + 3.0)
    last, increment = np.zeros(arm.n), 0.01
    for share in np.arange(0.0, 1.0, increment):
        a = controller.step(at_rest(arm), bounds, Order(share)).a
        assert np.abs(a - last).max() <= 2.0 * increment * 30.0 + SOLVED
        last = a
    assert last.max() > 14.0, "the goal has no effect"


def test_what_pushes_is_taken_off_the_bounds_of_what_is_commanded(arm):
    gains = replace(posture_only(100.0, 20.0), disturbance_time=1e-6)
    controller = strong(arm, gains=gains)
    controller.reset(arm.q_start)
    controller.goals.set_posture(arm.q_start + 1.0)
    bounds, push = AccelerationRange(np.full(arm.n, -1.0), np.full(arm.n, 1.0)), 0.4
    v = np.zeros(arm.n)
    for _ in range(10):
        step = controller.step(State(arm.q_start, v), bounds)
        v = v + arm.dt * (step.a + push)
    np.testing.assert_allclose(step.a + push, 1.0, atol=SOLVED)


def test_nothing_is_learned_from_a_motion_that_was_not_commanded():
    """Neither of disturbances nor by the integral action; the torque does not jump."""
    arm = load_arm("panda")
    gains = replace(GAINS, disturbance_time=1e-6)
    controller = make(arm, integral=integral(arm, "joints"), gains=gains)
    controller.reset(arm.q_start)
    controller.goals.set_posture(arm.q_start + 0.1)
    for _ in range(20):
        step = controller.step(at_rest(arm), wide(arm))
    learned = step.disturbance.copy()
    torque = controller.find(Integral).action.last
    assert learned.any() and torque.any()
    for k in range(20):
        state = State(arm.q_start, np.full(arm.n, 0.01 * k))
        step = controller.step(state, wide(arm), Order(obeyed=False))
    # What the additional torque changes by as it goes on counts.
    np.testing.assert_allclose(step.disturbance, learned, rtol=0.05)
    np.testing.assert_allclose(controller.find(Integral).action.last, torque, rtol=0.05)
    step = controller.step(State(arm.q_start, np.full(arm.n, 0.5)), wide(arm))
    assert np.abs(step.disturbance - learned).max() > 10.0
