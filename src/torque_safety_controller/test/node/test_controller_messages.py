# SPDX-License-Identifier: Apache-2.0
"""Messages of the controller node: states, limits, goals, torques, and what tools are shown."""

import math
import time

import numpy as np
import pytest
from controller_chain import MS
from geometry_msgs.msg import PoseStamped, TwistStamped
from node_chain import (
    ARM,
    GOAL,
    GOAL_Q,
    JOINTS,
    LOWER,
    REST,
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
from rclpy.node import Node
from rclpy.qos import qos_profile_system_default
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from torque_safety_controller.node import waiting_goals
from torque_safety_controller.node.goal_messages import pose_from_message
from torque_safety_controller.node.periodic import StateStream
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.ros import refusals
from viability_bounds_pkg.ros.messages import Arrival
from viability_bounds_pkg.ros.runtime import GOAL_QOS, LATCHED_QOS, STATUS_QOS
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state

# Joint states

STATE = [0.1, 0.2]
MOVED = [0.1, 0.3]


def arrives(stream, stamp, now, q=STATE):
    """Let a state with a stamp, ms, arrive at a time, s."""
    return stream.read(joint_state(("a", "b"), stamp * MS, q, [0.0, 0.0]), now)


@pytest.mark.parametrize(
    ("stamp", "q", "now", "arrival"),
    [
        (102, STATE, 10.01, Arrival.NEW),
        (100, STATE, 10.01, Arrival.REPEATED),
        (100, STATE, 10.6, Arrival.RESUMED),
        (100, MOVED, 10.6, Arrival.RESTARTED),  # another robot at the same time
        (100, MOVED, 10.01, Arrival.REFUSED),
        (102, STATE, 10.6, Arrival.NEW),  # its time stood still, as of a halted simulation
        (700, STATE, 10.6, Arrival.RESTARTED),
        (50, STATE, 10.01, Arrival.REFUSED),
        (50, STATE, 10.6, Arrival.RESTARTED),
        (1200, STATE, 10.01, Arrival.NEW),  # the time alone has leapt
        (1200, MOVED, 10.01, Arrival.RESTARTED),
        (102, [math.nan, 0.2], 10.01, Arrival.REFUSED),
    ],
)
def test_what_a_state_is_after_one_that_was_answered(stamp, q, now, arrival):
    stream = StateStream(("a", "b"), timeout=0.5)
    assert arrives(stream, 100, 10.0) is Arrival.RESTARTED
    stream.mark_answered()
    assert arrives(stream, stamp, now, q) is arrival
    accepted = arrival in (Arrival.NEW, Arrival.RESTARTED)
    np.testing.assert_array_equal(stream.q, q if accepted else STATE)


def test_a_gripper_on_the_same_topic_is_no_rival_but_a_second_robot_is(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    gripper, rival = (ros.add(Node(name, context=ros.context)) for name in ("gripper", "rival"))
    fingers_of = gripper.create_publisher(JointState, "joint_states", 1)
    ros.wait_until(lambda: "publishers of '/joint_states'" in chain.reported("message"), "a rival")
    fingers = joint_state(["finger"], 10 * MS, [0.02], [0.0], [0.0])
    ros.wait_until(
        lambda: "publishers of" not in chain.reported("message"),
        "no rival",
        each=lambda: fingers_of.publish(fingers),
    )
    chain.answer(20)
    assert chain.reported("states_refused") == "none"
    rival.create_publisher(JointState, "joint_states", 1)
    ros.wait_until(lambda: "3 publishers of" in chain.reported("message"), "the rival")
    chain.both(30)
    fingers_of.publish(fingers)
    ros.run_for(0.1)
    assert 30 * MS not in chain.commands.stamps


# Limits


def limits(lower=LOWER, upper=UPPER, joints=JOINTS):
    return acceleration_limits(joints, 20 * MS, lower, upper)


def changed(values, joint, value):
    made = values.copy()
    made[joint] = value
    return made


def test_limits_that_cannot_be_used_are_refused_and_counted(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    ros.run_for(0.05, each=lambda: chain.state(20))
    one_point = limits()
    one_point.points = one_point.points[:1]
    for message, reason in (
        (limits(lower=changed(LOWER, 3, 3.0)), "lower above upper"),
        (limits(upper=changed(UPPER, 2, math.nan)), "not finite"),
        (limits(upper=UPPER[:3]), "wrong size"),
        (limits(LOWER[1:], UPPER[1:], JOINTS[1:]), "missing joint"),
        (one_point, "wrong number of points"),
    ):
        ros.wait_until(
            lambda text=reason: f"{text}: " in chain.reported("limits_refused"),
            f"a refusal: {reason}",
            each=lambda it=message: chain.limits.publish(it),
        )
    assert set(chain.commands.stamps) == {10 * MS}
    chain.await_command(20, lambda: chain.bound(20))


def test_limits_in_any_order_and_of_others_too(ros):
    chain = NodeChain(ros)
    only = np.linspace(-0.6, 0.6, ARM.n)
    values = [*reversed(only), math.nan]
    message = acceleration_limits([*reversed(JOINTS), "other"], 10 * MS, values, values)
    command = chain.await_command(10, lambda: (chain.limits.publish(message), chain.state(10)))
    assert command.name == JOINTS
    np.testing.assert_allclose(command.effort, torque_for(Q, only), atol=1e-3)


# Goals


def pose_with(frame="base", **fields) -> PoseStamped:
    message = pose_message(GOAL, frame)
    for name, value in fields.items():
        part = message.pose.position if name.startswith("p") else message.pose.orientation
        setattr(part, name[1], value)
    return message


def test_goals_that_cannot_be_followed_are_refused_and_counted(ros):
    chain = NodeChain(ros)
    chain.answer(10)
    poses = [
        pose_with("elsewhere"),
        pose_with(px=math.nan),
        pose_with(ow=math.nan),
        pose_with(ox=0.0, oy=0.0, oz=0.0, ow=0.0),
        pose_with(ox=0.0, oy=0.0, oz=0.0, ow=1.01),
    ]
    postures = [
        joint_state(JOINTS[1:], 0, Q[1:]),
        joint_state(JOINTS, 0, Q[1:]),
        joint_state(JOINTS, 0, [math.inf, *Q[1:]]),
        joint_state(JOINTS, 0, [*Q[:6], ARM.q_max[6] + 0.01]),
        joint_state([*JOINTS, JOINTS[0]], 0, [*Q, 0.0]),
    ]
    for topic, publisher, messages in (
        ("target_pose", chain.poses, poses),
        ("target_posture", chain.postures, postures),
    ):
        for k, message in enumerate(messages, 1):
            publisher.publish(message)
            told = f"{topic}: {k};"
            ros.wait_until(lambda told=told: told in chain.reported("goals_refused"), told)
    chain.answer(20)
    assert (chain.reported("goals_pending"), chain.reported("mode")) == ("0", "HOLD")


def test_a_continuous_joint_is_not_sent_to_infinity(ros):
    limits = {"position_min": [*ARM.q_min[:6], -math.inf]}
    chain = NodeChain(ros, **limits, position_max=[*ARM.q_max[:6], math.inf])
    for last, key, value in (
        (math.inf, "goals_refused", "1;"),
        (1e7, "goals_refused", "2;"),
        (100.0, "goals_pending", "1"),
    ):
        chain.postures.publish(joint_state(JOINTS, 0, [*Q[:6], last]))
        ros.wait_until(lambda k=key, v=value: v in chain.reported(k), key)


def test_a_continuous_joint_takes_the_nearest_turn_to_a_posture(ros):
    limits = {"position_min": [*ARM.q_min[:6], -math.inf]}
    chain = NodeChain(ros, **limits, position_max=[*ARM.q_max[:6], math.inf])
    core = expected(posture=GOAL_Q)
    chain.postures.publish(joint_state(JOINTS, 0, [*GOAL_Q[:6], GOAL_Q[6] - 2.0 * math.pi]))
    chain.await_goals()
    wanted = core.step(State(Q, V), AccelerationRange(LOWER, UPPER)).tau
    np.testing.assert_allclose(chain.answer(10), wanted, atol=1e-4)  # N m


def test_goals_take_effect_at_their_stamps(ros):
    chain = NodeChain(ros)
    other = pose_at(Q - 0.1)
    chain.poses.publish(pose_message(other, stamp=40 * MS))
    chain.poses.publish(pose_message(GOAL, stamp=20 * MS))
    chain.await_goals(2)
    core = expected()
    for stamp, goal in ((10, None), (20, GOAL), (30, None), (40, other), (50, None)):
        if goal is not None:
            core.goals.set_pose(goal)
        wanted = core.step(State(Q, V), AccelerationRange(LOWER, UPPER)).tau
        np.testing.assert_allclose(chain.answer(stamp), wanted, atol=1e-4, err_msg=f"{stamp} ms")
    chain.await_goals(0)


def test_a_goal_at_rest_ends_the_velocity_of_what_moved_before(ros):
    """Else the arm would stand off by it for ever."""
    chain = NodeChain(ros)
    targets = chain.node._controller.goals
    trajectory = JointTrajectory(joint_names=JOINTS)
    trajectory.points = [JointTrajectoryPoint(positions=GOAL_Q.tolist())]
    trajectory.points[0].time_from_start.sec = 1
    jog = TwistStamped()
    jog.twist.linear.x = 0.1
    for stamp, publisher, message, moves in (
        (10, ros.talk(JointTrajectory, "target_joint_trajectory", GOAL_QOS), trajectory, "v"),
        (20, chain.poses, pose_message(GOAL), ""),
        (30, ros.talk(TwistStamped, "jog_hand", GOAL_QOS), jog, "motion"),
        (40, chain.postures, joint_state(JOINTS, 0, Q), ""),
    ):
        publisher.publish(message)
        chain.await_goals()
        chain.answer(stamp)
        moving = [part for part in ("v", "motion") if getattr(targets.targets, part) is not None]
        assert moving == list(filter(None, [moves])), stamp


def test_jogs_that_waited_for_the_robot_are_dropped(ros, capfd):
    chain = NodeChain(ros)
    jogs = ros.talk(JointState, "jog_joints", GOAL_QOS)
    chain.answer(10)
    jogs.publish(JointState(name=JOINTS[:1], velocity=[0.1]))
    chain.await_goals()
    chain.answer(400)
    ros.wait_until(lambda: "jog_joints: 1;" in chain.reported("goals_refused"), "the refusal")
    assert "no joint state has come within 0.25 s of it" in capfd.readouterr().err
    assert chain.reported("mode") == "HOLD"
    jogs.publish(JointState(name=JOINTS[:1], velocity=[0.1]))
    chain.await_goals()
    chain.answer(402)
    chain.await_mode("TRACKING")


def test_a_goal_that_waits_is_told_and_one_of_another_clock_is_refused(ros, monkeypatch, capfd):
    monkeypatch.setattr(waiting_goals, "WAITING_MAX", 2)
    monkeypatch.setattr(refusals, "SAME_PERIOD", math.inf)
    chain = NodeChain(ros, goal_ahead_max=2.0)

    def send(stamp, refused):
        chain.poses.publish(pose_message(GOAL, stamp=stamp))
        told = f"target_pose: {refused};"
        ros.wait_until(lambda: told in chain.reported("goals_refused"), told)

    chain.poses.publish(pose_message(GOAL, stamp=time.time_ns()))
    chain.await_goals()  # no state says yet which time the robot has
    chain.answer(10)
    chain.await_goals(0)
    send(time.time_ns(), refused=2)
    told = capfd.readouterr().err  # once only: but for its numbers the second line is the same
    assert told.count("that of the joint states: it is the wall clock's, the robot has anoth") == 1
    send(3000 * MS, refused=3)
    assert "2.99 s ahead of that of the joint states; allowed: 2 s, or 0" in capfd.readouterr().err
    for _ in range(2):
        chain.poses.publish(pose_message(GOAL, stamp=1510 * MS))
    send(1510 * MS, refused=4)
    assert chain.reported("goals_pending") == "2"
    assert "; target_pose due in 1.5 s" in chain.reported("message")


def test_goals_that_no_task_serves_get_one_warning(ros, capfd):
    chain = NodeChain(ros, posture_kp=0.0)
    for stamp in (10, 20):
        chain.postures.publish(joint_state(JOINTS, 0, GOAL_Q))
        chain.await_goals()
        chain.answer(stamp)
    told = "target_posture: posture_kp is 0: no task brings the arm to the goal"
    assert capfd.readouterr().err.count(told) == 1
    ros.accepts("controller_node", posture_kp=1.0)
    chain.postures.publish(joint_state(JOINTS, 0, GOAL_Q))
    chain.await_goals()
    chain.answer(30)
    assert told not in capfd.readouterr().err


# Torques


def test_efforts_are_published_for_ros2_control_too(ros):
    """Reliably, as its controllers may ask for."""
    topic = "/effort_controller/commands"
    chain = NodeChain(ros, ros2_control_topic=topic)
    # What forward_command_controller subscribes with.
    efforts = ros.listen(Float64MultiArray, topic, qos_profile_system_default)
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


def test_it_says_that_limits_are_not_promised_with_a_limited_rate_of_torque(ros, capfd):
    chain = NodeChain(ros, torque_rate_max=[100.0] * ARM.n)
    ros.wait_until(lambda: chain.reported("torque_rate_max") == "clipped")
    assert "limits are not promised with it" in capfd.readouterr().err


# What is told


def test_joints_that_cannot_hold_the_arm_and_goals_that_cannot_be_held_are_named(ros):
    chain = NodeChain(ros, safety_filter=True, pose_weight=0.0)
    chain.answer(10, v=REST)
    ros.wait_until(lambda: chain.reported("joints_too_weak_to_hold") == "none")
    assert "as wanted" in chain.reported("steps_by_plan")
    stretched = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    chain.postures.publish(joint_state(JOINTS, 0, stretched))
    chain.await_goals()
    chain.answer(220, q=stretched, v=REST)
    said = "left_s1 needs 5"
    ros.wait_until(lambda: said in chain.reported("joints_too_weak_to_hold"))
    assert f"cannot be held where it would come to rest: {said}" in chain.reported("message")
    assert f"goal cannot be held: {said}" in chain.reported("message")
    assert float(chain.reported("plan_torque_left")) < 0.0


def test_the_hand_is_shown_in_the_base_frame_until_the_robot_is_silent(ros):
    frame = "left_arm_mount"
    base = ARM.model.frames[ARM.model.getFrameId(frame)].placement
    chain = NodeChain(ros, base_frame=frame, bounds_timeout=0.1, state_timeout=0.3)
    hand = ros.listen(PoseStamped, "hand_pose", STATUS_QOS)
    ros.wait_until(lambda: 1 * MS in hand.stamps, "the hand", each=lambda: chain.both(1))
    shown = pose_from_message(hand[-1], frame)
    assert shown.isApprox(base.actInv(pose_at(Q)), 1e-9)
    chain.await_mode("STOPPED")
    ros.run_for(0.2)
    hand.clear()
    ros.run_for(0.2)
    assert not hand


def test_the_mode_is_shown_when_it_changes_and_to_who_comes_late(ros):
    chain = NodeChain(ros)
    modes = ros.listen(String, "controller_mode", LATCHED_QOS)
    ros.wait_until(lambda: modes, "the mode at start")
    chain.answer(1)
    ros.wait_until(lambda: modes[-1].data == "HOLD", "the mode")
    give_goal(chain, first=2)
    ros.wait_until(lambda: modes[-1].data == "TRACKING", "the mode")
    assert [mode.data for mode in modes] == ["STOPPED", "HOLD", "TRACKING"]
    late = ros.listen(String, "controller_mode", LATCHED_QOS)
    ros.wait_until(lambda: late, "the mode again")
    assert [mode.data for mode in late] == ["TRACKING"]
