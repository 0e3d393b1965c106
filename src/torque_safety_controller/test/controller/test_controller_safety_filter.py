# SPDX-License-Identifier: Apache-2.0
"""The safety filter, mostly in the controller: against random goals, and where Baxter is weak."""

import controllers
import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from controllers import posture_only

from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.viability import BoundsSolver

ARM = load_arm("baxter_left_arm")
ZERO, SHOULDER, ELBOW, WRIST = np.zeros(ARM.n), 1, 3, 6
STRETCHED = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Where the shoulder cannot hold the arm."""
EDGE = np.array([0.0, -0.64, 0.0, -0.0, 0.0, 0.0, 0.0])
"""Where the shoulder needs 96% of its torque."""
FOLDED = np.array([0.0, -0.8, 0.0, 2.2, 0.0, 0.5, 0.0])
RESERVE = 0.03
"""Share of the torque limits that plans leave."""


def acceleration_limits(robot) -> AccelerationRange:
    values = read_config(robot, "controller_node")
    return AccelerationRange(*(np.array(values[f"acceleration_{end}"]) for end in ("min", "max")))


LIMITS = acceleration_limits("baxter_left_arm")


def make_filter(arm=ARM, limits=LIMITS, share=1.0, **reserve) -> SafetyFilter:
    return SafetyFilter(
        arm.model, arm.q_min, arm.q_max, *limits, share * arm.tau_max, arm.dt, **reserve
    )


def make(filtered=True):
    parts = [make_filter()] if filtered else []
    return controllers.make(ARM, *parts, gains=posture_only(100.0, 20.0))


def test_a_load_is_known_to_the_plans_as_if_it_were_a_part_of_the_arm():
    """One that the model gets while the controller runs, and one that it has from the start."""
    mass, centre, moments = 1.0, np.array([0.0, 0.0, 0.1]), 1e-3 * np.eye(3)
    link = ARM.model.frames[frame_id(ARM.model, ARM.frame)]
    loaded, late = ARM.model.copy(), ARM.model.copy()
    loaded.appendBodyToJoint(link.parentJoint, pin.Inertia(mass, centre, moments), link.placement)
    told = []
    for model in (loaded, late):
        arm = ARM._replace(model=model)
        keeper = make_filter(arm)
        controller = controllers.make(arm, keeper, gains=posture_only(100.0, 20.0))
        if model is late:
            controller.robot.payload.carry(ARM.frame, mass, centre, moments)
            controller.remodel()
        controller.reset(EDGE)
        controller.goals.set_posture(EDGE)
        for v in (ZERO, 0.1 * arm.v_max):
            step = controller.step(State(EDGE, v), LIMITS)
            told.append([*step.tau, keeper.slack, *keeper.rest_torque])
    np.testing.assert_allclose(told[2:], told[:2], atol=1e-6)  # N m


# Motions


def play(robot, seconds, goal=None, share=1.0, filtered=True, curve=()):
    """Send an arm to a goal, or to and fro as hard as it can; then let it come to rest.

    With a share of its torque limits, and exact accelerations, each kept for a control period.
    `curve` is `velocity_offset` and `deceleration_limit`.

    Returns:
        By how much positions and speeds passed their limits, and bounds were given up; where the
        arm is in the end; the outcomes of the filter.
    """
    arm, a_limits = load_arm(robot), acceleration_limits(robot)
    limits = arm.q_min, arm.q_max, arm.v_max, *a_limits, *curve
    joints = JointLimits(arm.model.names[1:], *limits)
    margins = 0.05 * np.minimum(-a_limits.lower, a_limits.upper)
    solver = BoundsSolver(joints, 2.0 * arm.dt, margins, period=arm.dt)
    speeds = {"velocity_offset": curve[0], "deceleration_limit": curve[1]} if curve else {}
    keeper = make_filter(arm, a_limits, share, **speeds)
    controller = controllers.make(
        arm,
        *([keeper] if filtered else []),
        tau_max=share * arm.tau_max,
        gains=posture_only(400.0, 40.0),
    )
    rng = np.random.default_rng(0)
    state, beyond = State(arm.q_start, np.zeros(arm.n)), np.zeros(3)
    controller.reset(arm.q_start)
    for k in range(round((seconds + 1.0) / arm.dt)):
        if k * arm.dt > seconds:
            controller.goals.set_posture(state.q)
        elif k % round(0.4 / arm.dt) == 0:
            ends = np.where(rng.random(arm.n) < 0.5, arm.q_min, arm.q_max)
            controller.goals.set_posture(ends if goal is None else goal)
        lower, upper, _ = solver.bounds(*state)
        step = controller.step(state, AccelerationRange(lower, upper))
        state = state.after(step.a, arm.dt)
        place = np.maximum(state.q - arm.q_max, arm.q_min - state.q).max()
        given_up = 0.0 if step.relaxation is None else step.relaxation.max()
        lowest, highest = joints.velocities(state.q)
        now = [place, np.maximum(state.v - highest, lowest - state.v).max(), given_up]
        beyond = np.maximum(beyond, now)
    return beyond, state, keeper.outcomes


@pytest.mark.parametrize(
    ("robot", "share"), [("baxter_left_arm", 1.0), ("panda", 0.6), ("talos_left_arm", 0.6)]
)
def test_no_limit_is_passed_and_in_the_end_the_arm_rests_where_it_can_be_held(robot, share):
    arm = load_arm(robot)
    beyond, (q, v), outcomes = play(robot, 2.0, share=share)
    assert (beyond <= [1e-9, 1e-9, 1e-3]).all()
    assert outcomes["outside"] == 0
    assert outcomes["as wanted"] > 0.5 * outcomes.total()
    assert np.abs(v).max() < 0.05  # rad/s
    assert (np.abs(controllers.gravity(arm, q)) <= share * arm.tau_max).all()


def test_speed_limits_that_depend_on_position_are_kept():
    curve = np.full(7, 0.3), np.array([6.0, 2.5, 4.0, 4.0, 10.0, 6.0, 10.0])
    beyond, (q, v), outcomes = play("panda", 2.0, share=0.6, curve=curve)
    assert (beyond <= [1e-9, 1e-9, 1e-3]).all()
    assert outcomes["outside"] == 0
    assert outcomes["as wanted"] > 0.5 * outcomes.total()
    assert np.abs(v).max() < 0.05  # rad/s


def test_the_arm_stops_where_its_shoulder_can_still_hold_it_and_without_the_filter_it_falls():
    beyond, (q, _), _ = play("baxter_left_arm", 2.0, STRETCHED)
    load = np.abs(controllers.gravity(ARM, q))[SHOULDER] / ARM.tau_max[SHOULDER]
    assert 0.94 <= load <= 1.0 - RESERVE
    assert beyond[2] < 1e-3
    _, (q, _), _ = play("baxter_left_arm", 2.0, STRETCHED, filtered=False)
    assert q[SHOULDER] > STRETCHED[SHOULDER] + 0.5


# A step


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
    controller.reset(state.q)
    controller.goals.set_posture(ARM.q_start)
    hardest = 0.0
    for _ in range(30):
        step = controller.step(state, AccelerationRange(ZERO - 15.0, ZERO + 15.0))
        hardest = min(hardest, step.a[WRIST])
        state = state.after(step.a, ARM.dt)
        assert state.q[WRIST] <= ARM.q_max[WRIST]
    assert hardest < -30.0


def test_the_plan_is_allowed_where_the_bounds_ask_for_what_cannot_be_done():
    controller = make()
    step = step_towards(controller, STRETCHED, EDGE, limits=AccelerationRange(ZERO + 8, ZERO + 8))
    assert step.relaxation is None
    assert (step.a >= controller.find(SafetyFilter).plan - 1e-6).all()


def test_where_it_cannot_be_held_the_arm_goes_to_no_goal_but_slows_down():
    v = np.zeros(ARM.n)
    v[WRIST] = 0.5
    controllers_of = make(), make()
    tracks, brakes = (
        step_towards(controller, q + 0.5, q, v)
        for controller, q in zip(controllers_of, (FOLDED, STRETCHED), strict=True)
    )
    assert tracks.tracking
    assert tracks.a[WRIST] > 10.0
    assert not brakes.tracking
    assert brakes.a[WRIST] < -5.0
    assert (
        "cannot be held where it would come to rest"
        in controllers_of[1].find(SafetyFilter).trouble
    )


def test_a_plan_stays_in_hand_whatever_is_wanted_also_what_no_qp_would():
    keeper, rng = make_filter(), np.random.default_rng(0)
    state, least = State(ARM.q_start, ZERO), np.inf
    for k in range(round(1.5 / ARM.dt)):
        if k % 30 == 0:
            wanted = rng.choice([-1e3, 1e3], ARM.n)
        keeper.update(*state, ZERO, *LIMITS)
        least = min(least, keeper.slack)
        a = keeper.passed(np.clip(wanted, keeper.lower, keeper.upper))
        state = state.after(a, ARM.dt)
    assert least > -1e-9
    assert keeper.outcomes["changed"] > 0
    assert keeper.outcomes["outside"] == 0
    np.testing.assert_array_equal(keeper.passed(ZERO + np.nan), keeper.plan)


def test_plans_leave_a_reserve_and_count_the_torque_that_is_more_than_it():
    """Whatever acts besides, up to the reserve, may change at any time: plans do not see it."""
    reserve = 0.1 * ARM.tau_max
    keeper = make_filter(torque_reserve=reserve)
    q, wide = ARM.q_start.copy(), np.full(ARM.n, 1e3)
    q[ELBOW] = 2.3
    np.testing.assert_allclose(keeper.usable, (1.0 - RESERVE) * ARM.tau_max - reserve)
    keeper.update(q, ZERO, ZERO, -wide, wide)
    held = keeper.rest_torque
    for share, counted in ((-1.0, 0.0), (0.7, 0.0), (1.5, 0.5), (-3.0, -2.0)):
        keeper.update(q, ZERO, share * reserve, -wide, wide)
        np.testing.assert_allclose(keeper.rest_torque, held + counted * reserve, atol=1e-9)
