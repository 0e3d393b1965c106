# SPDX-License-Identifier: Apache-2.0
"""Modes of the controller node, and how it matches states with limits."""

import math
import re

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

from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.supervisor import REST as HELD
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import joint_state

BOUNDS = AccelerationRange(LOWER, UPPER)

# Modes


def test_it_is_stopped_and_silent_without_a_state(ros):
    chain = NodeChain(ros)
    chain.await_mode("STOPPED", "no joint state yet")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.ERROR
    chain.poses.publish(pose_message(GOAL))
    ros.run_for(0.1, each=lambda: chain.bound(10))
    assert not chain.commands


def test_without_a_goal_it_brings_the_arm_to_rest(ros):
    chain = NodeChain(ros)
    held = expected().step(State(Q, V), BOUNDS, HELD).tau
    np.testing.assert_allclose(chain.answer(10), held, atol=SAME_TORQUE)
    chain.await_mode("HOLD", "no goal")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN


def test_with_a_pose_goal_it_tracks(ros):
    chain = NodeChain(ros)
    chain.poses.publish(pose_message(GOAL))
    chain.await_goals()
    tau = chain.answer(10)
    np.testing.assert_allclose(tau, expected(GOAL).step(State(Q, V), BOUNDS).tau, atol=SAME_TORQUE)
    assert np.abs(tau - expected().step(State(Q, V), BOUNDS, HELD).tau).max() > 0.1
    chain.await_mode("TRACKING", "goal")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.OK
    error = pin.log6(pose_at(Q).actInv(GOAL)).vector
    reported = [float(chain.reported(k)) for k in ("position_error_m", "orientation_error_rad")]
    lengths = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    assert reported == pytest.approx(lengths, rel=1e-6)


def test_poses_are_in_the_base_frame(ros):
    frame = "left_arm_mount"
    base = ARM.model.frames[ARM.model.getFrameId(frame)].placement
    assert not base.isIdentity(0.1)
    chain = NodeChain(ros, base_frame=frame)
    chain.poses.publish(pose_message(base.actInv(GOAL), frame))
    chain.await_goals()
    wanted = expected(GOAL).step(State(Q, V), BOUNDS).tau
    np.testing.assert_allclose(chain.answer(10), wanted, atol=SAME_TORQUE)


def test_with_a_posture_goal_it_tracks_whatever_the_order_of_names(ros):
    chain = NodeChain(ros)
    names = [*reversed(JOINTS), "other"]
    chain.postures.publish(joint_state(names, 0, [*reversed(GOAL_Q), math.nan]))
    chain.await_goals()
    wanted = expected(posture=GOAL_Q).step(State(Q, V), BOUNDS).tau
    np.testing.assert_allclose(chain.answer(10), wanted, atol=SAME_TORQUE)
    chain.await_mode("TRACKING")


class Motors:
    """Motors of an arm at rest that report the commanded torques, or others.

    Args:
        ros: harness.
        early: states that are answered before a goal is given.
        held: torques in these.
        changed: parameters.
    """

    def __init__(self, ros, early=0, held=None, **changed):
        self.ros, self.chain = ros, NodeChain(ros, **changed)
        self.stamp, self.tau = 0, np.zeros(ARM.n)
        self.answer(early, held)
        self.chain.postures.publish(joint_state(JOINTS, 0, GOAL_Q))
        self.chain.await_goals()

    def answer(self, count, effort=None):
        """Answer states; return by how much of the goal's torques the last command is."""
        for _ in range(count):
            self.stamp += 10
            given = self.tau if effort is None else effort
            command = self.chain.ask(self.stamp, Q, REST, LOWER, UPPER, given)
            self.tau = np.array(command.effort)
        rest = expected().step(State(Q, REST), BOUNDS, HELD).tau
        goal = expected(posture=GOAL_Q).step(State(Q, REST), BOUNDS).tau
        return np.abs(self.tau - rest).max() / np.abs(goal - rest).max()


@pytest.mark.parametrize(
    ("held", "early"),
    [([], 0), (np.full(ARM.n, 0.1), 100)],
    ids=["not known, at once", "on, after a second"],
)
def test_where_motors_hold_the_arm_before_it_starts_goals_fade_in(ros, held, early):
    motors = Motors(ros, early, held)
    shares = [motors.answer(1, held) for _ in range(10)]
    assert shares[0] < 0.05  # at first as if there was no goal
    assert 0.02 < shares[-1] < 0.1  # 90 of 500 ms
    assert (np.diff(shares) < 0.05).all()


def test_while_the_motors_give_other_torques_the_arm_is_slowed(ros, capfd):
    motors = Motors(ros)
    assert motors.answer(120) == pytest.approx(1.0)  # it knows now that they agree
    others = -motors.tau
    assert motors.answer(2, others) == pytest.approx(1.0)
    shares = [motors.answer(1, others) for _ in range(20)]
    assert (np.diff(shares) < 1e-3).all() and max(shares[5:]) < 0.1  # within 50 ms
    ros.wait_until(lambda: motors.chain.reported("commands_ignored") == "1", "the report")
    said = "the motors do not give the torques that were sent"
    assert said in ros.diagnostics[NODE]["message"]
    assert capfd.readouterr().err.count(f"{said}: the arm is slowed") == 1
    shares = [motors.answer(1) for _ in range(60)]
    assert shares[-1] == pytest.approx(1.0)
    assert (np.diff(shares) < 0.05).all()


def test_motors_are_not_compared_where_that_is_not_wanted(ros):
    motors = Motors(ros, effort_tolerance=0.0)
    motors.answer(60)
    assert motors.answer(20, np.full(ARM.n, 0.1)) == pytest.approx(1.0)
    ros.diagnostics.clear()
    ros.wait_until(lambda: motors.chain.reported("commands_ignored") == "0")


def goes_on_when_it_rests(chain, stamps, why):
    """Let the arm move on, which keeps it in HOLD, and then rest."""
    chain.await_mode("HOLD", f"comes to rest: {why}", each=lambda: chain.both(next(stamps)))
    chain.ros.run_for(0.2, each=lambda: chain.both(next(stamps)))
    assert chain.reported("mode") == "HOLD"
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))


def test_it_holds_while_bounds_are_missing_and_goes_on_by_itself(ros):
    chain = NodeChain(ros, bounds_timeout=0.1)
    stamp = give_goal(chain)
    command = chain.await_command(stamp + 10, lambda: chain.state(stamp + 10))
    chain.await_mode("HOLD", "acceleration limits are stale")
    assert float(chain.reported("goal_share")) == 0.0  # within margins it returns gently, too
    hold = expected(GOAL).step(State(Q, V), None, HELD)
    np.testing.assert_allclose(
        command.effort, hold.tau, atol=0.5
    )  # the node's last acceleration differs
    # The next ones are held at once.
    for k in range(20, 25):
        chain.await_command(stamp + k, lambda k=k: chain.state(stamp + k))
    assert chain.reported("mode") == "HOLD"
    stamps = iter(range(stamp + 30, stamp + 2000))
    goes_on_when_it_rests(chain, stamps, "acceleration limits are stale")


def test_limits_of_another_clock_are_told_when_their_state_has_waited(ros, capfd):
    chain = NodeChain(ros, bounds_timeout=0.1)

    def send():
        chain.bound(7000)
        chain.state(10)

    chain.await_command(10, send)
    told = "not the stamp of the joint state"
    ros.wait_until(lambda: f"{told}: 1;" in chain.reported("limits_refused"), told)
    line = f"acceleration_limits refused: {told}: header.stamp is 7 s instead of 0.01 s"
    assert line in capfd.readouterr().err


def test_a_controller_that_was_paused_in_motion_lets_the_arm_come_to_rest(ros):
    """It goes on by its goals only then; a shorter row slows the arm, and that is all."""
    chain = NodeChain(ros, bounds_timeout=0.7)
    stamp = give_goal(chain)
    chain.answer(stamp + 100)
    ros.wait_until(lambda: chain.reported("missed_rows_too_long") == "1")
    assert chain.reported("mode") == "TRACKING"
    stamps = iter(range(stamp + 1001, stamp + 3000))
    chain.answer(stamp + 1000)
    goes_on_when_it_rests(chain, stamps, "states were not answered")


@pytest.mark.parametrize("bad", ["not finite", "missing joint"])
def test_states_that_are_refused_are_not_answered_so_that_the_robot_stops(ros, bad):
    chain = NodeChain(ros, bounds_timeout=0.1, state_timeout=1.2)
    stamp = give_goal(chain) + 5
    chain.answer(stamp)
    send = {
        "not finite": lambda: chain.state(stamp + 10, np.full(ARM.n, math.nan)),
        "missing joint": lambda: chain.states.publish(
            joint_state(JOINTS[1:], (stamp + 10) * MS, Q[1:], V[1:])
        ),
    }[bad]
    chain.await_mode("STOPPED", f"joint states are refused: {bad}", each=send)
    ros.run_for(0.15, each=send)
    assert (stamp + 10) * MS not in chain.commands.stamps
    stamps = iter(range(stamp + 20, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))
    ros.wait_until(lambda: re.search(f"{bad}: [1-9]", chain.reported("states_refused")))


def test_states_that_freeze_in_motion_stop_the_arm_until_they_are_plausible_again(ros):
    chain = NodeChain(ros)
    stamps = iter(range(give_goal(chain) + 10, 100_000, 10))
    chain.await_mode("STOPPED", each=lambda: chain.both(next(stamps), v=0.5 * ARM.v_max))
    assert chain.reported("reason") == "joint states are refused: impossible"
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))


def test_an_estimate_without_a_solution_is_held_and_forgotten(ros):
    chain = NodeChain(ros, use_estimated_states=True)  # estimates are not checked once more
    stamp = give_goal(chain)
    tau = chain.answer(stamp + 10, v=np.full(ARM.n, 1e200))
    assert np.isfinite(tau).all()
    assert (np.abs(tau) <= ARM.tau_max).all()
    chain.await_mode("HOLD", "solver failed")
    assert chain.reported("qp_failures") == "1"
    stamps = iter(range(stamp + 20, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))


@pytest.mark.parametrize("bounds_timeout", [0.1, 20.0], ids=["short", "long"])
def test_silence_stops_it_and_a_state_wakes_it(ros, bounds_timeout):
    chain = NodeChain(ros, state_timeout=0.2, bounds_timeout=bounds_timeout)
    stamp = give_goal(chain)
    chain.await_mode("STOPPED", "no joint state")
    # The one that it knows already, from a robot that waits, and new ones.
    chain.commands.clear()
    chain.await_command(stamp - 1, lambda: chain.state(stamp - 1))
    stamps = iter(range(stamp, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps)))


# Stamps


def test_old_limits_are_never_used_for_a_new_state(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    ros.run_for(0.1, each=lambda: chain.state(20))
    # Late repeats of the old ones, and ones for a state that has not come.
    ros.run_for(0.1, each=lambda: chain.bound(10))
    ros.run_for(0.1, each=lambda: chain.bound(30))
    assert set(chain.commands.stamps) == {10 * MS}
    only = np.full(ARM.n, 0.5)  # which leaves no choice
    command = chain.await_command(20, lambda: chain.bound(20, only, only))
    np.testing.assert_allclose(command.effort, torque_for(Q, only), atol=1e-3)


def test_a_repeated_state_gets_the_same_command_again(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    chain.commands.clear()
    ros.wait_until(lambda: len(chain.commands) >= 3, "repeats", each=lambda: chain.state(10))
    first = chain.commands[0]
    assert all(command == first for command in chain.commands)
    assert stamp_to_ns(first.header.stamp) == 10 * MS
