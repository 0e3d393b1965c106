# SPDX-License-Identifier: Apache-2.0
"""Limits, goals and torques of the controller node as messages."""

import math
import re

import numpy as np
import pytest
from controller_chain import MS
from geometry_msgs.msg import PoseStamped
from node_chain import (
    ARM,
    GOAL,
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
from rclpy.qos import qos_profile_system_default
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.node.topics import (
    TARGET_POSE,
    TARGET_POSTURE,
    TARGET_TRAJECTORY,
    TARGET_WRENCH,
)
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.ros.runtime import CONTROL_QOS, GOAL_QOS
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import acceleration_limits, joint_state

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
        joint_state(JOINTS[1:], 0, Q[1:]),
        joint_state(JOINTS, 0, Q[1:]),
        joint_state([], 0, []),
        joint_state(JOINTS, 0, [math.nan, *Q[1:]]),
        joint_state(JOINTS, 0, [math.inf, *Q[1:]]),
        joint_state(JOINTS, 0, [*Q[:6], ARM.q_max[6] + 0.01]),
        joint_state(JOINTS, 0, [ARM.q_min[0] - 0.01, *Q[1:]]),
    ],
)
def test_goals_that_cannot_be_followed_are_refused_and_counted(ros, message):
    chain = NodeChain(ros)
    chain.answer(10)
    pose = isinstance(message, PoseStamped)
    (chain.poses if pose else chain.postures).publish(message)
    refused = f"{'target_pose' if pose else 'target_posture'}: 1;"
    ros.wait_until(lambda: chain.reported("goals_refused") == refused, "the refusal")
    chain.answer(20)
    assert chain.reported("goals_pending") == "0"
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
            core.goals.set_pose(GOAL)
        elif stamp == 70:
            core.goals.set_pose(other)
        tau = chain.answer(stamp)
        np.testing.assert_allclose(
            tau,
            core.step(State(Q, V), AccelerationRange(LOWER, UPPER)).tau,
            atol=1e-4,
            err_msg=f"at {stamp} ms",
        )
    ros.wait_until(lambda: chain.reported("goals_pending") == "0")
    assert chain.reported("mode") == "TRACKING"


def test_a_publisher_of_goals_that_cannot_be_heard_is_refused_and_counted(ros, capfd):
    chain = NodeChain(ros)
    for topic in (TARGET_POSE, TARGET_POSTURE, TARGET_TRAJECTORY, TARGET_WRENCH):
        ros.probe.create_publisher(topic.message, topic.name, CONTROL_QOS)
        refusal = f"{topic.name}: 1;"
        ros.wait_until(lambda text=refusal: text in chain.reported("goals_refused"), refusal)
        line = f"{topic.name} refused: the quality of service of a publisher is best effort"
        assert capfd.readouterr().err.count(line) == 1


# Output


def test_efforts_are_published_for_ros2_control_too(ros):
    """Reliably, as its controllers may ask for."""
    topic = "/effort_controller/commands"
    chain = NodeChain(ros, ros2_control_topic=topic)
    efforts = ros.listen(Float64MultiArray, topic, GOAL_QOS)
    # What forward_command_controller subscribes with.
    by_default = ros.listen(Float64MultiArray, topic, qos_profile_system_default)
    ros.hears(topic)
    tau = chain.answer(10)
    ros.wait_until(lambda: efforts and by_default, "efforts", each=lambda: chain.state(10))
    np.testing.assert_array_equal(efforts[0].data, tau)
    np.testing.assert_array_equal(by_default[0].data, tau)


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


def test_an_impossible_state_is_refused_and_forgotten(ros):
    chain = NodeChain(ros)
    stamp = give_goal(chain)
    ros.wait_until(
        lambda: "impossible" in chain.reported("states_refused"),
        each=lambda: chain.both(stamp + 1, v=np.full(ARM.n, 1e200)),
    )
    stamps = iter(range(stamp + 2, stamp + 2000))
    ros.wait_until(
        lambda: chain.reported("mode") == "TRACKING",
        each=lambda: chain.both(next(stamps), v=REST),
    )


def test_states_that_freeze_in_motion_stop_the_arm_until_they_are_plausible_again(ros):
    chain = NodeChain(ros)
    stamps = iter(range(give_goal(chain) + 10, 100_000, 10))
    chain.await_mode("STOPPED", each=lambda: chain.both(next(stamps), v=0.5 * ARM.v_max))
    assert chain.reported("reason") == "joint states are refused: impossible"
    assert "impossible" in chain.reported("states_refused")
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
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps)))


def test_the_rate_of_torque_is_limited_and_that_is_told(ros, capfd):
    rate = np.full(ARM.n, 100.0)
    chain = NodeChain(ros, torque_rate_max=rate.tolist())
    tau = [
        chain.answer(10 * k, q=Q + 0.01 * k, lower=a, upper=a)
        for k, a in ((1, -UPPER), (2, UPPER), (3, -UPPER))
    ]
    change = np.abs(np.diff(tau, axis=0))
    assert (change <= rate * ARM.dt + 1e-9).all()
    assert (change > 0.3 * rate * ARM.dt).any()
    ros.wait_until(lambda: chain.reported("torque_rate_max") == "clipped")
    assert "limits are not promised with it" in capfd.readouterr().err


def test_joints_at_a_limit_are_named(ros):
    chain = NodeChain(ros)
    lower, upper = LOWER.copy(), UPPER.copy()
    lower[3] = upper[3] = 0.7
    chain.answer(10, v=REST, lower=lower, upper=upper)
    ros.wait_until(lambda: chain.reported("joints_at_acceleration_limit") == JOINTS[3])


def test_joints_that_cannot_hold_the_arm_are_named(ros):
    chain = NodeChain(ros, safety_filter=True)
    chain.answer(10, v=REST)
    ros.wait_until(lambda: chain.reported("joints_too_weak_to_hold") == "none")
    assert "as wanted" in chain.reported("steps_by_plan")
    stretched = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    chain.answer(220, q=stretched, v=REST)
    said = "left_s1 needs 5"
    ros.wait_until(lambda: said in chain.reported("joints_too_weak_to_hold"))
    assert f"cannot be held where it would come to rest: {said}" in chain.reported("message")
    assert float(chain.reported("plan_torque_left")) < 0.0


def test_a_goal_that_cannot_be_held_is_named(ros):
    chain = NodeChain(ros, pose_weight=0.0)
    chain.answer(10, v=REST)
    stretched = [0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0]
    chain.postures.publish(joint_state(JOINTS, 0, stretched))
    stamps = iter(range(20, 2000, 10))
    chain.await_mode("TRACKING", each=lambda: chain.both(next(stamps), v=REST))
    ros.wait_until(lambda: "goal cannot be held: left_s1 needs 5" in chain.reported("message"))
