# SPDX-License-Identifier: Apache-2.0
"""The safety filter in the controller: what the QP is given, and what is sent in the end."""

from dataclasses import replace

import controllers
import numpy as np
import pytest
from arms import load_arm
from controllers import posture_only

from torque_safety_controller.parts.whole_arm.safety_filter import KEPT, SafetyFilter
from torque_safety_controller.qp import AccelerationRange, LinearConstraints
from torque_safety_controller.step import Part
from torque_safety_controller.supervisor import REST
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config

ARM = load_arm("baxter_left_arm")
VALUES = read_config("baxter_left_arm", "controller_node")
A_MAX = np.array(VALUES["acceleration_max"])
ZERO = np.zeros(ARM.n)
SHOULDER = 1
STRETCHED = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
EDGE = np.array([0.0, -0.64, 0.0, -0.0, 0.0, 0.0, 0.0])
"""Where the shoulder needs 96% of its torque."""
FOLDED = np.array([0.0, -0.8, 0.0, 2.2, 0.0, 0.5, 0.0])
GAINS = posture_only(100.0, 20.0)


def make(filtered=True, gains=GAINS, *more, **arguments):
    keeper = SafetyFilter(ARM.model, ARM.q_min, ARM.q_max, -A_MAX, A_MAX, ARM.tau_max, ARM.dt)
    robot = ARM.robot()
    parts = [keeper] if filtered else []
    return controllers.make(ARM, *parts, *more, robot=robot, gains=gains, **arguments)


def towards_stretched(controller, q=EDGE, v=ZERO, bounds=A_MAX):
    controller.reset(q)
    controller.goals.set_posture(STRETCHED)
    return controller.step(State(q, v), AccelerationRange(-bounds, bounds))


def test_a_step_to_where_the_arm_cannot_be_held_is_changed():
    free, held = towards_stretched(make(False)), towards_stretched(make())
    assert free.a[SHOULDER] > 1.0
    assert held.a[SHOULDER] < 0.5 * free.a[SHOULDER]
    assert held.relaxation is None


def test_elsewhere_nothing_is_changed():
    q = FOLDED
    outputs = []
    for filtered in (False, True):
        controller = make(filtered)
        controller.reset(q)
        controller.goals.set_posture(q + 0.1)
        outputs.append(controller.step(State(q, ZERO), AccelerationRange(-A_MAX, A_MAX)))
    np.testing.assert_allclose(outputs[0].tau, outputs[1].tau, atol=1e-6)


def test_its_torque_is_that_of_the_acceleration_chosen():
    controller = make()
    output = towards_stretched(controller)
    q_mid = EDGE + 0.125 * ARM.dt**2 * output.a
    robot = ARM.robot(0.0)
    robot.update(State(q_mid, 0.5 * ARM.dt * output.a), ZERO)
    np.testing.assert_allclose(output.tau, robot.M @ output.a + robot.h, atol=1e-6)


def test_plans_brake_harder_than_the_acceleration_limits_where_they_must():
    controller = make()
    state = State(ARM.q_start.copy(), np.zeros(ARM.n))
    state.v[6] = 4.0
    state.q[6] = ARM.q_max[6] - 0.25  # 32 rad/s^2 are needed
    tight = AccelerationRange(np.full(ARM.n, -15.0), np.full(ARM.n, 15.0))
    controller.reset(state.q)
    controller.goals.set_posture(ARM.q_start)
    hardest = 0.0
    for _ in range(30):
        output = controller.step(state, tight)
        hardest = min(hardest, output.a[6])
        state = state.after(output.a, ARM.dt)
        assert state.q[6] <= ARM.q_max[6]
        assert (np.abs(output.tau) <= ARM.tau_max).all()
    assert hardest < -30.0


def test_the_plan_is_allowed_where_the_bounds_ask_for_what_cannot_be_done():
    controller = make()
    controller.reset(EDGE)
    controller.goals.set_posture(STRETCHED)
    up = np.full(ARM.n, 8.0)
    output = controller.step(State(EDGE, ZERO), AccelerationRange(up, up))
    assert output.relaxation is None
    assert (output.a >= controller.find(SafetyFilter).plan - 1e-6).all()


def test_without_a_plan_the_arm_brakes():
    """It goes to no goal where it cannot be held: it comes down, and slows down."""
    v = np.zeros(ARM.n)
    v[6] = 0.5
    moved = []
    for q in (FOLDED, STRETCHED):
        controller = make()
        controller.reset(q)
        controller.goals.set_posture(q + 0.5)
        output = controller.step(State(q, v), AccelerationRange(-A_MAX, A_MAX))
        assert output.tracking == (q is FOLDED)
        moved.append(output.a[6])
    assert moved[0] > 10.0
    assert moved[1] < -5.0


def test_rows_of_the_filter_are_not_told_as_those_of_others():
    class Impossible(Part):
        def prepare(self, step):
            far = np.full(1, 1e3)
            step.rows[self] = LinearConstraints(np.eye(step.robot.n)[:1], far, far)

        def learn(self, step):
            self.relaxed = step.relaxation_of(self)

    other = Impossible()
    towards_stretched(make(True, GAINS, other))
    assert other.relaxed.shape == (1,)
    assert other.relaxed[0] > 100.0


def test_without_a_qp_the_arm_brakes_as_the_filter_allows():
    controller = make()
    v = np.array([0.1, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    controller.reset(FOLDED)
    output = controller.step(State(FOLDED, v), None, REST)
    assert controller.find(SafetyFilter).outcomes == {"as wanted": 1}
    np.testing.assert_allclose(output.a, -GAINS.hold_kd * v)
    output = controller.step(State(EDGE, v), None, REST)
    assert controller.find(SafetyFilter).outcomes.total() == 2
    assert (np.abs(output.tau) <= ARM.tau_max).all()


def test_a_disturbance_that_is_known_counts():
    """Seen after a few steps in which the arm fell more than it was told to."""
    loads = []
    for fall in (0.0, -2.0):
        controller = make(gains=replace(GAINS, disturbance_time=1e-6))
        v = np.zeros(ARM.n)
        for _ in range(3):
            output = towards_stretched(controller, ARM.q_start, v)
            v = v + ARM.dt * output.a
            v[SHOULDER] += ARM.dt * fall
            controller.goals.posture = ARM.q_start
            controller.step(State(ARM.q_start, v), AccelerationRange(-A_MAX, A_MAX))
        loads.append(controller.find(SafetyFilter).rest_torque[SHOULDER])
    assert abs(loads[1] - loads[0]) > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_with_the_plan_the_qp_never_has_to_give_way(seed):
    rng = np.random.default_rng(seed)
    controller = make()
    q, v = ARM.q_start.copy(), ZERO.copy()
    controller.reset(q)
    for k in range(300):
        if k % 60 == 0:
            controller.goals.set_posture(rng.uniform(ARM.q_min, ARM.q_max))
        output = controller.step(State(q, v), AccelerationRange(-A_MAX, A_MAX))
        if controller.find(SafetyFilter).slack >= KEPT:
            assert output.relaxation is None or output.relaxation.max() < 1e-3
        q, v = q + v * ARM.dt + 0.5 * output.a * ARM.dt**2, v + output.a * ARM.dt
        v = np.clip(v, -ARM.v_max, ARM.v_max)
    assert controller.find(SafetyFilter).outcomes["as wanted"] > 200
