# SPDX-License-Identifier: Apache-2.0
"""Modes of the controller node, and how it matches states with limits."""

import math
import re
import time

import numpy as np
import pinocchio as pin
import pytest
from controller_chain import MS, NODE
from diagnostic_msgs.msg import DiagnosticStatus
from node_chain import (
    ARM,
    GOAL,
    GOAL_Q,
    JOINTS,
    LOWER,
    REST,
    SAME_TORQUE,
    UPPER,
    NodeChain,
    Q,
    V,
    expected,
    give_goal,
    pose_at,
    pose_message,
    torque_for,
)

from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.parts.integral import Integral
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST as HELD
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import joint_state

# Modes


def test_it_is_stopped_and_silent_without_a_state(ros):
    chain = NodeChain(ros)
    ros.wait_until(lambda: chain.reported("mode") == "STOPPED", "diagnostics")
    assert chain.reported("reason") == "no joint state yet"
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.ERROR
    chain.poses.publish(pose_message(GOAL))
    ros.run_for(0.1, each=lambda: chain.bound(10))
    assert not chain.commands


def test_without_a_goal_it_brings_the_arm_to_rest(ros):
    chain = NodeChain(ros)
    tau = chain.answer(10)
    np.testing.assert_allclose(
        tau,
        expected().step(State(Q, V), AccelerationRange(LOWER, UPPER), HELD).tau,
        atol=SAME_TORQUE,
    )
    chain.await_mode("HOLD", "no goal")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN


@pytest.mark.parametrize("frame", ["base", ""])
def test_with_a_pose_goal_it_tracks(ros, frame):
    chain = NodeChain(ros)
    chain.poses.publish(pose_message(GOAL, frame))
    ros.wait_until(lambda: chain.reported("goals_pending") == "1", "the goal")
    tau = chain.answer(10)
    step = expected(GOAL).step(State(Q, V), AccelerationRange(LOWER, UPPER))
    np.testing.assert_allclose(tau, step.tau, atol=SAME_TORQUE)
    assert (
        np.abs(tau - expected().step(State(Q, V), AccelerationRange(LOWER, UPPER), HELD).tau).max()
        > 0.1
    )
    chain.await_mode("TRACKING", "goal")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.OK
    error = pin.log6(pose_at(Q).actInv(GOAL)).vector
    assert float(chain.reported("position_error_m")) == pytest.approx(
        np.linalg.norm(error[:3]), rel=1e-6
    )
    assert float(chain.reported("orientation_error_rad")) == pytest.approx(
        np.linalg.norm(error[3:]), rel=1e-6
    )


def test_poses_are_in_the_base_frame(ros):
    frame = "left_arm_mount"
    base = ARM.model.frames[ARM.model.getFrameId(frame)].placement
    assert not base.isIdentity(0.1)
    chain = NodeChain(ros, base_frame=frame)
    chain.poses.publish(pose_message(base.actInv(GOAL), frame))
    ros.wait_until(lambda: chain.reported("goals_pending") == "1", "the goal")
    tau = chain.answer(10)
    np.testing.assert_allclose(
        tau,
        expected(GOAL).step(State(Q, V), AccelerationRange(LOWER, UPPER)).tau,
        atol=SAME_TORQUE,
    )


def test_with_a_posture_goal_it_tracks_whatever_the_order_of_names(ros):
    chain = NodeChain(ros)
    names = [*reversed(JOINTS), "other"]
    chain.postures.publish(joint_state(names, 0, [*reversed(GOAL_Q), math.nan]))
    ros.wait_until(lambda: chain.reported("goals_pending") == "1", "the goal")
    tau = chain.answer(10)
    step = expected(posture=GOAL_Q).step(State(Q, V), AccelerationRange(LOWER, UPPER))
    np.testing.assert_allclose(tau, step.tau, atol=SAME_TORQUE)
    chain.await_mode("TRACKING")


@pytest.mark.parametrize("held", [[], np.full(ARM.n, 0.1)], ids=["not known", "on"])
@pytest.mark.parametrize("before", [0, 100], ids=["at once", "after a second"])
def test_where_motors_hold_the_arm_before_it_starts_goals_fade_in(ros, held, before):
    chain = NodeChain(ros)
    at_rest = np.zeros(ARM.n)

    def answer(stamp):
        def send():
            chain.bound(stamp)
            chain.send_state(stamp, Q, at_rest, held)

        return chain.await_command(stamp, send)

    rest = expected().step(State(Q, at_rest), AccelerationRange(LOWER, UPPER), HELD).tau
    goal = expected(posture=GOAL_Q).step(State(Q, at_rest), AccelerationRange(LOWER, UPPER)).tau
    for k in range(before):
        answer(10 + 10 * k)
    chain.postures.publish(joint_state(JOINTS, 0, GOAL_Q))
    ros.wait_until(lambda: chain.reported("goals_pending") == "1", "the goal")
    taus = [answer(10 + 10 * (before + k)) for k in range(10)]
    share = [np.abs(tau - rest).max() / np.abs(goal - rest).max() for tau in taus]
    assert share[0] < (0.05 if before else 0.01)  # at first as if there was no goal
    assert 0.02 < share[-1] < 0.1  # 90 of 500 ms
    assert (np.diff(share) < 0.05).all()


class Motors:
    """Motors that give what is commanded, or something else, in states of an arm at rest."""

    def __init__(self, ros, **changed):
        self.chain = NodeChain(ros, **changed)
        self.stamp, self.tau = 0, np.zeros(ARM.n)
        self.chain.postures.publish(joint_state(JOINTS, 0, GOAL_Q))
        ros.wait_until(lambda: self.chain.reported("goals_pending") == "1", "the goal")

    def answer(self, count, effort=None):
        """Answer states; return by how much of the goal's torques the last command is."""
        at_rest = np.zeros(ARM.n)
        for _ in range(count):
            self.stamp += 10
            given = self.tau if effort is None else effort + 1e-9 * (self.stamp % 20)

            def send(given=given):
                self.chain.bound(self.stamp)
                self.chain.send_state(self.stamp, Q, at_rest, given)

            self.tau = self.chain.await_command(self.stamp, send)
        bounds = AccelerationRange(LOWER, UPPER)
        rest = expected().step(State(Q, at_rest), bounds, HELD).tau
        goal = expected(posture=GOAL_Q).step(State(Q, at_rest), bounds).tau
        return np.abs(self.tau - rest).max() / np.abs(goal - rest).max()


def test_while_the_motors_give_other_torques_the_arm_is_slowed(ros, capfd):
    motors = Motors(ros)
    assert motors.answer(150) == pytest.approx(1.0)
    others = -motors.tau
    assert motors.answer(2, others) == pytest.approx(1.0)
    shares = [motors.answer(1, others) for _ in range(20)]
    assert (np.diff(shares) < 1e-3).all() and max(shares[5:]) < 0.1  # within 50 ms
    motors.chain.ros.wait_until(
        lambda: motors.chain.reported("commands_ignored") == "1", "the report"
    )
    said = "the motors do not give the torques that were sent"
    assert said in ros.diagnostics[NODE]["message"]
    assert capfd.readouterr().err.count(f"{said}: the arm is slowed") == 1
    shares = [motors.answer(1) for _ in range(60)]
    assert shares[-1] == pytest.approx(1.0)
    assert (np.diff(shares) < 0.05).all()


def test_what_was_learned_until_the_motors_were_told_is_forgotten(ros):
    motors = Motors(ros, disturbance_time=1e-6)
    motors.answer(150)  # states of an arm that does not move
    observer = motors.chain.node._controller.find(Disturbance)
    learned = observer.estimate.copy()
    assert np.abs(learned).max() > 0.5
    others = -motors.tau
    motors.answer(2, others)
    np.testing.assert_array_equal(observer.estimate, learned)  # nothing is learned from these
    motors.answer(1, others)
    assert not observer.estimate.any()


def test_integral_action_fades_where_the_motors_give_other_torques_for_long(ros):
    """It would push against a robot that keeps its own limits, and so go on not to be obeyed."""
    motors = Motors(ros, integral_action="joints")
    motors.answer(150)
    added = motors.chain.node._controller.find(Integral).action
    before = np.abs(added.last).max()
    assert before > 0.1
    others = -motors.tau
    motors.answer(45, others)
    assert np.abs(added.last).max() == pytest.approx(before, rel=0.1)
    motors.answer(80, others)
    assert np.abs(added.last).max() < 0.1 * before


def test_integral_action_fades_after_a_pause_in_which_the_robot_stopped_itself(ros):
    """It balanced the friction of a motion; an arm that stands would be pushed by it."""
    motors = Motors(ros, integral_action="joints", bounds_timeout=0.2)
    motors.answer(150)
    added = motors.chain.node._controller.find(Integral).action
    before = np.abs(added.last).max()
    assert before > 0.1
    motors.stamp += 150  # shorter
    motors.answer(1)
    assert np.abs(added.last).max() > 0.9 * before
    motors.stamp += 300
    motors.answer(1)
    after = np.abs(added.last).max()
    assert after > 0.8 * before  # no kick
    motors.answer(30)
    assert np.abs(added.last).max() < 0.5 * before


def test_where_torques_are_not_reported_any_more_commands_count_as_obeyed(ros):
    motors = Motors(ros)
    motors.answer(150)
    motors.answer(5, -motors.tau)
    assert motors.chain.node._supervisor._causes.get("ignored")
    motors.stamp += 10

    def send():
        motors.chain.bound(motors.stamp)
        motors.chain.send_state(motors.stamp, Q, np.zeros(ARM.n), [])

    motors.chain.await_command(motors.stamp, send)
    assert not motors.chain.node._supervisor._causes.get("ignored")


@pytest.mark.parametrize("changed", [{}, {"effort_tolerance": 0.0}], ids=["unknown", "not wanted"])
def test_motors_that_cannot_be_compared_change_nothing(ros, changed):
    motors = Motors(ros, **changed)
    others = np.full(ARM.n, 0.1)  # motors that are on
    motors.answer(60, None if changed else others)
    assert motors.answer(20, others) == pytest.approx(1.0)
    ros.run_for(0.1)
    assert motors.chain.reported("commands_ignored") == "0"


def goes_on_when_it_rests(chain, stamps, why):
    """Let the arm move on, which keeps it in HOLD, and then rest."""
    chain.await_mode("HOLD", f"comes to rest: {why}", each=lambda: chain.both(next(stamps)))
    chain.ros.run_for(0.2, each=lambda: chain.both(next(stamps)))
    assert chain.reported("mode") == "HOLD"
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))


def test_it_holds_while_bounds_are_missing_and_goes_on_by_itself(ros):
    chain = NodeChain(ros, bounds_timeout=0.1)
    stamp = give_goal(chain)
    begin = time.monotonic()
    # A state whose limits do not come is held, but not before the time-out.
    tau = chain.await_command(stamp + 10, lambda: chain.state(stamp + 10))
    assert time.monotonic() - begin >= 0.1
    chain.await_mode("HOLD", "acceleration limits are stale")
    assert float(chain.reported("goal_share")) == 0.0  # within margins it returns gently, too
    hold = expected(GOAL).step(State(Q, V), None, HELD)
    np.testing.assert_allclose(tau, hold.tau, atol=0.5)  # the node's last acceleration differs
    # The next ones are held at once.
    begin = time.monotonic()
    for k in range(20, 25):
        chain.await_command(stamp + k, lambda k=k: chain.state(stamp + k))
    assert chain.reported("mode") == "HOLD"
    stamps = iter(range(stamp + 30, stamp + 2000))
    goes_on_when_it_rests(chain, stamps, "acceleration limits are stale")


def test_a_controller_that_was_paused_in_motion_lets_the_arm_come_to_rest(ros):
    """It goes on by its goals only then; a shorter row slows the arm, and that is all."""
    chain = NodeChain(ros, bounds_timeout=0.2)
    stamp = give_goal(chain)
    chain.answer(stamp + 100)
    ros.wait_until(lambda: chain.reported("missed_rows_too_long") == "1")
    assert chain.reported("mode") == "TRACKING"
    stamps = iter(range(stamp + 401, stamp + 2000))
    chain.answer(stamp + 400)
    goes_on_when_it_rests(chain, stamps, "states were not answered")


def test_so_does_one_of_a_slow_robot_that_may_have_held_its_command_meanwhile(ros):
    chain = NodeChain(ros, bounds_timeout=0.2, rate_hz=20.0)
    stamp = give_goal(chain)
    stamps = iter(range(stamp + 251, stamp + 2000))
    chain.answer(stamp + 250)  # five periods
    chain.await_mode("HOLD", "comes to rest: states were not answered")
    goes_on_when_it_rests(chain, stamps, "states were not answered")


def test_slow_robots_are_not_taken_for_missing_bounds(ros):
    """The time-out counts from the state, not from the last answer."""
    chain = NodeChain(ros, bounds_timeout=0.8)
    stamp = give_goal(chain)
    ros.wait_until(lambda: chain.reported("mode") == "TRACKING")
    changes = chain.reported("mode_changes")
    for k in range(1, 3):
        ros.run_for(0.85)  # longer than the time-out
        chain.state(stamp + k)
        ros.run_for(0.25)  # longer than the watchdog's period: it looks while limits are due
        chain.await_command(stamp + k, lambda k=k: chain.bound(stamp + k))
    ros.diagnostics.clear()
    ros.wait_until(lambda: chain.reported("mode"))
    assert chain.reported("mode") == "TRACKING"
    assert chain.reported("mode_changes") == changes


@pytest.mark.parametrize("bad", ["not finite", "wrong size", "missing joint"])
def test_states_that_are_refused_are_not_answered_so_that_the_robot_stops(ros, bad):
    chain = NodeChain(ros, bounds_timeout=0.1, state_timeout=1.2)
    stamp = give_goal(chain) + 5
    chain.answer(stamp)
    send = {
        "not finite": lambda: chain.state(stamp + 10, np.full(ARM.n, math.nan)),
        "wrong size": lambda: chain.state(stamp + 10, Q[:3]),
        "missing joint": lambda: chain.states.publish(
            joint_state(JOINTS[1:], (stamp + 10) * MS, Q[1:], V[1:])
        ),
    }[bad]
    ros.run_for(0.05)  # answers to repeats
    chain.commands.clear()
    chain.await_mode("STOPPED", f"joint states are refused: {bad}", each=send)
    ros.run_for(0.15, each=send)
    assert not chain.commands
    stamps = iter(range(stamp + 20, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))
    ros.wait_until(lambda: re.search(f"{bad}: [1-9]", chain.reported("states_refused")))


def test_stamps_that_stay_old_are_taken_for_a_restart(ros):
    chain = NodeChain(ros, bounds_timeout=0.1, state_timeout=1.2)
    stamp = give_goal(chain) + 1000
    chain.answer(stamp)
    earlier = iter(range(10, stamp))
    chain.await_mode(
        "STOPPED", "joint states are refused: old stamp", each=lambda: chain.both(next(earlier))
    )
    chain.await_mode("TRACKING", each=lambda: chain.both(next(earlier), v=REST))
    ros.wait_until(lambda: re.search("old stamp: [1-9]", chain.reported("states_refused")))


def test_what_was_learned_of_disturbances_is_forgotten_after_a_row_that_is_too_long(ros):
    """After a reset a wrist that had been driven wild was driven at 10 rad/s: found by fuzzing."""
    chain = NodeChain(ros, disturbance_time=0.02)
    stamp = give_goal(chain)
    observer = chain.node._controller.find(Disturbance)
    observer.estimate[:] = 5.0
    chain.answer(stamp + 5)
    assert observer.estimate.any()
    chain.answer(stamp + 105)
    assert not observer.estimate.any()


def test_silence_stops_it_and_a_new_state_wakes_it(ros):
    chain = NodeChain(ros, state_timeout=0.2, bounds_timeout=0.1)
    stamp = give_goal(chain)
    chain.await_mode("STOPPED", "no joint state")
    chain.commands.clear()
    ros.run_for(0.1)
    assert not chain.commands
    stamps = iter(range(stamp, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps)))


def test_a_silent_robot_that_repeats_its_state_is_answered_and_not_called_stopped(ros):
    chain = NodeChain(ros, state_timeout=0.2, bounds_timeout=0.1)
    chain.answer(10)
    chain.await_mode("STOPPED")
    chain.commands.clear()
    chain.await_command(10, lambda: chain.state(10))
    chain.await_mode("HOLD", "no goal", each=lambda: chain.state(10))


# Stamps


@pytest.mark.parametrize("order", ["limits first", "state first"])
def test_state_and_limits_are_matched_in_either_order(ros, order):
    chain = NodeChain(ros)
    chain.answer(10)
    # Limits that leave no choice show in the torque which of them were used.
    for stamp, a in ((20, 0.5), (30, -0.5), (40, 1.0)):
        only = np.full(ARM.n, a)
        parts = [lambda s=stamp, b=only: chain.bound(s, b, b), lambda s=stamp: chain.state(s)]
        first, second = parts if order == "limits first" else reversed(parts)
        before = chain.node._limits.stamp, chain.node._states.stamp
        ros.wait_until(
            lambda b=before: (chain.node._limits.stamp, chain.node._states.stamp) != b, each=first
        )
        assert stamp * MS not in chain.commands.stamps
        tau = chain.await_command(stamp, second)
        np.testing.assert_allclose(tau, torque_for(Q, only), atol=1e-3)


def test_old_limits_are_never_used_for_a_new_state(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    ros.run_for(0.1, each=lambda: chain.state(20))
    # Late repeats of the old ones, and ones for a state that has not come.
    ros.run_for(0.1, each=lambda: chain.bound(10))
    ros.run_for(0.1, each=lambda: chain.bound(30))
    assert set(chain.commands.stamps) == {10 * MS}
    chain.await_command(20, lambda: chain.bound(20))


def test_a_robot_that_starts_over_at_the_same_stamp_does_not_get_the_old_limits(ros):
    chain = NodeChain(ros, state_timeout=0.2, bounds_timeout=20.0)
    chain.answer(10)
    chain.await_mode("STOPPED")
    chain.commands.clear()
    moved = Q + 0.05
    ros.run_for(0.1, each=lambda: chain.state(10, moved))
    assert not chain.commands
    only = np.full(ARM.n, 0.5)
    tau = chain.await_command(10, lambda: (chain.state(10, moved), chain.bound(10, only, only)))
    np.testing.assert_allclose(tau, torque_for(moved, only), atol=1e-3)


def test_a_repeated_state_gets_the_same_command_again(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    chain.commands.clear()
    ros.wait_until(lambda: len(chain.commands) >= 3, "repeats", each=lambda: chain.state(10))
    first = chain.commands[0]
    assert all(command == first for command in chain.commands)
    assert stamp_to_ns(first.header.stamp) == 10 * MS
