# SPDX-License-Identifier: Apache-2.0
import math
import re
import time
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from controller_chain import MS, NODE, ControllerChain
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from ros_harness import ROOT, acceleration_limits, joint_state, names_parameter, read_config
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.controller import Controller, Gains
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.tasks.gains import critical_damping
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import read_urdf
from viability_bounds_pkg.ros.runtime import GOAL_QOS, LATCHED_QOS, set_stamp, stamp_to_ns
from viability_bounds_pkg.state import State

ARM = load_arm("baxter_left_arm")
# Watchdogs that do not bark while a busy machine runs the other tests.
VALUES = read_config("baxter_left_arm", NODE) | {"bounds_timeout": 20.0, "state_timeout": 40.0}
JOINTS = VALUES["joints"]
GAINS = Gains(
    pose_kp=VALUES["pose_kp"],
    pose_kd=critical_damping(VALUES["pose_kp"]),
    pose_weight=VALUES["pose_weight"],
    posture_kp=VALUES["posture_kp"],
    posture_kd=critical_damping(VALUES["posture_kp"]),
    posture_weight=VALUES["posture_weight"],
    posture_in_null_space=True,
    hold_kd=VALUES["hold_kd"],
)
Q = ARM.q_start
REST = np.zeros(ARM.n)
V = 0.02 * ARM.v_max
LOWER, UPPER = np.full(ARM.n, -2.0), np.full(ARM.n, 2.0)
GOAL_Q = Q + 0.1
SAME_TORQUE = 1e-6  # N m; two runs of the solver


def expected(pose=None, posture=None, gains=GAINS) -> Controller:
    """The node's core, set up by hand."""
    controller = Controller(ARM.robot(), ARM.tau_max, gains)
    controller.reset(Q)
    if pose is not None:
        controller.set_pose_goal(pose)
    if posture is not None:
        controller.set_posture_goal(posture)
    return controller


def pose_at(q) -> pin.SE3:
    robot = ARM.robot(0.0)
    robot.update(State(q, REST), REST)
    return robot.pose.copy()


GOAL = pose_at(GOAL_Q)


def pose_message(pose: pin.SE3, frame="base", stamp=0) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, pose.translation)
    o.x, o.y, o.z, o.w = map(float, pin.Quaternion(pose.rotation).coeffs())
    return message


class NodeChain(ControllerChain):
    """The other side of the controller: robot, bounds node and user."""

    def __init__(self, ros, **changed) -> None:
        super().__init__(ros, VALUES | changed)
        self.poses = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
        self.postures = ros.talk(JointState, "target_posture", GOAL_QOS)

    def state(self, stamp, q=Q, v=V) -> None:
        self.send_state(stamp, q, v)

    def bound(self, stamp, lower=LOWER, upper=UPPER) -> None:
        self.send_limits(stamp, lower, upper)

    def both(self, stamp, q=Q, v=V, lower=LOWER, upper=UPPER) -> None:
        self.bound(stamp, lower, upper)
        self.state(stamp, q, v)

    def await_command(self, stamp, each=None) -> np.ndarray:
        """Wait for the command with a stamp, ms; return its torques."""
        command = super().await_command(stamp, each)
        assert command.name == JOINTS
        return np.array(command.effort)

    def answer(self, stamp, q=Q, v=V, lower=LOWER, upper=UPPER) -> np.ndarray:
        """Send a state and its limits until the command comes; return its torques."""
        return self.await_command(stamp, lambda: self.both(stamp, q, v, lower, upper))

    def await_mode(self, mode, reason="", each=None) -> None:
        self.ros.wait_until(
            lambda: self.reported("mode") == mode and reason in self.reported("reason"),
            f"mode {mode} {reason}",
            each=each,
        )


def give_goal(chain, message=None, first=1) -> int:
    """Send a pose goal, step until it is tracked; return the next free stamp, ms."""
    chain.poses.publish(pose_message(GOAL) if message is None else message)
    stamps = iter(range(first, first + 1000))
    current = first

    def step():
        nonlocal current
        current = next(stamps)
        chain.both(current)

    chain.await_mode("TRACKING", each=step)
    return current + 1


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
        tau, expected().brake(State(Q, V), AccelerationRange(LOWER, UPPER)).tau, atol=SAME_TORQUE
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
        np.abs(tau - expected().brake(State(Q, V), AccelerationRange(LOWER, UPPER)).tau).max()
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


def test_it_holds_while_bounds_are_missing_and_goes_on_by_itself(ros):
    chain = NodeChain(ros, bounds_timeout=0.1)
    stamp = give_goal(chain)
    begin = time.monotonic()
    # A state whose limits do not come is held, but not before the time-out.
    tau = chain.await_command(stamp + 10, lambda: chain.state(stamp + 10))
    assert time.monotonic() - begin >= 0.1
    chain.await_mode("HOLD", "acceleration limits are stale")
    hold = expected(GOAL).hold(State(Q, V))
    np.testing.assert_allclose(tau, hold.tau, atol=0.5)  # the node's last acceleration differs
    # The next ones are held at once.
    begin = time.monotonic()
    for k in range(20, 25):
        chain.await_command(stamp + k, lambda k=k: chain.state(stamp + k))
    assert chain.reported("mode") == "HOLD"
    stamps = iter(range(stamp + 30, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps)))


def test_slow_robots_are_not_taken_for_missing_bounds(ros):
    """The time-out counts from the state, not from the last answer."""
    chain = NodeChain(ros, bounds_timeout=0.4)
    stamp = give_goal(chain)
    ros.wait_until(lambda: chain.reported("mode") == "TRACKING")
    changes = chain.reported("mode_changes")
    for k in range(1, 4):
        ros.run_for(0.45)  # longer than the time-out
        chain.state(stamp + k)
        ros.run_for(0.15)  # longer than the watchdog's period: it looks while limits are due
        chain.await_command(stamp + k, lambda k=k: chain.bound(stamp + k))
    ros.diagnostics.clear()
    ros.wait_until(lambda: chain.reported("mode"))
    assert chain.reported("mode") == "TRACKING"
    assert chain.reported("mode_changes") == changes


@pytest.mark.parametrize("bad", ["not finite", "wrong size", "missing joint"])
def test_states_that_are_refused_lead_to_hold_then_stopped(ros, bad):
    chain = NodeChain(ros, bounds_timeout=0.1, state_timeout=0.6)
    stamp = give_goal(chain) + 5
    chain.answer(stamp)
    send = {
        "not finite": lambda: chain.state(stamp + 10, np.full(ARM.n, math.nan)),
        "wrong size": lambda: chain.state(stamp + 10, Q[:3]),
        "missing joint": lambda: chain.states.publish(
            joint_state(JOINTS[1:], (stamp + 10) * MS, Q[1:], V[1:])
        ),
    }[bad]
    chain.commands.clear()
    chain.await_mode("HOLD", f"joint states are refused: {bad}", each=send)
    # Gravity is carried; damping a velocity that is not known any more would push.
    tau = chain.await_command(stamp + 10, send)
    np.testing.assert_allclose(
        tau, pin.computeGeneralizedGravity(ARM.model, ARM.model.createData(), Q), atol=0.5
    )
    chain.await_mode("STOPPED", f"joint states are refused: {bad}", each=send)
    chain.commands.clear()
    ros.run_for(0.15, each=send)
    assert not chain.commands
    stamps = iter(range(stamp + 20, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps)))
    ros.wait_until(lambda: re.search(f"{bad}: [1-9]", chain.reported("states_refused")))


def test_stamps_that_stay_old_are_held_then_taken_for_a_restart(ros):
    chain = NodeChain(ros, bounds_timeout=0.1, state_timeout=0.6)
    stamp = give_goal(chain) + 1000
    chain.answer(stamp)
    earlier = iter(range(10, stamp))
    chain.await_mode(
        "HOLD", "joint states are refused: old stamp", each=lambda: chain.both(next(earlier))
    )
    chain.await_mode("TRACKING", each=lambda: chain.both(next(earlier)))
    ros.wait_until(lambda: re.search("old stamp: [1-9]", chain.reported("states_refused")))


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


def torque_for(q, a):
    """Return the torque for accelerations `a` at velocity V."""
    robot = ARM.robot()
    robot.update(State(q, V), a)
    return robot.torque(a)


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


# Limits that cannot be used


def crossed():
    lower = LOWER.copy()
    lower[3] = 3.0
    return acceleration_limits(JOINTS, 20 * MS, lower, UPPER)


def not_finite(value):
    upper = UPPER.copy()
    upper[2] = value
    return acceleration_limits(JOINTS, 20 * MS, LOWER, upper)


def one_point():
    message = acceleration_limits(JOINTS, 20 * MS, LOWER, UPPER)
    return JointTrajectory(
        header=message.header, joint_names=message.joint_names, points=message.points[:1]
    )


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (crossed(), "lower above upper"),
        (not_finite(math.nan), "not finite"),
        (not_finite(math.inf), "not finite"),
        (acceleration_limits(JOINTS, 20 * MS, LOWER[:3], UPPER[:3]), "wrong size"),
        (acceleration_limits(JOINTS, 20 * MS, LOWER, UPPER[:3]), "wrong size"),
        (acceleration_limits(JOINTS[1:], 20 * MS, LOWER[1:], UPPER[1:]), "missing joint"),
        (acceleration_limits([], 20 * MS, [], []), "missing joint"),
        (one_point(), "wrong number of points"),
    ],
)
def test_limits_that_cannot_be_used_are_refused_and_counted(ros, message, reason):
    chain = NodeChain(ros)
    chain.answer(10)
    ros.run_for(0.05, each=lambda: chain.state(20))
    ros.wait_until(
        lambda: re.search(f"{reason}: [1-9]", chain.reported("limits_refused")),
        f"a refusal: {reason}",
        each=lambda: chain.limits.publish(message),
    )
    assert set(chain.commands.stamps) == {10 * MS}
    chain.await_command(20, lambda: chain.bound(20))


def test_limits_in_any_order_and_of_others_too(ros):
    chain = NodeChain(ros)
    only = np.linspace(-0.6, 0.6, ARM.n)
    names = [*reversed(JOINTS), "other"]
    values = [*reversed(only), math.nan]
    tau = chain.await_command(
        10,
        lambda: (
            chain.limits.publish(acceleration_limits(names, 10 * MS, values, values)),
            chain.state(10),
        ),
    )
    np.testing.assert_allclose(tau, torque_for(Q, only), atol=1e-3)


# Goals


def changed_pose(frame="base", **fields) -> PoseStamped:
    message = pose_message(GOAL, frame)
    for name, value in fields.items():
        part = message.pose.position if name.startswith("p") else message.pose.orientation
        setattr(part, name[1], value)
    return message


@pytest.mark.parametrize(
    "message",
    [
        changed_pose("elsewhere"),
        changed_pose(px=math.nan),
        changed_pose(pz=math.inf),
        changed_pose(ow=math.nan),
        changed_pose(ox=0.0, oy=0.0, oz=0.0, ow=0.0),
        changed_pose(ox=0.0, oy=0.0, oz=0.0, ow=1.01),
    ],
)
def test_poses_that_cannot_be_followed_are_refused_and_counted(ros, message):
    chain = NodeChain(ros)
    chain.answer(10)
    chain.poses.publish(message)
    ros.wait_until(lambda: chain.reported("goals_refused") == "target_pose: 1;", "the refusal")
    chain.answer(20)
    assert chain.reported("goals_pending") == "0"
    assert chain.reported("mode") == "HOLD"


@pytest.mark.parametrize(
    "message",
    [
        joint_state(JOINTS[1:], 0, Q[1:]),
        joint_state(JOINTS, 0, Q[1:]),
        joint_state([], 0, []),
        joint_state(JOINTS, 0, [math.nan, *Q[1:]]),
        joint_state(JOINTS, 0, [math.inf, *Q[1:]]),
        joint_state(JOINTS, 0, [*Q[:6], ARM.q_max[6] + 0.01]),
        joint_state(JOINTS, 0, [ARM.q_min[0] - 0.01, *Q[1:]]),
    ],
)
def test_postures_that_cannot_be_followed_are_refused_and_counted(ros, message):
    chain = NodeChain(ros)
    chain.answer(10)
    chain.postures.publish(message)
    ros.wait_until(lambda: chain.reported("goals_refused") == "target_posture: 1;", "the refusal")
    chain.answer(20)
    assert chain.reported("mode") == "HOLD"


def test_a_continuous_joint_is_not_sent_to_infinity(ros):
    limits = {
        "position_min": [*ARM.q_min[:6], -math.inf],
        "position_max": [*ARM.q_max[:6], math.inf],
    }
    chain = NodeChain(ros, **limits)
    chain.answer(10)
    chain.postures.publish(joint_state(JOINTS, 0, [*Q[:6], math.inf]))
    ros.wait_until(lambda: chain.reported("goals_refused") == "target_posture: 1;", "the refusal")
    chain.postures.publish(joint_state(JOINTS, 0, [*Q[:6], 100.0]))
    ros.wait_until(lambda: chain.reported("goals_pending") == "1", "the goal")


def test_goals_take_effect_at_their_stamps(ros):
    chain = NodeChain(ros)
    other = pose_at(Q - 0.1)
    chain.poses.publish(pose_message(other, stamp=70 * MS))
    chain.poses.publish(pose_message(GOAL, stamp=50 * MS))
    ros.wait_until(lambda: chain.reported("goals_pending") == "2", "the goals")
    core = expected()
    for stamp in range(10, 100, 10):
        if stamp == 50:
            core.set_pose_goal(GOAL)
        elif stamp == 70:
            core.set_pose_goal(other)
        tau = chain.answer(stamp)
        np.testing.assert_allclose(
            tau,
            core.step(State(Q, V), AccelerationRange(LOWER, UPPER)).tau,
            atol=1e-4,
            err_msg=f"at {stamp} ms",
        )
    ros.wait_until(lambda: chain.reported("goals_pending") == "0")
    assert chain.reported("mode") == "TRACKING"


def test_a_goal_that_is_not_renewed_is_given_up(ros):
    chain = NodeChain(ros, goal_timeout=0.2)
    stamp = give_goal(chain)
    stamps = iter(range(stamp, stamp + 5000))
    chain.await_mode("HOLD", "goal lost", each=lambda: chain.both(next(stamps)))
    chain.poses.publish(pose_message(GOAL))
    chain.await_mode("TRACKING", "goal", each=lambda: chain.both(next(stamps)))


# Output


def test_efforts_are_published_for_ros2_control_too(ros):
    topic = "/effort_controller/commands"
    chain = NodeChain(ros, ros2_control_topic=topic)
    efforts = ros.listen(Float64MultiArray, topic)
    ros.hears(topic)
    tau = chain.answer(10)
    ros.wait_until(lambda: efforts, "efforts", each=lambda: chain.state(10))
    np.testing.assert_array_equal(efforts[0].data, tau)


def test_torques_keep_their_limits_also_when_bounds_ask_for_more(ros):
    chain = NodeChain(ros)
    much = np.full(ARM.n, 500.0)
    tau = chain.answer(10, lower=much, upper=much + 1.0)
    assert (np.abs(tau) <= ARM.tau_max).all()
    ros.wait_until(lambda: chain.reported("bounds_relaxed_steps") == "1")
    relaxation = np.array(chain.reported("bounds_last_relaxation_rad_s2").split(), float)
    assert relaxation.max() > 100.0
    chain.answer(20)
    ros.wait_until(lambda: chain.reported("steps") == "2")
    assert chain.reported("bounds_relaxed_steps") == "1"


def test_a_state_beyond_sense_is_held_and_forgotten(ros):
    chain = NodeChain(ros)
    stamp = give_goal(chain)
    tau = chain.answer(stamp + 10, v=np.full(ARM.n, 1e200))
    assert np.isfinite(tau).all()
    assert (np.abs(tau) <= ARM.tau_max).all()
    chain.await_mode("HOLD", "solver failed")
    assert chain.reported("qp_failures") == "1"
    stamps = iter(range(stamp + 20, stamp + 2000))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps)))


def test_the_rate_of_torque_is_limited(ros):
    rate = np.full(ARM.n, 100.0)
    chain = NodeChain(ros, torque_rate_max=rate.tolist())
    tau = [
        chain.answer(10 * k, q=Q + 0.05 * k, lower=a, upper=a)
        for k, a in ((1, -UPPER), (2, UPPER), (3, -UPPER))
    ]
    change = np.abs(np.diff(tau, axis=0))
    assert (change <= rate * ARM.dt + 1e-9).all()
    assert (change > 0.99 * rate * ARM.dt).any()


def test_joints_at_a_limit_are_named(ros):
    chain = NodeChain(ros)
    lower, upper = LOWER.copy(), UPPER.copy()
    lower[3] = upper[3] = 0.7
    chain.answer(10, v=REST, lower=lower, upper=upper)
    ros.wait_until(lambda: chain.reported("joints_at_acceleration_limit") == JOINTS[3])


# Parameters


@pytest.mark.parametrize(
    ("changed", "gains"),
    [
        ({"pose_kp": 40.0}, {"pose_kp": 40.0, "pose_kd": critical_damping(40.0)}),
        ({"pose_kd": 1.5}, {"pose_kd": 1.5}),
        ({"pose_weight": 1e-3}, {"pose_weight": 1e-3}),
        ({"posture_kp": 40.0}, {"posture_kp": 40.0, "posture_kd": critical_damping(40.0)}),
        ({"posture_kd": 1.0}, {"posture_kd": 1.0}),
        ({"posture_weight": 1.0}, {"posture_weight": 1.0}),
        ({"posture_in_null_space": False}, {"posture_in_null_space": False}),
    ],
)
def test_gains_change_while_it_runs(ros, changed, gains):
    chain = NodeChain(ros)
    away = Q + 0.3
    chain.poses.publish(pose_message(GOAL))
    chain.postures.publish(joint_state(JOINTS, 0, away))
    ros.wait_until(lambda: chain.reported("goals_pending") == "2", "the goals")
    core = expected(GOAL, away)
    wide = np.full(ARM.n, 50.0)
    before = chain.answer(10, lower=-wide, upper=wide)
    np.testing.assert_allclose(
        before, core.step(State(Q, V), AccelerationRange(-wide, wide)).tau, atol=1e-4
    )
    ros.accepts(NODE, **changed)
    core.gains = replace(core.gains, **gains)
    after = chain.answer(20, lower=-wide, upper=wide)
    np.testing.assert_allclose(
        after, core.step(State(Q, V), AccelerationRange(-wide, wide)).tau, atol=1e-4
    )
    assert np.abs(after - before).max() > 1e-3


def test_the_damping_in_hold_changes_while_it_runs(ros):
    chain = NodeChain(ros)
    slow = 0.1 * V
    before = chain.answer(10, v=slow)
    ros.accepts(NODE, hold_kd=5.0)
    after = chain.answer(20, v=slow)
    assert np.abs(after - before).max() > 1e-3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pose_kp", -1.0),
        ("pose_kp", math.nan),
        ("pose_kd", -2.0),
        ("pose_kd", math.inf),
        ("pose_weight", -1e-3),
        ("posture_kp", "stiff"),
        ("posture_kd", -0.5),
        ("posture_weight", 0.0),
        ("posture_in_null_space", 1),
        ("hold_kd", -20.0),
    ],
)
def test_bad_gains_are_refused_and_the_old_ones_stay(ros, name, value):
    chain = NodeChain(ros)
    before = chain.answer(10)
    reason = ros.refuses(NODE, **{name: value})
    assert names_parameter(reason, name)
    assert chain.node.get_parameter(name).value == VALUES.get(name, True)
    np.testing.assert_allclose(chain.answer(20), before, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("joints", JOINTS[::-1]),
        ("torque_max", [1e3] * 7),
        ("rate_hz", 1000.0),
        ("base_frame", "torso"),
        ("end_effector_frame", "left_hand"),
        ("robot_description", "other.urdf"),
        ("bounds_timeout", 1.0),
        ("ros2_control_topic", "x"),
    ],
)
def test_geometry_limits_and_rates_are_read_only(ros, name, value):
    NodeChain(ros)
    assert "read-only" in ros.refuses(NODE, **{name: value})


BROKEN_URDF = str(ROOT / "pyproject.toml")


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"joints": [*JOINTS[:6], "left_w9"]}, "joints", "unknown joint 'left_w9'"),
        ({"joints": JOINTS[::-1]}, "joints", "from base to tip"),
        ({"joints": [*JOINTS[:6], JOINTS[0]]}, "joints", "each once"),
        ({"joints": None}, "joints", "not set"),
        ({"locked_joints": ["x"], "locked_positions": [0.1]}, "locked_joints", "'x'"),
        ({"locked_joints": ["right_s0"]}, "locked_positions", "1 numbers"),
        ({"base_frame": "nowhere"}, "base_frame", "'nowhere'"),
        ({"base_frame": "left_gripper"}, "base_frame", "not a moving one"),
        ({"end_effector_frame": "nowhere"}, "end_effector_frame", "unknown frame 'nowhere'"),
        ({"robot_description": "/no/such.urdf"}, "robot_description", "no such file"),
        (
            {"robot_description": "package://nowhere/robot.urdf"},
            "robot_description",
            "no package 'nowhere'",
        ),
        ({"robot_description": BROKEN_URDF}, "robot_description", "not well-formed XML"),
        ({"robot_description": None}, "robot_description", "not set"),
        ({"torque_max": [-50.0, *ARM.tau_max[1:]]}, "torque_max", "-50"),
        ({"torque_max": [0.0, *ARM.tau_max[1:]]}, "torque_max", "> 0"),
        ({"torque_max": [math.inf, *ARM.tau_max[1:]]}, "torque_max", "inf"),
        ({"torque_max": [math.nan, *ARM.tau_max[1:]]}, "torque_max", "nan"),
        ({"torque_max": [50.0]}, "torque_max", "7 numbers"),
        ({"torque_max": None}, "torque_max", "not set"),
        ({"torque_rate_max": [100.0]}, "torque_rate_max", "7 numbers"),
        ({"torque_rate_max": [0.0] * 7}, "torque_rate_max", "> 0"),
        ({"position_min": list(ARM.q_max)}, "position_max", "above position_min"),
        ({"position_max": [1.0]}, "position_max", "7 numbers"),
        ({"rate_hz": 0.0}, "rate_hz", "> 0"),
        ({"rate_hz": math.nan}, "rate_hz", "nan"),
        ({"pose_kp": -10.0}, "pose_kp", "-10"),
        ({"pose_kd": -3.0}, "pose_kd", "-3"),
        ({"posture_weight": 0.0}, "posture_weight", "> 0"),
        ({"bounds_timeout": 0.0}, "bounds_timeout", "> 0"),
        ({"state_timeout": -1.0}, "state_timeout", "-1"),
        ({"goal_timeout": -1.0}, "goal_timeout", ">= 0"),
    ],
)
def test_it_does_not_start_with_bad_parameters(ros, changed, name, shown):
    with pytest.raises(SettingError) as refusal:
        ros.start(ControllerNode, VALUES | changed)
    text = str(refusal.value)
    assert refusal.value.name == name
    assert re.fullmatch(rf"parameter '{name}' is (.+); allowed: (.+)", text), text
    assert shown in text


def test_a_urdf_that_does_not_load_is_named(ros, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text('<robot name="r"><link name="a"/><joint name="j" type="revolute"/></robot>')
    with pytest.raises(SettingError) as refusal:
        ros.start(ControllerNode, VALUES | {"robot_description": str(path)})
    assert refusal.value.name == "robot_description"


# The robot's description


def test_the_description_may_come_from_its_topic(ros):
    publisher = ros.probe.create_publisher(String, "robot_description", LATCHED_QOS)
    publisher.publish(String(data=read_urdf(read_config("panda", "x")["robot_description"])))
    node = ros.start(
        ControllerNode, read_config("panda", "controller_node") | {"robot_description": "topic"}
    )
    assert node._controller.robot.n == ARM.n


def test_a_description_that_is_none_stops_it(ros):
    publisher = ros.probe.create_publisher(String, "robot_description", LATCHED_QOS)
    publisher.publish(String(data="no robot"))
    with pytest.raises(SettingError, match="'robot_description' is 'topic'.*not well-formed"):
        ros.start(
            ControllerNode,
            read_config("panda", "controller_node") | {"robot_description": "topic"},
        )
