# SPDX-License-Identifier: Apache-2.0
"""The robot node: states, and commands that are obeyed or refused."""

import math

import numpy as np
import pinocchio as pin
import pytest
from geometry_msgs.msg import WrenchStamped
from robot_probe import JOINTS, PERIOD, VALUES, Q, RobotProbe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.robot.description import inertia_beyond
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.runtime import LATCHED_QOS, stamp_to_ns
from viability_bounds_pkg.testing.ros_harness import read_config

ORDER = [3, 1, 6, 0, 2, 5, 4]
SHUFFLED = [*(JOINTS[i] for i in ORDER), "other"]


def test_each_command_moves_time_by_one_period(ros):
    clocks = ros.listen(Clock, "/clock")
    robot = RobotProbe(ros, publish_clock=True)
    assert robot.stamp == PERIOD
    robot.step(times=5)
    assert robot.stamp == 6 * PERIOD
    ros.wait_until(lambda: clocks and stamp_to_ns(clocks[-1].clock) == robot.stamp)
    assert robot.states[-1].name[:7] == JOINTS
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_commands_that_cannot_be_obeyed_are_dropped_and_counted(ros):
    robot = RobotProbe(ros)
    robot.step(times=3)
    stamp, counts = robot.stamp, {}
    for reason, command in (
        ("not finite", {"tau": [math.nan] * 7}),
        ("not finite", {"tau": [math.inf] + [0.0] * 6}),
        ("not finite", {"q": [math.nan] * 7}),
        ("not finite", {"q": Q, "v": [0.0] * 6 + [math.inf]}),
        ("not finite", {"tau": [math.nan] * 7, "q": Q}),
        ("wrong size", {}),
        ("wrong size", {"tau": [1.0] * 3}),
        ("wrong size", {"tau": [1.0] * 3, "q": Q}),
        ("wrong size", {"q": Q[:3]}),
        ("wrong size", {"q": Q, "v": [0.0]}),
        ("missing joint", {"tau": [1.0] * 6, "joints": JOINTS[1:]}),
        ("missing joint", {"q": Q[1:], "joints": JOINTS[1:]}),
        ("not for this period", {"tau": [1.0] * 7, "stamp": stamp - PERIOD}),
        ("not for this period", {"tau": [1.0] * 7, "stamp": stamp + PERIOD}),
        ("not for this period", {"q": Q, "stamp": stamp - PERIOD}),
    ):
        robot.send(**{"stamp": stamp} | command)
        counts[reason] = counts.get(reason, 0) + 1
        expected = {f"{each}: {count}" for each, count in counts.items()}
        ros.wait_until(
            lambda e=expected: all(f"{each};" in robot.reported("commands_refused") for each in e),
            f"{expected} after {command}",
        )
    assert robot.stamp == stamp
    robot.step()  # and it goes on


def test_joints_are_found_by_their_names(ros):
    robot = RobotProbe(ros)
    tau = robot.gravity() + np.linspace(0.1, 0.7, 7)
    robot.step(tau=[*tau[ORDER], math.nan], joints=SHUFFLED)
    np.testing.assert_allclose(robot.tau, tau, rtol=1e-12)


def test_torque_beyond_the_limits_is_clipped_and_reported(ros):
    robot = RobotProbe(ros)
    robot.step(3.0 * np.array(VALUES["torque_max"]))
    np.testing.assert_array_equal(robot.tau, VALUES["torque_max"])
    assert float(robot.reported_now("commanded_torque_ratio_max")) > 2.9
    assert max(map(float, robot.reported("torque_ratio").split())) <= 1.0 + 1e-9


def test_positions_are_held_and_followed_by_the_drives(ros):
    robot = RobotProbe(ros)
    robot.step(q=Q, times=20)
    np.testing.assert_allclose(robot.q, Q, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(robot.tau, robot.gravity(), atol=0.05)
    speed = np.linspace(0.05, 0.1, 7)
    for k in range(60):
        path = Q + speed * (k + 1) * PERIOD * 1e-9
        robot.step(joints=SHUFFLED, q=[*path[ORDER], 9.0], v=[*speed[ORDER], 9.0])
    np.testing.assert_allclose(robot.q, path, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(robot.v, speed, atol=0.01)
    robot.await_reported("control", "position")
    assert robot.reported("commands_refused") == "none"


def test_control_changes_at_any_time_and_efforts_win(ros):
    robot = RobotProbe(ros)
    robot.step(q=Q, times=5)
    robot.step(tau=robot.gravity(), q=Q + 1.0)
    robot.await_reported("control", "torque")
    robot.step(q=Q, times=5)
    robot.await_reported("control", "position")
    np.testing.assert_allclose(robot.q, Q, atol=1e-3)


def test_the_sensor_is_published_for_each_state_with_bias_and_seeded_noise(ros):
    robot = RobotProbe(ros, imperfection_seed=3)
    felt = ros.listen(WrenchStamped, "ft_wrench")
    ros.hears("ft_wrench")

    def course():
        """Let 40 periods pass after a reset; return what was felt, shape (40, 6)."""
        robot.reset()
        robot.step(times=40)
        ros.wait_until(lambda: felt and felt.stamps[-1] == robot.stamp)
        of = {stamp_to_ns(message.header.stamp): message.wrench for message in felt}
        wrenches = [of[stamp] for stamp in sorted(of)[-40:]]
        parts = [(wrench.force, wrench.torque) for wrench in wrenches]
        return np.array([[v.x, v.y, v.z] for both in parts for v in both]).reshape(40, 6)

    one, other = course(), course()
    np.testing.assert_array_equal(one, other)
    assert felt[-1].header.frame_id == VALUES["ft_frame"]
    noise, bias = np.array(VALUES["ft_noise"]), np.array(VALUES["ft_bias"])
    assert (0.5 * noise < one.std(axis=0)).all() and (one.std(axis=0) < 2.0 * noise).all()
    tool = inertia_beyond(read_urdf(VALUES["robot_description"]), VALUES["ft_frame"])
    weight = one.mean(axis=0)[:3] - bias[:3]  # the hand points down
    np.testing.assert_allclose(weight, [0.0, 0.0, 9.81 * tool.mass], atol=0.08)


def test_robot_state_publisher_can_place_every_link(ros):
    """It reads the description, and the joints by name: those that are locked, too."""
    values = read_config("talos_left_arm", "bullet_node") | {"clock": "lockstep"}
    states = ros.listen(JointState, "joint_states")
    descriptions = ros.listen(String, "robot_description", LATCHED_QOS)
    ros.start(BulletNode, values)
    ros.wait_until(lambda: states and descriptions)
    state, model = states[-1], pin.buildModelFromXML(descriptions[0].data)
    assert len(state.velocity) == len(state.effort) == len(state.name)
    positions = dict(zip(state.name, state.position, strict=True))
    expected = dict.fromkeys(list(model.names)[1:], 0.0)
    for kind, key in (("joints", "start_positions"), ("locked_joints", "locked_positions")):
        expected |= dict(zip(values[kind], values[key], strict=True))
    assert positions == pytest.approx(expected, abs=1e-12)


def test_a_broken_limit_is_an_error_in_diagnostics(ros):
    robot = RobotProbe(ros)
    for _ in range(400):
        robot.step(robot.gravity() + np.array([0.0] * 6 + [6.0]))
        if np.abs(robot.v[6]) > VALUES["velocity_max"][6] + 0.1:
            break
    robot.await_reported("message", "a limit was broken")
    violation = [float(x) for x in robot.reported("velocity_violation_rad_s").split()]
    assert violation[6] > 0.1
    assert max(violation[:5]) < 0.1
