# SPDX-License-Identifier: Apache-2.0
"""The controller with integral action."""

import math
from dataclasses import replace

import numpy as np
from arms import load_arm
from controllers import (
    GAINS,
    KHZ,
    NUMBERS,
    VECTORS,
    assert_may_be_sent,
    pose_at,
    wide,
    with_integral,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.integral_feedback import MODES
from torque_safety_controller.parts.integral import Integral
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST
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


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    mode=st.sampled_from(MODES),
    share=st.sampled_from([0.0, 0.1, 1.0]),
    rate=st.sampled_from([math.inf, 1000.0]),
    deeds=DEEDS,
)
def test_torque_limits_hold_whatever_the_integral_does(mode, share, rate, deeds):
    arm = load_arm("panda")
    budget = share * arm.tau_max
    controller = with_integral(arm, mode, rate=np.full(arm.n, rate), budget=budget)
    controller.goals.set_posture(arm.q_start + 0.3)
    with np.errstate(all="ignore"):
        for deed, gain, elapsed, dq, v, x in deeds:
            if gain is not None:
                controller.find(Integral).action.settings = replace(
                    controller.find(Integral).action.settings, gain=gain
                )
            q = arm.q_start + dq
            bounds = AccelerationRange(-np.abs(x), np.abs(x))
            if deed == "reset":
                controller.reset(q)
                continue
            state = State(q, v)
            if deed == "resume":
                step = controller.resume(state, bounds, x)
            else:
                order = None if deed == "step" else REST
                step = controller.step(state, None if deed == "hold" else bounds, order, elapsed)
            assert_may_be_sent(step, arm)
            assert np.isfinite(controller.find(Integral).action.last).all()
        # Once the world makes sense again, so does the controller.
        controller.goals.release_pose()
        controller.goals.set_posture(arm.q_start)
        rest = State(arm.q_start, np.zeros(arm.n)), wide(arm)
        for _ in range(3):
            assert_may_be_sent(controller.step(*rest), arm)
        assert not controller.step(*rest).failure


STIFF = replace(GAINS, pose_kp=400.0, pose_kd=40.0, posture_kp=100.0, posture_kd=20.0)


def pushed(arm, q, v, tau, push):
    """Play a period with a torque on the joints that no one knows of."""
    return arm.move(q, v, tau + push, KHZ, steps=1)


def test_the_integral_carries_what_the_model_does_not_know():
    arm = load_arm("panda")
    push = 0.1 * arm.tau_max * np.array([1, -1, 1, 1, -1, 1, -1])
    errors = {}
    for mode in ("none", "joints", "task"):
        controller = with_integral(arm, mode, STIFF)
        goal = pose_at(arm, arm.q_start)
        controller.reset(arm.q_start)
        controller.goals.set_pose(goal)
        q, v = arm.q_start, np.zeros(arm.n)
        for _ in range(round(0.6 / KHZ)):
            q, v = pushed(arm, q, v, controller.step(State(q, v), wide(arm)).tau, push)
        errors[mode] = np.linalg.norm(pose_error(pose_at(arm, q), goal)[:3])
    assert errors["joints"] < 0.1 * errors["none"]
    assert errors["task"] < 0.1 * errors["none"]


def test_the_limits_on_torque_leave_the_integral_its_share(arm):
    """The QP keeps the sum within its limits: the accelerations it returns are those it gives."""
    state = State(arm.q_start, np.zeros(arm.n))
    saturated = 0
    for sign in (1.0, -1.0):
        controller = with_integral(arm, gains=replace(GAINS, posture_kp=1e4))
        controller.resume(state, wide(arm), sign * 0.5 * arm.tau_max)
        controller.goals.release_pose()
        controller.goals.set_posture(arm.q_max)
        for _ in range(5):
            step = controller.step(state, wide(arm))
            assert_may_be_sent(step, arm)
            assert not step.failure
            added = controller.find(Integral).action.last
            assert (np.abs(added) > 0.01 * arm.tau_max).any()
            # The limits are those in the middle of a step with the acceleration of the last one.
            model = controller.robot.torque(step.a)
            np.testing.assert_allclose(step.tau, model + added, atol=0.01 * arm.tau_max.max())
            saturated += (np.abs(step.tau) > 0.99 * arm.tau_max).any()
    assert saturated == 10


def test_in_hold_nothing_grows_on_what_the_motors_cannot_give(arm):
    controller = with_integral(arm, gains=replace(GAINS, hold_kd=100.0))
    robot = controller.robot
    q, v = arm.q_start, np.zeros(arm.n)
    robot.update(State(q, v), v)
    # So fast that to brake as it should takes 1.8 times what the first motor has.
    v[0] = 1.8 * arm.tau_max[0] / (100.0 * robot.M[0, 0])
    saturated = 0
    for _ in range(8):
        step = controller.step(State(q, v), None, REST, KHZ)
        saturated += abs(step.tau[0]) == arm.tau_max[0]
        q, v = arm.move(q, v, step.tau, KHZ, steps=2)
    assert saturated > 4
    assert controller.find(Integral).action.skipped == 0
    # With the accelerations that were wished for, half of the budget would be used up by now.
    assert (np.abs(controller.find(Integral).action.last) < 0.02 * arm.tau_max).all()
