# SPDX-License-Identifier: Apache-2.0
"""The controller with integral action, and the handover, in which that takes over the torque."""

import math
from dataclasses import replace

import numpy as np
import pytest
from arms import load_arm
from controllers import (
    EXACT,
    GAINS,
    KHZ,
    NUMBERS,
    VECTORS,
    assert_may_be_sent,
    gravity,
    pose_at,
    wide,
    with_integral,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.integral_feedback import MODES
from torque_safety_controller.parts.integral import Integral
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST, Order
from torque_safety_controller.tasks.pose_task import pose_error
from viability_bounds_pkg.state import State

DEEDS = st.lists(
    st.tuples(
        st.sampled_from(["step", "brake", "hold", "resume", "reset"]),
        st.sampled_from([None, 1.0, 40.0]),
        st.one_of(st.none(), NUMBERS),
        st.one_of(st.just(np.zeros(7)), VECTORS),
        st.one_of(st.just(np.zeros(7)), VECTORS),
        VECTORS,
    ),
    min_size=1,
    max_size=10,
)


def at_rest(arm) -> State:
    return State(arm.q_start, np.zeros(arm.n))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    mode=st.sampled_from(MODES),
    share=st.sampled_from([0.0, 0.1, 1.0]),
    rate=st.sampled_from([math.inf, 1000.0]),
    deeds=DEEDS,
)
def test_torque_limits_hold_whatever_the_integral_does(mode, share, rate, deeds):
    arm = load_arm("panda")
    controller = with_integral(arm, mode, rate=np.full(arm.n, rate), budget=share * arm.tau_max)
    action = controller.find(Integral).action
    controller.goals.set_posture(arm.q_start + 0.3)
    with np.errstate(all="ignore"):
        for deed, gain, elapsed, dq, v, x in deeds:
            if gain is not None:
                action.settings = replace(action.settings, gain=gain)
            state = State(arm.q_start + dq, v)
            bounds = AccelerationRange(-np.abs(x), np.abs(x))
            if deed == "reset":
                controller.reset(state.q)
                continue
            if deed == "resume":
                step = controller.resume(state, bounds, x)
            else:
                order = None if deed == "step" else REST
                step = controller.step(state, None if deed == "hold" else bounds, order, elapsed)
            assert_may_be_sent(step, arm)
            assert np.isfinite(action.last).all()
        # Once the world makes sense again, so does the controller.
        controller.goals.release_pose()
        controller.goals.set_posture(arm.q_start)
        for _ in range(4):
            step = controller.step(at_rest(arm), wide(arm))
            assert_may_be_sent(step, arm)
        assert not step.failure


def test_the_integral_carries_what_the_model_does_not_know():
    arm = load_arm("panda")
    push = 0.1 * arm.tau_max * np.array([1, -1, 1, 1, -1, 1, -1])
    stiff = replace(GAINS, pose_kp=400.0, pose_kd=40.0, posture_kp=100.0, posture_kd=20.0)
    goal, errors = pose_at(arm, arm.q_start), {}
    for mode in ("none", "joints", "task"):
        controller = with_integral(arm, mode, stiff)
        controller.reset(arm.q_start)
        controller.goals.set_pose(goal)
        q, v = at_rest(arm)
        for _ in range(round(0.6 / KHZ)):
            tau = controller.step(State(q, v), wide(arm)).tau
            q, v = arm.move(q, v, tau + push, KHZ, steps=1)
        errors[mode] = np.linalg.norm(pose_error(pose_at(arm, q), goal)[:3])
    assert errors["joints"] < 0.1 * errors["none"]
    assert errors["task"] < 0.1 * errors["none"]


def test_in_hold_nothing_grows_on_what_the_motors_cannot_give(arm):
    controller = with_integral(arm, gains=replace(GAINS, hold_kd=100.0))
    q, v = arm.q_start, np.zeros(arm.n)
    controller.robot.update(State(q, v), v)
    # So fast that to brake as it should takes 1.8 times what the first motor has.
    v[0] = 1.8 * arm.tau_max[0] / (100.0 * controller.robot.M[0, 0])
    for _ in range(8):
        step = controller.step(State(q, v), None, REST, KHZ)
        q, v = arm.move(q, v, step.tau, KHZ, steps=2)
    # With the accelerations that were wished for, half of the budget would be used up by now.
    assert (np.abs(controller.find(Integral).action.last) < 0.02 * arm.tau_max).all()


@pytest.mark.parametrize("forget", [False, True])
def test_what_balanced_a_motion_that_has_ended_fades(arm, forget):
    controller = with_integral(arm)
    held = 0.1 * arm.tau_max
    controller.resume(at_rest(arm), wide(arm), gravity(arm, arm.q_start) + held)
    controller.step(at_rest(arm), wide(arm), Order(forget_integral=forget))
    for _ in range(round(1.0 / KHZ)):
        controller.step(at_rest(arm), wide(arm))
    left = controller.find(Integral).action.last / held
    assert (left < 0.02).all() if forget else (left > 0.5).all()


# The handover


@pytest.mark.parametrize("mode", MODES)
def test_it_takes_over_the_torque_of_others(arm, mode):
    rng = np.random.default_rng(6)
    controller = with_integral(arm, mode)
    tau = gravity(arm, arm.q_start) + rng.uniform(-0.15, 0.15, arm.n) * arm.tau_max
    tau = np.clip(tau, -arm.tau_max, arm.tau_max)
    controller.goals.set_pose(pose_at(arm, arm.q_start + 0.5))  # forgotten
    assert not controller.resume(at_rest(arm), wide(arm), tau).failure
    # The next step is at the same place, where friction holds the arm.
    after = controller.step(at_rest(arm), wide(arm))
    assert (np.abs(after.tau - tau) < 0.01 * arm.tau_max).all()
    np.testing.assert_allclose(after.a, 0.0, atol=5e-3)
    assert controller.goals.pose_des.isApprox(pose_at(arm, arm.q_start))
    np.testing.assert_array_equal(controller.goals.q_des, arm.q_start)


def test_the_rate_of_torque_counts_from_what_was_measured(arm):
    rate = np.full(arm.n, 1.0)
    controller = with_integral(arm, "none", rate=rate)
    tau = gravity(arm, arm.q_start) + 0.2 * arm.tau_max
    controller.resume(at_rest(arm), wide(arm), tau)
    change = np.abs(controller.step(at_rest(arm), wide(arm)).tau - tau)
    assert (change <= rate * KHZ + EXACT).all()


@pytest.mark.parametrize("bad", ["bounds", "torque", "position"])
def test_a_handover_that_fails_leaves_everything_as_it_was(arm, bad):
    controller = with_integral(arm)
    goal = pose_at(arm, arm.q_start + 0.1)
    controller.goals.set_pose(goal)
    nan = np.full(arm.n, math.nan)
    state = State(nan if bad == "position" else arm.q_start, np.zeros(arm.n))
    bounds = AccelerationRange(nan, nan) if bad == "bounds" else wide(arm)
    assert controller.resume(state, bounds, nan if bad == "torque" else arm.tau_max).failure
    assert controller.goals.pose_des is goal
    assert controller.goals.q_des is None
    step = controller.step(at_rest(arm), None, REST)
    np.testing.assert_allclose(step.tau, gravity(arm, arm.q_start), atol=EXACT)
    assert not controller.step(at_rest(arm), wide(arm)).failure
