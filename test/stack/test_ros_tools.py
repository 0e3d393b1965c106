# SPDX-License-Identifier: Apache-2.0
"""What the tools of ROS do with the nodes: parameters, remapping, simulated time, log level.

Topics, their types, QoS and the parameters' descriptions are in test_reference.py.
"""

from pathlib import Path

import pytest
from chain import load_values
from node_chain import GOAL, NodeChain, give_goal, pose_message
from rcl_interfaces.msg import LoggerLevel
from rcl_interfaces.srv import (
    GetLoggerLevels,
    GetParameters,
    ListParameters,
    SetLoggerLevels,
    SetParametersAtomically,
)
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import set_stamp
from viability_bounds_pkg.testing.ros_harness import joint_state, overrides

ROOT = Path(__file__).resolve().parents[2]

VALUES = load_values("panda") | {
    "scenario": str(ROOT / "config" / "scenarios" / "panda_demo.yaml"),
    "start_paused": True,
}
KINDS = (BoundsNode, ControllerNode, BulletNode, ScenarioNode)


def start(ros, kind, *rules, **changed):
    """Start a node as `ros2 run` does, with `-r` rules."""
    arguments = ["--ros-args", *(word for rule in rules for word in ("-r", rule))]
    values = overrides(VALUES | changed)
    return ros.add(kind(context=ros.context, cli_args=arguments, parameter_overrides=values))


def call(ros, node, kind, name, **request):
    return ros.call(kind, f"{node.get_fully_qualified_name()}/{name}", kind.Request(**request))


@pytest.mark.parametrize(
    ("kind", "live"),
    [
        (BoundsNode, "bounds_dt_factor"),
        (ControllerNode, "posture_kp"),
        (BulletNode, "pause_after"),
    ],
)
def test_live_parameters_are_set_and_others_refused(ros, kind, live):
    node = start(ros, kind)
    ros.accepts(kind.NAME, **{live: 2.5})
    assert "read-only" in ros.refuses(kind.NAME, rate_hz=100.0)
    both = [Parameter(name, value=3.5).to_parameter_msg() for name in (live, "rate_hz")]
    service = SetParametersAtomically, "set_parameters_atomically"
    assert not call(ros, node, *service, parameters=both).result.successful
    (value,) = call(ros, node, GetParameters, "get_parameters", names=[live]).values
    assert value.double_value == 2.5


def test_topics_are_remapped(ros):
    start(ros, BoundsNode, "joint_states:=/franka/joint_states", "__ns:=/arm")
    limits = ros.listen(JointTrajectory, "/arm/acceleration_limits")
    states = ros.talk(JointState, "/franka/joint_states")
    ros.hears("/arm/acceleration_limits")
    joints = VALUES["joints"]
    state = joint_state(joints, 10, VALUES["start_positions"], [0.0] * len(joints))
    ros.wait_until(lambda: limits, "limits", each=lambda: states.publish(state))
    assert limits.stamps[0] == 10


@pytest.mark.parametrize("kind", KINDS)
def test_nodes_are_renamed(ros, kind):
    node = start(ros, kind, "__node:=other", "__ns:=/here")
    if kind is not ScenarioNode:  # it has nothing to tell
        ros.wait_until(lambda: "here/other" in ros.diagnostics, "diagnostics")
    ros.call(ListParameters, "/here/other/list_parameters", ListParameters.Request())
    ours = {name for name, _ in node.get_topic_names_and_types()}
    ours -= {"/rosout", "/parameter_events", "/diagnostics"}
    assert {name for name in ours if not name.startswith("/here/")} == set()


def test_the_log_level_is_set_while_a_node_runs(ros):
    node = start(ros, ControllerNode)
    logger = node.get_logger()
    wanted = [LoggerLevel(name=logger.name, level=int(LoggingSeverity.DEBUG))]
    answer = call(ros, node, SetLoggerLevels, "set_logger_levels", levels=wanted)
    assert answer.results[0].successful
    got = call(ros, node, GetLoggerLevels, "get_logger_levels", names=[logger.name])
    assert got.levels[0].level == logger.get_effective_level() == LoggingSeverity.DEBUG
    logger.set_level(LoggingSeverity.UNSET)


# use_sim_time


def clock(ros):
    """A publisher of simulated time, s, that stands still unless it is called."""
    publisher = ros.probe.create_publisher(Clock, "/clock", 10)

    def publish(seconds):
        message = Clock()
        set_stamp(message.clock, round(1e9 * seconds))
        publisher.publish(message)

    return publish


def is_at(node, seconds):
    return node.get_clock().now().nanoseconds == round(1e9 * seconds)


def test_the_controller_notices_silence_although_simulated_time_stands_still(ros):
    tell = clock(ros)
    chain = NodeChain(ros, use_sim_time=True, bounds_timeout=0.2, state_timeout=0.4)
    ros.wait_until(lambda: is_at(chain.node, 7.0), "simulated time", each=lambda: tell(7.0))
    stamp = give_goal(chain)
    chain.await_mode("STOPPED", "no joint state", each=lambda: tell(7.0))
    assert is_at(chain.node, 7.0)
    chain.await_mode("HOLD", each=lambda: chain.state(stamp))


def test_a_leap_of_simulated_time_times_out_nothing(ros):
    tell = clock(ros)
    chain = NodeChain(ros, use_sim_time=True)
    stamp = give_goal(chain)
    ros.wait_until(lambda: is_at(chain.node, 7200.0), "the leap", each=lambda: tell(7200.0))
    chain.answer(stamp)
    assert chain.reported("mode") == "TRACKING"


def test_goals_in_simulated_time_take_effect_at_their_stamps(ros):
    """A goal's stamp is compared with those of the states, in whatever time these are."""
    chain = NodeChain(ros, use_sim_time=True)
    chain.poses.publish(pose_message(GOAL, stamp=50_000_000))
    ros.wait_until(lambda: chain.reported("goals_pending") == "1", "the goal")
    chain.answer(49)
    assert chain.reported("goals_pending") == "1"
    chain.answer(50)
    ros.wait_until(lambda: chain.reported("goals_pending") == "0", "its time")
