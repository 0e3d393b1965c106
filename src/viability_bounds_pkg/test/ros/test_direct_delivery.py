# SPDX-License-Identifier: Apache-2.0
"""Messages between nodes of one process, with other publishers and subscribers around it."""

import pytest
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState

from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.testing.ros_harness import RosHarness, joint_state

JOINTS = ["a", "b"]


def state(stamp):
    return joint_state(JOINTS, stamp, (1.0, 2.0), (0.0, 0.0))


class Process:
    """Nodes with one direct delivery: a robot, two that hear its states, one that answers."""

    def __init__(self, ros, *, robot=True):
        self.ros = ros
        self.delivery = DirectDelivery()
        self.heard = {"first": [], "second": []}
        self.commands = []
        self.states = None
        if robot:
            node = self.node("robot")
            self.states = JOINT_STATES.publisher(node)
            JOINT_COMMANDS.subscription(node, self.commands.append)
        for name, heard in self.heard.items():
            JOINT_STATES.subscription(self.node(name), heard.append)
        self.answers = JOINT_COMMANDS.publisher(self.node("answering"))

    def node(self, name):
        node = Node(name, context=self.ros.context)
        node.direct_delivery = self.delivery
        return self.ros.add(node)

    def both_heard(self, stamp):
        return all(stamp in map(at, heard) for heard in self.heard.values())


def at(message):
    return stamp_to_ns(message.header.stamp)


def test_all_get_the_same_object_once_and_others_get_it_too(ros):
    process = Process(ros)
    outside = ros.listen(JointState, "joint_states")
    ros.wait_until(lambda: process.states.has_others)
    message = state(1)
    process.states.publish(message)
    ros.wait_until(lambda: outside and process.both_heard(1))
    assert [heard[0] is message for heard in process.heard.values()] == [True, True]
    ros.run_for(0.2)
    assert [len(heard) for heard in process.heard.values()] == [1, 1]
    assert outside.stamps == [1]


def test_who_looks_on_gets_a_copy_when_the_command_has_come(ros, monkeypatch):
    """However long it takes to publish it; to a robot elsewhere the command goes first."""
    process = Process(ros)
    course = []
    JOINT_STATES.subscription(process.node("controller"), process.answers.publish)
    JOINT_COMMANDS.subscription(process.node("stepping"), lambda _: course.append("command taken"))
    outside = [ros.listen(JointState, "joint_states"), ros.listen(JointState, "joint_commands")]
    ros.wait_until(lambda: process.states.has_others and process.answers.has_others)
    publish = Publisher.publish

    def noted(publisher, message):
        course.append(f"copy of {publisher.topic.strip('/')}")
        publish(publisher, message)

    monkeypatch.setattr(Publisher, "publish", noted)
    process.states.publish(state(1))
    ros.wait_until(lambda: all(outside))
    assert course == ["command taken", "copy of joint_commands", "copy of joint_states"]
    assert [heard.stamps for heard in outside] == [[1], [1]]


def test_a_chain_is_done_in_one_turn_and_timers_get_theirs(ros):
    """A robot that answers each command with a state, for ever, as in lockstep."""
    process = Process(ros)
    ticks, seen_at_tick = [], []
    node = process.node("timed")
    node.create_timer(0.01, lambda: (ticks.append(1), seen_at_tick.append(len(process.commands))))

    def answer(message):
        process.answers.publish(message)

    def step(message):
        process.states.publish(state(at(message) + 1))

    JOINT_STATES.subscription(process.node("controller"), answer)
    JOINT_COMMANDS.subscription(process.node("stepping"), step)
    ros.spin()
    process.states.publish(state(1))
    ros.wait_until(lambda: len(ticks) > 5)
    commands = [at(message) for message in process.commands]
    assert commands == list(range(1, len(commands) + 1))
    assert len(set(seen_at_tick)) > 3, "the chain went on between timers"


def test_the_newest_message_wins_as_with_the_middleware(ros):
    process = Process(ros)
    ros.spin()
    for stamp in (1, 2, 3):
        process.states.publish(state(stamp))
    ros.wait_until(lambda: process.both_heard(3))
    assert [[at(m) for m in heard] for heard in process.heard.values()] == [[3], [3]]


@pytest.fixture
def others(ros):
    """Another process: another participant in the same domain."""
    harness = RosHarness(ros.domain)
    yield harness
    harness.close()


def publish_until(publisher, condition, *harnesses):
    """Publish states with growing stamps from 1000 on until a condition holds."""
    stamps = iter(range(1000, 100_000))
    harnesses[0].wait_until(
        condition,
        each=lambda: (publisher.publish(state(next(stamps))), harnesses[-1].spin()),
    )


def test_another_publisher_is_heard_as_ever_until_it_is_gone(ros, others):
    process = Process(ros)
    ros.spin()
    theirs = others.talk(JointState, "joint_states")
    publish_until(theirs, lambda: all(process.heard.values()), ros, others)
    for heard in process.heard.values():
        heard.clear()
    # The process' own messages come by the middleware now: other objects, still once each.
    own = state(1)
    process.states.publish(own)
    ros.wait_until(lambda: process.both_heard(1))
    ros.run_for(0.1)
    for heard in process.heard.values():
        assert [at(m) for m in heard] == [1]
        assert heard[0] is not own
    others.probe.destroy_publisher(theirs)
    stamps = iter(range(2, 1000))
    sent = []

    def send():
        others.spin()  # which destroys it
        sent.append(state(next(stamps)))
        process.states.publish(sent[-1])

    second = process.heard["second"]
    ros.wait_until(
        lambda: second and any(second[-1] is message for message in sent),
        "direct delivery",
        each=send,
    )
    received = [at(message) for message in process.heard["first"]]
    assert received == sorted(set(received)), "none came twice"


def test_one_subscription_reads_for_all_where_the_robot_is_elsewhere(ros, others):
    process = Process(ros, robot=False)
    ros.spin()
    theirs = others.talk(JointState, "joint_states")
    publish_until(theirs, lambda: all(process.heard.values()), ros, others)
    first, second = process.heard.values()
    assert all(a is b for a, b in zip(first, second, strict=True))


def test_a_node_that_goes_takes_its_subscriptions_along(ros):
    process = Process(ros)
    outside = ros.probe.create_publisher(JointState, "joint_states", JOINT_STATES.qos)
    ros.wait_until(lambda: outside.get_subscription_count() == 2)
    for stream in process.delivery._streams.values():
        for node, *_ in list(stream.subscriptions):
            process.delivery.leave(node)
            ros.stop(node)
    ros.wait_until(lambda: outside.get_subscription_count() == 0)


def test_it_tells_whether_messages_can_only_be_those_of_one_publisher_here(ros, others):
    process = Process(ros)
    topic = "/joint_states"
    assert process.delivery.within(topic)
    assert not process.delivery.within("/joint_states_of_others")
    theirs = others.talk(JointState, "joint_states")
    ros.wait_until(lambda: not process.delivery.within(topic))
    others.probe.destroy_publisher(theirs)
    ros.wait_until(lambda: process.delivery.within(topic), each=others.spin)
    JOINT_STATES.publisher(process.node("second_robot"))  # both deliver directly
    assert not process.delivery.within(topic)
