# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller node, and where the robot's description comes from."""

import math
from dataclasses import replace

import numpy as np
import pytest
from controller_chain import NODE
from node_chain import ARM, GOAL, JOINTS, VALUES, NodeChain, Q, V, expected, pose_message
from std_msgs.msg import String

from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.gains import critical_damping
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.description import read_urdf
from viability_bounds_pkg.ros.runtime import LATCHED_QOS
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import joint_state, names_parameter, read_config

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
        ({"pose_speed_max": [0.01, 0.05]}, {"pose_speed_max": np.array([0.01, 0.05])}),
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
    core.goals.gains = replace(core.goals.gains, **gains)
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


def test_bad_gains_are_refused_and_the_old_ones_stay(ros):
    chain = NodeChain(ros)
    before = chain.answer(10)
    for name, value in (
        ("pose_kp", -1.0),
        ("pose_kp", math.nan),
        ("pose_kd", -2.0),
        ("pose_kd", math.inf),
        ("pose_weight", -1e-3),
        ("posture_kp", "stiff"),
        ("posture_kd", -0.5),
        ("posture_weight", 0.0),
        ("pose_speed_max", [0.1]),
        ("pose_speed_max", [0.1, 0.0]),
        ("hold_kd", -20.0),
    ):
        reason = ros.refuses(NODE, **{name: value})
        assert names_parameter(reason, name)
        assert chain.node.get_parameter(name).value == VALUES.get(name), name
    np.testing.assert_allclose(chain.answer(20), before, atol=1e-3)


def test_geometry_limits_and_rates_are_read_only(ros):
    NodeChain(ros)
    for name, value in (
        ("joints", JOINTS[::-1]),
        ("torque_max", [1e3] * 7),
        ("rate_hz", 1000.0),
        ("base_frame", "torso"),
        ("end_effector_frame", "left_hand"),
        ("robot_description", "other.urdf"),
        ("bounds_timeout", 1.0),
        ("ros2_control_topic", "x"),
    ):
        assert "read-only" in ros.refuses(NODE, **{name: value}), name


BROKEN_URDF = __file__


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
        ({"torque_max": None, "robot_description": "topic"}, "torque_max", "not set"),
        ({"torque_rate_max": [100.0]}, "torque_rate_max", "7 numbers"),
        ({"torque_rate_max": [0.0] * 7}, "torque_rate_max", "> 0"),
        ({"torque_reserve": [1.0] * 6}, "torque_reserve", "7 numbers"),
        ({"torque_reserve": [-1.0] * 7}, "torque_reserve", ">= 0"),
        ({"torque_reserve": [1e3] * 7}, "torque_reserve", "less than 0.97 of torque_max"),
        ({"position_min": list(ARM.q_max)}, "position_max", "above position_min"),
        ({"position_max": [1.0]}, "position_max", "7 numbers"),
        ({"rate_hz": 0.0}, "rate_hz", ">= 1"),
        ({"rate_hz": math.nan}, "rate_hz", "nan"),
        ({"pose_kp": -10.0}, "pose_kp", "-10"),
        ({"pose_kd": -3.0}, "pose_kd", "-3"),
        ({"posture_weight": 0.0}, "posture_weight", "> 0"),
        ({"bounds_timeout": 0.0}, "bounds_timeout", "> 0"),
        ({"state_timeout": -1.0}, "state_timeout", "-1"),
    ],
)
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name, shown):
    shared_ros.refuses_to_start(ControllerNode, VALUES | changed, name, shown)


def test_a_urdf_that_does_not_load_is_named(shared_ros, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text('<robot name="r"><link name="a"/><joint name="j" type="revolute"/></robot>')
    values = VALUES | {"robot_description": str(path)}
    shared_ros.refuses_to_start(ControllerNode, values, "robot_description")


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
