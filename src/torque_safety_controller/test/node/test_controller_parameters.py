# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller node, and where the robot's description comes from."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from controller_chain import NODE, ControllerChain
from node_chain import ARM, GOAL, JOINTS, VALUES, NodeChain, Q, V, expected, pose_message
from rclpy.context import Context
from std_msgs.msg import String

from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.node.declared import (
    commands_in_flight,
    covered_misses,
    declared_robot,
)
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.gains import critical_damping
from viability_bounds_pkg.parameter_files import remember_arguments
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.runtime import LATCHED_QOS
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import (
    config_folder,
    joint_state,
    names_parameter,
    read_config,
)

PANDA = read_config("panda", NODE)

# While it runs


def test_gains_change_while_it_runs(ros):
    chain = NodeChain(ros)
    away = Q + 0.3
    chain.poses.publish(pose_message(GOAL))
    chain.postures.publish(joint_state(JOINTS, 0, away))
    chain.await_goals(2)
    core = expected(GOAL, away)
    wide = np.full(ARM.n, 50.0)
    slow = np.array([0.01, 0.05])
    before = None
    for k, (changed, gains) in enumerate(
        [
            ({}, {}),
            ({"pose_kp": 40.0}, {"pose_kp": 40.0, "pose_kd": critical_damping(40.0)}),
            ({"pose_kd": 1.5}, {"pose_kd": 1.5}),
            ({"posture_kp": 40.0}, {"posture_kp": 40.0, "posture_kd": critical_damping(40.0)}),
            ({"posture_kd": 1.0}, {"posture_kd": 1.0}),
            ({"posture_weight": 1.0}, {"posture_weight": 1.0}),
            ({"pose_weight": 1e-3}, {"pose_weight": 1e-3}),
            ({"pose_weight": 1.0}, {"pose_weight": 1.0}),
            ({"pose_speed_max": slow.tolist()}, {"pose_speed_max": slow}),
        ]
    ):
        ros.accepts(NODE, **changed)
        core.goals.gains = replace(core.goals.gains, **gains)
        after = chain.answer(10 + 10 * k, lower=-wide, upper=wide)
        tau = core.step(State(Q, V), AccelerationRange(-wide, wide)).tau
        np.testing.assert_allclose(after, tau, atol=1e-4, err_msg=str(changed))
        assert before is None or np.abs(after - before).max() > 1e-3, changed
        before = after


def test_bad_values_are_refused_and_the_old_ones_stay(ros):
    chain = NodeChain(ros)
    slow = 0.1 * V
    before = chain.answer(10, v=slow)
    for name, value in (
        ("pose_kp", math.nan),
        ("pose_kd", -2.0),
        ("posture_kp", "stiff"),
        ("posture_weight", 0.0),
        ("pose_speed_max", [0.1, 0.0]),
        ("hold_kd", -20.0),
    ):
        assert names_parameter(ros.refuses(NODE, **{name: value}), name)
        assert chain.node.get_parameter(name).value == VALUES.get(name), name
    for name, value in (("torque_max", [1e3] * 7), ("base_frame", "torso")):
        assert "read-only" in ros.refuses(NODE, **{name: value})
    np.testing.assert_allclose(chain.answer(20, v=slow), before, atol=1e-3)
    ros.accepts(NODE, hold_kd=5.0)
    assert np.abs(chain.answer(30, v=slow) - before).max() > 1e-3


# At start


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"joints": [*JOINTS[:6], "left_w9"]}, "joints", "unknown joint 'left_w9'"),
        ({"locked_joints": ["x"], "locked_positions": [0.1]}, "locked_joints", "'x'"),
        (
            {"locked_joints": ["torso_t0"] * 2, "locked_positions": [0.1, 0.2]},
            "locked_joints",
            "each once",
        ),
        (
            {"locked_joints": JOINTS[:1], "locked_positions": [0.1]},
            "locked_joints",
            "none of 'joints'",
        ),
        ({"ros2_control_topic": "a b"}, "ros2_control_topic", "the name of a topic"),
        ({"end_effector_frame": "nowhere"}, "end_effector_frame", "unknown frame 'nowhere'"),
        ({"torque_max": [math.nan, *ARM.tau_max[1:]]}, "torque_max", "nan"),
        ({"torque_max": None, "robot_description": "topic"}, "torque_max", "not set"),
        ({"torque_rate_max": [0.0] * 7}, "torque_rate_max", "> 0"),
        ({"torque_reserve": [1e3] * 7}, "torque_reserve", "less than 0.97 of torque_max"),
        ({"posture_weight": 0.0}, "posture_weight", "> 0"),
        ({"bounds_timeout": 0.0}, "bounds_timeout", "> 0"),
        ({"goal_ahead_max": 0.0}, "goal_ahead_max", "> 0"),
    ],
)
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name, shown):
    shared_ros.refuses_to_start(ControllerNode, VALUES | changed, name, shown)


def test_a_urdf_that_does_not_load_is_named(shared_ros, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text('<robot name="r"><link name="a"/><joint name="j" type="revolute"/></robot>')
    values = VALUES | {"robot_description": str(path)}
    shared_ros.refuses_to_start(ControllerNode, values, "robot_description")


def test_the_description_may_come_from_its_topic(ros):
    publisher = ros.probe.create_publisher(String, "robot_description", LATCHED_QOS)
    publisher.publish(String(data=read_urdf(PANDA["robot_description"])))
    chain = ControllerChain(ros, PANDA | {"robot_description": "topic", "bounds_timeout": 20.0})
    command = chain.ask(10, PANDA["start_positions"], np.zeros(7))
    assert command.name == PANDA["joints"]


# Of the bounds node beside it


def declared(*words):
    """Return what a node reads of the bounds node, from its own command line."""
    context = Context()
    remember_arguments(context, ["--ros-args", *words])
    return declared_robot(SimpleNamespace(context=context, get_namespace=lambda: "/left"))


@pytest.mark.parametrize(
    ("given", "row", "way"),
    [
        ((), 1, 4),
        (("delay:=2", "delay_jitter:=3", "missed_deadlines:=4"), 4, 12),
        (("bounds_node:delay:=1",), 1, 5),
        (("controller_node:delay:=1",), 1, 4),
    ],
)
def test_late_and_missed_commands_that_are_declared_are_within_reach(given, row, way):
    rules = [word for rule in given for word in ("-p", rule)]
    robot = declared("--params-file", str(config_folder() / "panda.yaml"), *rules)
    assert (covered_misses(robot), commands_in_flight(robot)) == (row, way)
