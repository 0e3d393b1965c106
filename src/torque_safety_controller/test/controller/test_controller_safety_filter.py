# SPDX-License-Identifier: Apache-2.0
"""The safety filter in the controller: what the QP is given, and what is sent in the end."""

import controllers
import numpy as np
from arms import load_arm
from controllers import posture_only

from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

ARM = load_arm("baxter_left_arm")
A_MAX = np.array(read_config("baxter_left_arm", "controller_node")["acceleration_max"])
LIMITS = AccelerationRange(-A_MAX, A_MAX)
ZERO = np.zeros(ARM.n)
SHOULDER, WRIST = 1, 6
STRETCHED = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Where the shoulder cannot hold the arm."""
EDGE = np.array([0.0, -0.64, 0.0, -0.0, 0.0, 0.0, 0.0])
"""Where the shoulder needs 96% of its torque."""
FOLDED = np.array([0.0, -0.8, 0.0, 2.2, 0.0, 0.5, 0.0])
GAINS = posture_only(100.0, 20.0)


def make(filtered=True, gains=GAINS):
    parts = [SafetyFilter(ARM.model, ARM.q_min, ARM.q_max, -A_MAX, A_MAX, ARM.tau_max, ARM.dt)]
    return controllers.make(ARM, *(parts if filtered else []), gains=gains)


def step_towards(controller, goal, q, v=ZERO, limits=LIMITS):
    controller.reset(q)
    controller.goals.set_posture(goal)
    return controller.step(State(q, v), limits)


def test_a_step_to_where_the_arm_cannot_be_held_is_changed_and_others_are_not():
    free, held = (step_towards(make(filtered), STRETCHED, EDGE) for filtered in (False, True))
    assert free.a[SHOULDER] > 1.0
    assert held.a[SHOULDER] < 0.5 * free.a[SHOULDER]
    assert held.relaxation is None
    free, same = (step_towards(make(filtered), FOLDED + 0.1, FOLDED) for filtered in (False, True))
    np.testing.assert_allclose(same.tau, free.tau, atol=1e-6)


def test_plans_brake_harder_than_the_acceleration_limits_where_they_must():
    controller = make()
    state = State(ARM.q_start.copy(), np.zeros(ARM.n))
    state.v[WRIST] = 4.0
    state.q[WRIST] = ARM.q_max[WRIST] - 0.25  # 32 rad/s^2 are needed
    tight = AccelerationRange(np.full(ARM.n, -15.0), np.full(ARM.n, 15.0))
    controller.reset(state.q)
    controller.goals.set_posture(ARM.q_start)
    hardest = 0.0
    for _ in range(30):
        step = controller.step(state, tight)
        hardest = min(hardest, step.a[WRIST])
        state = state.after(step.a, ARM.dt)
        assert state.q[WRIST] <= ARM.q_max[WRIST]
        assert (np.abs(step.tau) <= ARM.tau_max).all()
    assert hardest < -30.0


def test_the_plan_is_allowed_where_the_bounds_ask_for_what_cannot_be_done():
    controller = make()
    up = np.full(ARM.n, 8.0)
    step = step_towards(controller, STRETCHED, EDGE, limits=AccelerationRange(up, up))
    assert step.relaxation is None
    assert (step.a >= controller.find(SafetyFilter).plan - 1e-6).all()


def test_where_it_cannot_be_held_the_arm_goes_to_no_goal_but_slows_down():
    v = np.zeros(ARM.n)
    v[WRIST] = 0.5
    tracks, brakes = (step_towards(make(), q + 0.5, q, v) for q in (FOLDED, STRETCHED))
    assert tracks.tracking
    assert tracks.a[WRIST] > 10.0
    assert not brakes.tracking
    assert brakes.a[WRIST] < -5.0


def test_with_a_plan_the_qp_never_has_to_give_way():
    rng = np.random.default_rng(0)
    controller = make()
    keeper, state = controller.find(SafetyFilter), State(ARM.q_start, ZERO)
    controller.reset(ARM.q_start)
    for k in range(300):
        if k % 60 == 0:
            controller.goals.set_posture(rng.uniform(ARM.q_min, ARM.q_max))
        step = controller.step(state, LIMITS)
        if keeper.slack >= 0.01:
            assert step.relaxation is None or step.relaxation.max() < 1e-3
        q, v = state.after(step.a, ARM.dt)
        state = State(q, np.clip(v, -ARM.v_max, ARM.v_max))
    assert keeper.outcomes["as wanted"] > 200
