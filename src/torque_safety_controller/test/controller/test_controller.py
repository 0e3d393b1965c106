# SPDX-License-Identifier: Apache-2.0
import itertools
import math
from collections import deque
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import nnls

from torque_safety_controller.additional_torque import (
    MODES,
    AdditionalSettings,
    AdditionalTorque,
)
from torque_safety_controller.controller import Controller, Gains
from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.tasks.pose_task import pose_error
from viability_bounds_pkg.state import State

GAINS = Gains(
    pose_kp=10.0,
    pose_kd=6.0,
    pose_weight=1.0,
    posture_kp=8.0,
    posture_kd=5.0,
    posture_weight=1e-3,
    hold_kd=20.0,
)
EXACT = 1e-9  # N m; rounding
SOLVED = 1e-4  # rad/s^2; how exactly the QP is solved
KHZ = 1e-3  # s
WIDE = 1e3  # rad/s^2; bounds that no one feels


def make(arm, **arguments) -> Controller:
    return Controller(
        arm.robot(),
        arguments.pop("tau_max", arm.tau_max),
        arguments.pop("gains", GAINS),
        **arguments,
    )


def strong(arm, **arguments) -> Controller:
    """A controller that torque limits do not keep from anything."""
    return make(arm, tau_max=np.full(arm.n, 1e4), **arguments)


def wide(arm) -> AccelerationRange:
    return AccelerationRange(np.full(arm.n, -WIDE), np.full(arm.n, WIDE))


def pose_at(arm, q) -> pin.SE3:
    robot = arm.robot(0.0)
    robot.update(State(q, np.zeros(arm.n)), np.zeros(arm.n))
    return robot.pose.copy()


def gravity(arm, q) -> np.ndarray:
    return pin.computeGeneralizedGravity(arm.model, arm.model.createData(), q)


def assert_may_be_sent(step, arm) -> None:
    assert step.tau.shape == (arm.n,)
    assert np.isfinite(step.tau).all()
    assert (np.abs(step.tau) <= arm.tau_max).all()


class Fixed:
    """An additional torque that is always the same."""

    idle = False

    def __init__(self, torque) -> None:
        self._torque = torque

    def reset(self) -> None:
        """Nothing to forget."""

    def torque(self, robot, v, a_last, elapsed):
        return self._torque


def integral(arm, mode, **changed) -> AdditionalSettings:
    settings = IntegralSettings(**{"budget": 0.2 * arm.tau_max, "gain": 30.0} | changed)
    return AdditionalSettings(mode, settings, 2.0 * arm.tau_max)


def with_integral(arm, mode="joints", gains=GAINS, rate=None, **changed) -> Controller:
    """A controller at 1 kHz."""
    additional = AdditionalTorque(integral(arm, mode, **changed), slice(0, 3))
    return Controller(arm.robot(KHZ), arm.tau_max, gains, rate, additional)


# The output, whatever comes


NUMBERS = st.one_of(
    st.floats(-4.0, 4.0),
    st.floats(-1e3, 1e3),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324]),
)
VECTORS = arrays(float, 7, elements=NUMBERS)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    q=VECTORS,
    v=VECTORS,
    a=VECTORS,
    width=VECTORS,
    additional=st.one_of(st.none(), VECTORS),
    goals=st.sampled_from(["none", "pose", "posture", "both"]),
    after=st.sampled_from(["step", "brake", "hold"]),
)
def test_torques_are_finite_and_within_their_limits_whatever_comes(
    q, v, a, width, additional, goals, after
):
    arm = load_arm("baxter_left_arm")
    torque = None if additional is None else Fixed(additional)
    controller = make(arm, additional=torque)
    if goals in ("pose", "both"):
        controller.set_pose_goal(pose_at(arm, arm.q_start + 0.2))
    if goals in ("posture", "both"):
        controller.set_posture_goal(arm.q_start - 0.2)
    controller.reset(arm.q_start)
    with np.errstate(all="ignore"):
        upper = a + np.abs(width)
        assert_may_be_sent(controller.step(State(q, v), AccelerationRange(a, upper)), arm)
        # The same afterwards, when the state is sane and only the past is not.
        bounds = wide(arm)
        state = State(arm.q_start, np.zeros(arm.n))
        step = {
            "step": lambda: controller.step(state, bounds),
            "brake": lambda: controller.brake(state, bounds),
            "hold": lambda: controller.hold(state),
        }[after]()
        assert_may_be_sent(step, arm)
        if additional is None:
            # The acceleration of the last step may still be beyond sense, but not for long.
            assert not controller.step(state, bounds).failure


def test_random_states_outside_all_limits(arm):
    rng = np.random.default_rng(1)
    controller = make(arm)
    controller.set_pose_goal(pose_at(arm, arm.q_start))
    saturated = relaxed = 0
    for _ in range(300):
        q = rng.uniform(1.5 * arm.q_min, 1.5 * arm.q_max)
        v = rng.uniform(-4.0, 4.0, arm.n) * arm.v_max
        lower = rng.uniform(-30.0, 30.0, arm.n)
        step = controller.step(
            State(q, v), AccelerationRange(lower, lower + rng.uniform(0.0, 10.0, arm.n))
        )
        assert_may_be_sent(step, arm)
        assert not step.failure
        saturated += (np.abs(step.tau) > 0.999 * arm.tau_max).any()
        relaxed += step.relaxation is not None
    assert saturated > 20
    assert relaxed > 20


def test_a_state_that_is_not_finite_is_survived(arm):
    controller = make(arm)
    controller.set_pose_goal(pose_at(arm, arm.q_start))
    rest = State(arm.q_start, np.zeros(arm.n)), wide(arm)
    before = controller.step(*rest)
    for bad in (math.nan, math.inf, 1e200):
        q, v = arm.q_start.copy(), np.zeros(arm.n)
        v[2] = bad
        with np.errstate(all="ignore"):
            step = controller.step(State(q, v), wide(arm))
        assert_may_be_sent(step, arm)
        assert not step.tracking
        assert step.failure
        # What cannot be computed is held.
        np.testing.assert_array_equal(step.tau, before.tau)
        assert not controller.step(*rest).failure


def test_an_additional_torque_that_is_not_finite_leaves_the_arm_held(arm):
    controller = make(arm, additional=Fixed(np.full(arm.n, math.nan)))
    controller.set_pose_goal(pose_at(arm, arm.q_start))
    q, v = arm.q_start, np.zeros(arm.n)
    for step in (controller.step(State(q, v), wide(arm)), controller.hold(State(q, v))):
        assert not step.tracking
        np.testing.assert_allclose(step.tau, gravity(arm, q), atol=EXACT)
    assert controller.step(State(q, v), wide(arm)).failure


def test_the_torque_limits_hold_with_the_additional_torque_in_them(arm):
    push = 0.8 * arm.tau_max
    rng = np.random.default_rng(2)
    controller = make(arm, additional=Fixed(push))
    controller.set_posture_goal(arm.q_max)
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
    controller.set_pose_goal(pose_at(arm, arm.q_start))
    last, reached = None, np.zeros(arm.n, dtype=bool)
    for k in range(300):
        q, v = arm.random_state(rng)
        if k % 7 == 3:
            v[1] = math.nan
        lower = rng.uniform(-30.0, 20.0, arm.n)
        with np.errstate(all="ignore"):
            step = (
                controller.hold(State(q, v))
                if k % 5 == 0
                else controller.step(
                    State(q, v), AccelerationRange(lower, lower + rng.uniform(0.0, 10.0, arm.n))
                )
            )
        assert_may_be_sent(step, arm)
        if last is not None:
            change = np.abs(step.tau - last)
            assert (change <= rate * arm.dt + EXACT).all()
            reached |= change > 0.99 * rate * arm.dt
        last = step.tau
    assert reached[np.isfinite(rate)].all(), "the limit is not felt"
    # A robot that was away begins anew.
    controller.reset(arm.q_start)
    q, v = arm.random_state(rng)
    free = make(arm).hold(State(q, v)).tau
    np.testing.assert_allclose(controller.hold(State(q, v)).tau, free, atol=EXACT)


# What it does when it can


def test_accelerations_stay_inside_their_bounds(arm):
    rng = np.random.default_rng(4)
    controller = make(arm)
    controller.set_posture_goal(arm.q_max - 0.1)
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
    controller.set_pose_goal(pose_at(arm, arm.q_start + 0.1))
    for _ in range(10):
        q, v = arm.random_state(rng)
        controller.reset(q)
        step = controller.step(State(q, v), wide(arm))
        _, v_end = arm.move(q, v, step.tau, arm.dt, steps=8)
        asked = step.a * arm.dt
        np.testing.assert_allclose(v_end - v, asked, atol=0.02 * np.abs(asked).max() + 1e-4)


def test_bounds_that_the_motors_cannot_keep_are_relaxed_and_reported(arm):
    controller = make(arm)
    controller.set_posture_goal(arm.q_start)
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
        controller.set_pose_goal(pose_at(arm, arm.q_start + 0.1))
    else:
        controller.set_posture_goal(arm.q_start + 0.1)
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
        "hold": lambda q, v: controller.hold(State(q, v)),
        "brake": lambda q, v: controller.brake(State(q, v), bounds),
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
    controller.set_pose_goal(pose_at(arm, arm.q_start + 0.8))
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
    controller.set_pose_goal(goal)
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


# Each gain reaches the output


@pytest.mark.parametrize(
    ("gain", "value"),
    [
        ("pose_kp", 20.0),
        ("pose_kd", 12.0),
        ("pose_weight", 1e-4),
        ("posture_kp", 16.0),
        ("posture_kd", 10.0),
        ("posture_weight", 1.0),
        ("pose_speed_max", np.array([0.01, 0.05])),
    ],
)
def test_each_gain_of_the_tasks_reaches_the_torque(arm, gain, value):
    assert not np.array_equal(getattr(GAINS, gain), value)

    def tau(gains):
        controller = make(arm, gains=gains)
        controller.reset(arm.q_start + 0.1)
        controller.set_pose_goal(pose_at(arm, arm.q_start + 0.05))
        return controller.step(State(arm.q_start, 0.02 * arm.v_max), wide(arm)).tau

    changed = replace(GAINS, **{gain: value})
    assert np.abs(tau(changed) - tau(GAINS)).max() > 1e-3
    # Also when it changes while the controller runs.
    controller = make(arm)
    controller.reset(arm.q_start + 0.1)
    controller.set_pose_goal(pose_at(arm, arm.q_start + 0.05))
    controller.gains = changed
    step = controller.step(State(arm.q_start, 0.02 * arm.v_max), wide(arm))
    np.testing.assert_allclose(step.tau, tau(changed), atol=1e-6)


@pytest.mark.parametrize("way", ["hold", "rest"])
def test_the_damping_in_hold_reaches_the_acceleration(arm, way):
    v = 0.01 * arm.v_max
    for kd in (5.0, 40.0):
        controller = strong(arm, gains=replace(GAINS, hold_kd=kd))
        step = (
            controller.hold(State(arm.q_start, v))
            if way == "hold"
            else controller.brake(State(arm.q_start, v), wide(arm))
        )
        np.testing.assert_allclose(step.a, -kd * v, rtol=1e-4, atol=SOLVED)


def test_a_pose_without_weight_is_left_out(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.reset(arm.q_start + 0.1)
    controller.set_pose_goal(pose_at(arm, arm.q_start + 0.3))
    step = controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm))
    np.testing.assert_allclose(step.a, GAINS.posture_kp * 0.1, atol=1e-3)


def test_the_posture_is_where_it_started_until_one_is_asked_for(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.set_pose_goal(pose_at(arm, arm.q_start))
    at_rest = State(arm.q_start, np.zeros(arm.n)), wide(arm)
    controller.reset(arm.q_start + 0.1)
    np.testing.assert_allclose(controller.step(*at_rest).a, GAINS.posture_kp * 0.1, atol=1e-3)
    controller.reset(arm.q_start - 0.1)
    np.testing.assert_allclose(controller.step(*at_rest).a, -GAINS.posture_kp * 0.1, atol=1e-3)
    controller.set_posture_goal(arm.q_start + 0.05)
    np.testing.assert_allclose(controller.step(*at_rest).a, GAINS.posture_kp * 0.05, atol=1e-3)


def test_start_keeps_a_copy_of_the_state(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.set_pose_goal(pose_at(arm, arm.q_start))
    q = arm.q_start.copy()
    controller.reset(q)
    q += 1.0  # a reader may use its array again
    step = controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm))
    np.testing.assert_allclose(step.a, 0.0, atol=1e-3)


# With integral action


DEEDS = st.lists(
    st.tuples(
        st.sampled_from(["step", "brake", "hold", "bumpless_transfer", "reset"]),
        st.sampled_from([None, *MODES]),
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
    controller.set_posture_goal(arm.q_start + 0.3)
    with np.errstate(all="ignore"):
        for deed, other, elapsed, dq, v, x in deeds:
            if other is not None:
                controller.additional.settings = integral(arm, other, budget=budget)
            q = arm.q_start + dq
            bounds = AccelerationRange(-np.abs(x), np.abs(x))
            if deed == "reset":
                controller.reset(q)
                continue
            act = getattr(controller, deed)
            last = {"hold": (elapsed,), "bumpless_transfer": (bounds, x)}
            step = act(State(q, v), *last.get(deed, (bounds, elapsed)))
            assert_may_be_sent(step, arm)
            assert np.isfinite(controller.additional.last).all()
        # Once the world makes sense again, so does the controller.
        controller.goals.pose_des = None
        controller.set_posture_goal(arm.q_start)
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
        controller.set_pose_goal(goal)
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
        controller.bumpless_transfer(state, wide(arm), sign * 0.5 * arm.tau_max)
        controller.goals.pose_des = None
        controller.set_posture_goal(arm.q_max)
        for _ in range(5):
            step = controller.step(state, wide(arm))
            assert_may_be_sent(step, arm)
            assert not step.failure
            added = controller.additional.last
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
        step = controller.hold(State(q, v), KHZ)
        saturated += abs(step.tau[0]) == arm.tau_max[0]
        q, v = arm.move(q, v, step.tau, KHZ, steps=2)
    assert saturated > 4
    assert controller.additional.skipped == 0
    # With the accelerations that were wished for, half of the budget would be used up by now.
    assert (np.abs(controller.additional.last) < 0.02 * arm.tau_max).all()


# Handover


@pytest.mark.parametrize("mode", MODES)
def test_it_takes_over_the_torque_of_others(arm, mode):
    rng = np.random.default_rng(6)
    for _ in range(5):
        controller = with_integral(arm, mode)
        tau = gravity(arm, arm.q_start) + rng.uniform(-0.15, 0.15, arm.n) * arm.tau_max
        tau = np.clip(tau, -arm.tau_max, arm.tau_max)
        state = State(arm.q_start, np.zeros(arm.n))
        controller.set_pose_goal(pose_at(arm, arm.q_start + 0.5))  # forgotten
        step = controller.bumpless_transfer(state, wide(arm), tau)
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
    controller.bumpless_transfer(state, wide(arm), 1.5 * arm.tau_max)
    step = controller.step(state, wide(arm))
    assert_may_be_sent(step, arm)
    assert (step.tau > 0.97 * arm.tau_max).all()


def test_the_rate_of_torque_counts_from_what_was_measured(arm):
    rate = np.full(arm.n, 1.0)
    controller = with_integral(arm, "none", rate=rate)
    state = State(arm.q_start, np.zeros(arm.n))
    tau = gravity(arm, arm.q_start) + 0.2 * arm.tau_max
    controller.bumpless_transfer(state, wide(arm), tau)
    assert (np.abs(controller.step(state, wide(arm)).tau - tau) <= rate * KHZ + EXACT).all()


@pytest.mark.parametrize("bad", ["bounds", "torque", "position"])
def test_a_handover_that_fails_leaves_everything_as_it_was(arm, bad):
    controller = with_integral(arm)
    goal = pose_at(arm, arm.q_start + 0.1)
    controller.set_pose_goal(goal)
    nan = np.full(arm.n, math.nan)
    q = nan if bad == "position" else arm.q_start
    bounds = (nan, nan) if bad == "bounds" else wide(arm)
    tau = nan if bad == "torque" else 0.5 * arm.tau_max
    step = controller.bumpless_transfer(State(q, np.zeros(arm.n)), AccelerationRange(*bounds), tau)
    assert step.failure
    assert not controller.additional.last.any()
    assert controller.goals.pose_des is goal
    assert controller.goals.q_des is None
    step = controller.hold(State(arm.q_start, np.zeros(arm.n)))
    np.testing.assert_allclose(step.tau, gravity(arm, arm.q_start), atol=EXACT)
    assert not controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm)).failure
