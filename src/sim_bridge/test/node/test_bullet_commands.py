# SPDX-License-Identifier: Apache-2.0
"""The robot node: states, and commands that are obeyed or refused."""

import math

import numpy as np
import pinocchio as pin
import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from robot_probe import JOINTS, PERIOD, VALUES, Q, RobotProbe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.robot.description import inertia_beyond, read_urdf
from viability_bounds_pkg.ros.runtime import (
    LATCHED_QOS,
    stamp_to_ns,
)
from viability_bounds_pkg.testing.ros_harness import read_config


def test_each_command_with_the_right_stamp_moves_time_by_one_period(ros):
    robot = RobotProbe(ros)
    first = robot.stamp
    assert first == PERIOD
    robot.step(times=5)
    assert robot.stamp == first + 5 * PERIOD
    assert robot.states[-1].name[:7] == JOINTS
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


@pytest.mark.parametrize(
    ("reason", "send"),
    [
        ("not finite", lambda r: r.send(r.stamp, [math.nan] * 7)),
        ("not finite", lambda r: r.send(r.stamp, [math.inf] + [0.0] * 6)),
        ("wrong size", lambda r: r.send(r.stamp, [1.0] * 3)),
        ("missing joint", lambda r: r.send(r.stamp, [1.0] * 6, JOINTS[1:])),
        ("wrong size", lambda r: r.send(r.stamp)),
        ("wrong size", lambda r: r.send(r.stamp, q=Q[:3])),
        ("wrong size", lambda r: r.send(r.stamp, q=Q, v=[0.0])),
        ("wrong size", lambda r: r.send(r.stamp, [1.0] * 3, q=Q)),
        ("not finite", lambda r: r.send(r.stamp, q=[math.nan] * 7)),
        ("not finite", lambda r: r.send(r.stamp, q=Q, v=[0.0] * 6 + [math.inf])),
        ("not finite", lambda r: r.send(r.stamp, [math.nan] * 7, q=Q)),
        ("missing joint", lambda r: r.send(r.stamp, q=Q[1:], joints=JOINTS[1:])),
        ("not for this period", lambda r: r.send(r.stamp - PERIOD, q=Q)),
        ("not for this period", lambda r: r.send(r.stamp - PERIOD, [1.0] * 7)),
        ("not for this period", lambda r: r.send(r.stamp + PERIOD, [1.0] * 7)),
    ],
)
def test_commands_that_cannot_be_obeyed_are_dropped_and_counted(ros, reason, send):
    robot = RobotProbe(ros)
    robot.step(times=3)
    stamp = robot.stamp
    send(robot)
    ros.wait_until(lambda: f"{reason}: 1;" in robot.reported("commands_refused"))
    assert robot.stamp == stamp
    robot.step()  # and it goes on


def test_names_may_come_in_any_order(ros):
    robot = RobotProbe(ros)
    order = [3, 1, 6, 0, 2, 5, 4]
    for _ in range(20):
        stamp, tau = robot.stamp, robot.gravity()
        robot.send(stamp, tau[order], [JOINTS[i] for i in order])
        ros.wait_until(lambda s=stamp: robot.stamp > s)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_torque_beyond_the_limits_is_clipped_and_reported(ros):
    robot = RobotProbe(ros)
    robot.step(3.0 * np.array(VALUES["torque_max"]))
    robot.step()
    ros.wait_until(lambda: float(robot.reported("commanded_torque_ratio_max") or 0.0) > 2.9)
    applied = np.array([float(x) for x in robot.reported("torque_ratio").split()])
    assert applied.max() <= 1.0 + 1e-9


def test_effort_is_the_torque_that_the_motors_gave(ros):
    robot = RobotProbe(ros)
    tau = robot.gravity() + 0.5
    robot.step(tau)
    np.testing.assert_allclose(robot.tau, tau, rtol=1e-12)


def test_other_joints_in_a_command_are_ignored(ros):
    robot = RobotProbe(ros)
    stamp, tau = robot.stamp, robot.gravity()
    robot.send(stamp, [math.nan, *tau], ["other", *JOINTS])
    ros.wait_until(lambda: robot.stamp > stamp, "the next state")
    np.testing.assert_allclose(robot.tau, tau, rtol=1e-12)


def test_positions_are_held_by_the_drives(ros):
    robot = RobotProbe(ros)
    robot.move(Q, times=30)
    np.testing.assert_allclose(robot.q, Q, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(robot.tau, robot.gravity(), atol=0.05)
    robot.await_reported("control", "position")
    goal = Q + np.linspace(-0.1, 0.1, 7)
    robot.move(goal, times=400)
    np.testing.assert_allclose(robot.q, goal, rtol=0.0, atol=1e-3)
    assert robot.reported("commands_refused") == "none"
    assert max(float(x) for x in robot.reported("torque_ratio").split()) <= 1.0


def test_positions_may_come_in_any_order_and_with_velocities(ros):
    robot = RobotProbe(ros)
    order = [3, 1, 6, 0, 2, 5, 4]
    speed = np.linspace(0.05, 0.1, 7)
    for k in range(100):
        stamp, path = robot.stamp, Q + speed * (k + 1) * PERIOD * 1e-9
        names = [*(JOINTS[i] for i in order), "other"]
        robot.send(stamp, joints=names, q=[*path[order], 9.0], v=[*speed[order], 9.0])
        ros.wait_until(lambda s=stamp: robot.stamp > s)
    np.testing.assert_allclose(robot.q, path, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(robot.v, speed, atol=0.01)


def test_control_changes_at_any_time_without_a_jump(ros):
    robot = RobotProbe(ros)
    robot.step(times=5)
    tau = robot.tau
    q, v = robot.q, robot.v
    robot.move(q + v * PERIOD * 1e-9, v)
    assert (np.abs(robot.tau - tau) < 1e-3 * np.abs(tau).max()).all()
    robot.move(q, times=20)
    robot.send(robot.stamp, robot.gravity(), q=Q + 1.0)  # efforts win
    robot.await_reported("control", "torque")
    robot.step(times=20)
    np.testing.assert_allclose(robot.q, Q, atol=1e-3)


def test_the_sensor_is_published_for_each_state_with_bias_and_seeded_noise(ros):
    robot = RobotProbe(ros, imperfection_seed=3)
    felt = ros.listen(WrenchStamped, "ft_wrench")
    ros.hears("ft_wrench")

    def course():
        """Let 40 periods pass after a reset; return what was felt, shape (40, 6)."""
        begin = robot.stamp
        assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
        ros.wait_until(lambda: robot.stamp > begin)
        robot.step(times=40)
        ros.wait_until(lambda: felt and felt.stamps[-1] == robot.stamp)
        of = {stamp_to_ns(message.header.stamp): message.wrench for message in felt}
        wrenches = [of[stamp] for stamp in sorted(of)[-40:]]
        assert felt[-1].header.frame_id == VALUES["ft_frame"]
        return np.array(
            [
                [w.force.x, w.force.y, w.force.z, w.torque.x, w.torque.y, w.torque.z]
                for w in wrenches
            ]
        )

    one, other = course(), course()
    assert one.shape == (40, 6)
    np.testing.assert_array_equal(one, other)
    noise, bias = np.array(VALUES["ft_noise"]), np.array(VALUES["ft_bias"])
    assert (0.5 * noise < one.std(axis=0)).all() and (one.std(axis=0) < 2.0 * noise).all()
    tool = inertia_beyond(read_urdf(VALUES["robot_description"]), VALUES["ft_frame"])
    weight = one.mean(axis=0)[:3] - bias[:3]  # the hand points down
    np.testing.assert_allclose(weight, [0.0, 0.0, 9.81 * tool.mass], atol=0.08)


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_robot_state_publisher_can_place_every_link(ros, robot):
    """It reads the description, and the joints by name: those that are locked, too."""
    node = ros.start(BulletNode, read_config(robot, "bullet_node") | {"clock": "lockstep"})
    states = ros.listen(JointState, "joint_states", qos_profile_sensor_data)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    descriptions = ros.listen(String, "robot_description", latched)
    ros.wait_until(lambda: states and descriptions)
    state, model = states[-1], pin.buildModelFromXML(descriptions[0].data)
    assert set(state.name) == set(model.names) - {"universe"}
    q, data = pin.neutral(model), model.createData()
    for name, position in zip(state.name, state.position, strict=True):
        joint = model.joints[model.getJointId(name)]
        angle = [math.cos(position), math.sin(position)]  # of a continuous joint
        q[joint.idx_q : joint.idx_q + joint.nq] = [position] if joint.nq == 1 else angle
    pin.framesForwardKinematics(model, data, q)
    links = [f.name for f in model.frames if f.type == pin.FrameType.BODY and f.name != "universe"]
    for link in links:
        placed = data.oMf[model.getFrameId(link, pin.FrameType.BODY)]
        simulated = node._robot.link_pose(link)
        np.testing.assert_allclose(placed.homogeneous, simulated.homogeneous, atol=1e-6)
    others = slice(len(node._config.joints), None)
    assert not any(state.velocity[others]) and not any(state.effort[others])
    assert len(state.velocity) == len(state.effort) == len(state.name)


def test_robot_description_and_clock_are_published(ros):
    clocks = ros.listen(Clock, "/clock")
    robot = RobotProbe(ros, publish_clock=True)
    late = ros.listen(String, "robot_description", LATCHED_QOS)
    ros.wait_until(lambda: late)
    assert "<robot" in late[0].data
    robot.step()
    ros.wait_until(lambda: clocks and stamp_to_ns(clocks[-1].clock) == robot.stamp)


def test_a_broken_limit_is_an_error_in_diagnostics(ros):
    robot = RobotProbe(ros)
    for _ in range(400):
        robot.step(robot.gravity() + np.array([0.0] * 6 + [6.0]))
        if np.abs(robot.v[6]) > VALUES["velocity_max"][6] + 0.1:
            break
    ros.wait_until(lambda: robot.reported("message") == "a limit was broken")
    violation = [float(x) for x in robot.reported("velocity_violation_rad_s").split()]
    assert violation[6] > 0.1
    assert max(violation[:5]) < 0.1
