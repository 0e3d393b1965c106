# SPDX-License-Identifier: Apache-2.0
"""Messages between nodes of one process, with other publishers and subscribers around it."""

import pytest
from sensor_msgs.msg import JointState

from viability_bounds_pkg.ros.arm_node import ArmNode, connect
from viability_bounds_pkg.ros.runtime import STATUS_QOS, stamp_to_ns
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.testing.ros_harness import RosHarness, joint_state


def state(stamp):
    return joint_state(["a", "b"], stamp, (1.0, 2.0), (0.0, 0.0))


def at(message):
    return stamp_to_ns(message.header.stamp)


class Part(ArmNode):
    """A node that hears states and commands, and may publish both."""

    NAME = "part"

    def __init__(self, ros, name, *published, on_state=None, on_command=None, remap=""):
        rules = [word for rule in (f"__node:={name}", remap) if rule for word in ("-r", rule)]
        super().__init__(context=ros.context, cli_args=["--ros-args", *rules])
        self.states = self.stream(JOINT_STATES) if JOINT_STATES in published else None
        self.commands = self.stream(JOINT_COMMANDS) if JOINT_COMMANDS in published else None
        if on_state is not None:
            self.listen(JOINT_STATES, on_state)
        if on_command is not None:
            self.listen(JOINT_COMMANDS, on_command)
        ros.add(self)


class Process:
    """A robot, a controller that answers it, and one that looks on, connected."""

    def __init__(self, ros, on_command=None):
        self.heard = {"controller": [], "other": []}
        self.commands = []
        self.controller = Part(ros, "controller", JOINT_COMMANDS, on_state=self.answer)
        self.robot = Part(
            ros, "robot", JOINT_STATES, on_command=on_command or self.commands.append
        )
        other = Part(ros, "other", on_state=self.heard["other"].append)
        connect([self.controller, other, self.robot])

    def answer(self, message):
        self.heard["controller"].append(message)
        self.controller.commands.publish(message)

    def all_heard(self, stamp):
        return all(stamp in map(at, heard) for heard in self.heard.values())


@pytest.fixture
def others(ros):
    """Another process: another participant in the same domain."""
    harness = RosHarness(ros.domain)
    yield harness
    harness.close()


def test_reliable_subscribers_as_those_of_moveit_hear_a_stream(ros):
    robot = Part(ros, "robot", JOINT_STATES)
    heard = ros.listen(JointState, "joint_states", STATUS_QOS)
    ros.wait_until(lambda: heard, each=lambda: robot.states.publish(state(1)))


def test_all_get_the_same_object_once_and_others_get_it_too(ros):
    process = Process(ros)
    outside = ros.listen(JointState, "joint_states")
    ros.wait_until(lambda: ros.probe.count_publishers("joint_states"))
    ros.wait_until(lambda: process.robot.states.subscribers == 1)
    message = state(1)
    process.robot.states.publish(message)
    ros.wait_until(lambda: outside and process.all_heard(1))
    assert [heard[0] is message for heard in process.heard.values()] == [True, True]
    ros.run_for(0.2)
    assert [len(heard) for heard in process.heard.values()] == [1, 1]
    assert outside.stamps == [1]


def test_a_chain_is_done_in_one_turn_and_timers_get_theirs(ros):
    """A robot that answers each command with a state, for ever, as in lockstep."""

    def step(message):
        process.commands.append(message)
        process.robot.states.publish(state(at(message) + 1))

    process = Process(ros, on_command=step)
    seen_at_tick = []
    process.robot.create_timer(0.01, lambda: seen_at_tick.append(len(process.commands)))
    process.robot.states.publish(state(1))
    ros.wait_until(lambda: len(seen_at_tick) > 5)
    commands = [at(message) for message in process.commands]
    assert commands == list(range(1, len(commands) + 1))
    assert len(set(seen_at_tick)) > 3, "the chain continued between timers"


def test_the_newest_message_wins(ros):
    process = Process(ros)
    for stamp in (1, 2, 3):
        process.robot.states.publish(state(stamp))
    ros.wait_until(lambda: process.all_heard(3))
    assert [[at(m) for m in heard] for heard in process.heard.values()] == [[3], [3]]


def test_a_stranger_is_reported_and_never_obeyed(ros, others):
    process = Process(ros)
    theirs = others.probe.create_publisher(JointState, "joint_states", JOINT_STATES.qos)

    def both_publish():
        theirs.publish(state(1000))
        process.robot.states.publish(state(1))

    watch = process.robot.publisher_watch
    ros.wait_until(lambda: "/joint_states" in watch.rivals, each=both_publish)
    ros.run_for(0.2, each=both_publish)
    for heard in process.heard.values():
        assert {at(message) for message in heard} == {1}


def test_remapped_topics_are_other_topics(ros):
    heard = []
    robot = Part(ros, "robot", JOINT_STATES)
    controller = Part(ros, "controller", on_state=heard.append, remap="joint_states:=/others")
    connect([robot, controller])
    assert not robot.states.listeners
    assert controller.count_subscribers("/others") == 1
