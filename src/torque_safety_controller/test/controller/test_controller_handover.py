# SPDX-License-Identifier: Apache-2.0
"""The controller goes on from the torque of others."""

import math

import numpy as np
import pytest
from controllers import EXACT, KHZ, assert_may_be_sent, gravity, pose_at, wide, with_integral

from torque_safety_controller.integral_feedback import MODES
from torque_safety_controller.parts.integral import Integral
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST
from viability_bounds_pkg.state import State


@pytest.mark.parametrize("mode", MODES)
def test_it_takes_over_the_torque_of_others(arm, mode):
    rng = np.random.default_rng(6)
    for _ in range(5):
        controller = with_integral(arm, mode)
        tau = gravity(arm, arm.q_start) + rng.uniform(-0.15, 0.15, arm.n) * arm.tau_max
        tau = np.clip(tau, -arm.tau_max, arm.tau_max)
        state = State(arm.q_start, np.zeros(arm.n))
        controller.goals.set_pose(pose_at(arm, arm.q_start + 0.5))  # forgotten
        step = controller.resume(state, wide(arm), tau)
        assert not step.failure
        # The next step is at the same place, where friction holds the arm.
        after = controller.step(state, wide(arm))
        assert (np.abs(after.tau - tau) < 0.01 * arm.tau_max).all()
        np.testing.assert_allclose(after.a, 0.0, atol=5e-3)
        assert controller.goals.pose_des.isApprox(pose_at(arm, arm.q_start))
        np.testing.assert_array_equal(controller.goals.q_des, arm.q_start)


def test_torque_beyond_the_limits_is_taken_over_up_to_them(arm):
    controller = with_integral(arm)
    state = State(arm.q_start, np.zeros(arm.n))
    controller.resume(state, wide(arm), 1.5 * arm.tau_max)
    step = controller.step(state, wide(arm))
    assert_may_be_sent(step, arm)
    assert (step.tau > 0.97 * arm.tau_max).all()


def test_the_rate_of_torque_counts_from_what_was_measured(arm):
    rate = np.full(arm.n, 1.0)
    controller = with_integral(arm, "none", rate=rate)
    state = State(arm.q_start, np.zeros(arm.n))
    tau = gravity(arm, arm.q_start) + 0.2 * arm.tau_max
    controller.resume(state, wide(arm), tau)
    assert (np.abs(controller.step(state, wide(arm)).tau - tau) <= rate * KHZ + EXACT).all()


@pytest.mark.parametrize("bad", ["bounds", "torque", "position"])
def test_a_handover_that_fails_leaves_everything_as_it_was(arm, bad):
    controller = with_integral(arm)
    goal = pose_at(arm, arm.q_start + 0.1)
    controller.goals.set_pose(goal)
    nan = np.full(arm.n, math.nan)
    q = nan if bad == "position" else arm.q_start
    bounds = (nan, nan) if bad == "bounds" else wide(arm)
    tau = nan if bad == "torque" else 0.5 * arm.tau_max
    step = controller.resume(State(q, np.zeros(arm.n)), AccelerationRange(*bounds), tau)
    assert step.failure
    assert not controller.find(Integral).action.last.any()
    assert controller.goals.pose_des is goal
    assert controller.goals.q_des is None
    step = controller.step(State(arm.q_start, np.zeros(arm.n)), None, REST)
    np.testing.assert_allclose(step.tau, gravity(arm, arm.q_start), atol=EXACT)
    assert not controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm)).failure
