# SPDX-License-Identifier: Apache-2.0
from copy import copy
from types import SimpleNamespace

import pytest
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from viability_bounds_pkg.ros import publisher_watch
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch


class Log:
    """Counts what is logged."""

    def __init__(self, node, monkeypatch):
        self.warnings, self.infos = [], []
        monkeypatch.setattr(node, "get_logger", lambda: self)

    def warning(self, text):
        self.warnings.append(text)

    def info(self, text):
        self.infos.append(text)


@pytest.fixture
def watched(ros, monkeypatch):
    """A node in /left that publishes a topic and watches it."""
    node = ros.add(Node("arm", context=ros.context, namespace="left"))
    log = Log(node, monkeypatch)
    node.create_publisher(String, "command", 1)
    return node, PublisherWatch(node, ["command"]), log


def rival_of(ros, name="rival", namespace="left", topic="command"):
    rival = ros.add(Node(name, context=ros.context, namespace=namespace))
    rival.create_publisher(String, topic, 1)
    return rival


def test_a_second_publisher_is_told_once_and_once_when_it_is_gone(ros, watched):
    _, watch, log = watched
    rival = rival_of(ros)
    ros.wait_until(lambda: watch.rivals, "the rival")
    assert watch.rivals == {"/left/command": ("/left/arm", "/left/rival")}
    assert watch.trouble == "2 publishers of '/left/command': /left/arm, /left/rival"
    for _ in range(5):
        watch.look()
    (text,) = log.warnings
    assert text.startswith("'/left/command' has 2 publishers: /left/arm, /left/rival; stop ")
    ros.stop(rival)
    ros.wait_until(lambda: not watch.rivals, "its end")
    watch.look()
    assert log.infos == ["'/left/command' has no second publisher any more"]
    assert watch.trouble == ""
    rival_of(ros, "next")
    ros.wait_until(lambda: watch.rivals, "the next one")
    assert len(log.warnings) == 2


def test_messages_are_obeyed_while_there_is_one_publisher(ros, watched):
    """Not from the moment on at which the graph has a second one, until it leaves."""
    node, watch, _ = watched
    topic = "/left/command"
    ros.wait_until(lambda: node.count_publishers(topic) == 1, "its own")
    assert watch.admits(topic)
    rival = rival_of(ros)
    ros.wait_until(lambda: node.count_publishers(topic) == 2, "the rival")
    assert not watch.admits(topic)
    ros.wait_until(lambda: watch.rivals, "its name", each=lambda: watch.admits(topic))
    assert not watch.admits(topic)
    ros.stop(rival)
    ros.wait_until(lambda: node.count_publishers(topic) == 1, "its end")
    assert watch.admits(topic)
    # One that was killed is listed for a while beside the one that has been started instead.
    rival_of(ros, "arm")
    ros.wait_until(lambda: node.count_publishers(topic) == 2, "the next one")
    ros.wait_until(lambda: watch.admits(topic), "it to be heard")


def test_rivals_on_two_topics_at_once_are_both_told_by_their_first_message(ros, monkeypatch):
    node = ros.add(Node("arm", context=ros.context, namespace="left"))
    topics = ["command", "state"]
    for topic in topics:
        node.create_publisher(String, topic, 1)
    watch = PublisherWatch(node, topics)
    monkeypatch.setattr(publisher_watch, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    for topic in topics:
        rival_of(ros, f"rival_{topic}", topic=topic)
    for topic in topics:
        ros.hears(f"/left/{topic}", 2)
    assert [watch.admits(f"/left/{topic}") for topic in topics] == [False, False]


def test_a_rival_that_follows_another_at_once_is_told_by_its_first_message(
    ros, watched, monkeypatch
):
    node, watch, _ = watched
    topic = "/left/command"
    monkeypatch.setattr(publisher_watch, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    for name in ("first", "second"):
        rival = rival_of(ros, name)
        ros.hears(topic, 2)
        assert not watch.admits(topic)
        ros.stop(rival)
        ros.wait_until(lambda: node.count_publishers(topic) == 1, "its end")
        assert watch.admits(topic)


def test_other_namespaces_and_topics_are_no_rivals(ros, watched):
    _, watch, log = watched
    rival_of(ros, namespace="right")
    rival_of(ros, "other", topic="remark")
    ros.hears("/right/command")
    ros.hears("/left/remark")
    watch.look()
    assert not watch.rivals
    assert not log.warnings


def test_a_publisher_without_a_name_is_told_a_moment_later(ros, watched, monkeypatch):
    node, _, log = watched
    rival_of(ros)
    ros.hears("/left/command", 2)
    found = node.get_publishers_info_by_topic("/left/command")
    for endpoint in found:
        if endpoint.node_name == "rival":
            endpoint.node_name = "_NODE_NAME_UNKNOWN_"
            endpoint.node_namespace = "_NODE_NAMESPACE_UNKNOWN_"
    monkeypatch.setattr(node, "get_publishers_info_by_topic", lambda topic: found)
    log.warnings.clear()
    watch = PublisherWatch(node, ["command"])
    watch.look()
    assert not watch.rivals
    now = publisher_watch.time.monotonic()
    monkeypatch.setattr(publisher_watch.time, "monotonic", lambda: now + 1.5)
    watch.look()
    assert len(watch.rivals["/left/command"]) == 2
    assert len(log.warnings) == 1
    # It was killed and started again: its name comes late, and is that of the other one.
    for endpoint in found:
        endpoint.node_name, endpoint.node_namespace = "arm", "/left"
    assert watch.admits("/left/command")
    assert not watch.rivals
    assert log.infos == ["'/left/command' is published by /left/arm alone"]


def test_a_second_one_of_the_same_name_is_told_when_it_stays(ros, watched, monkeypatch):
    _, watch, log = watched
    rival_of(ros, "arm")
    ros.hears("/left/command", 2)
    watch.look()
    assert not watch.rivals
    now = publisher_watch.time.monotonic()
    monkeypatch.setattr(publisher_watch.time, "monotonic", lambda: now + 30.0)
    watch.look()
    assert watch.rivals == {"/left/command": ("/left/arm", "/left/arm")}
    assert len(log.warnings) == 1


def test_one_that_is_killed_and_started_again_and_again_is_heard(ros, watched, monkeypatch):
    """The graph forgets what was killed after 20 s."""
    node, watch, log = watched
    ros.wait_until(lambda: node.count_publishers("/left/command") == 1, "its own")
    (own,) = node.get_publishers_info_by_topic("/left/command")
    now, lives = publisher_watch.time.monotonic(), 10
    monkeypatch.setattr(publisher_watch.time, "monotonic", lambda: now)
    monkeypatch.setattr(node, "count_publishers", lambda topic: 3)

    def life(number):
        copied = copy(own)
        copied.endpoint_gid = [number] * 16
        return copied

    for number in range(lives):
        listed = [life(each) for each in range(max(0, number - 2), number + 1)]
        monkeypatch.setattr(node, "get_publishers_info_by_topic", lambda topic, now=listed: now)
        for _ in range(8):
            now += 1.0
            watch.look()
            assert not watch.rivals, f"{number}"
    now += 20.0  # the last ones stay: they are several
    watch.look()
    assert len(watch.rivals["/left/command"]) == 3
    assert len(log.warnings) == 1


def test_a_missing_estimator_is_told_once_it_has_been_missing_for_some_looks(ros, monkeypatch):
    node = ros.add(Node("arm", context=ros.context, namespace="left"))
    log = Log(node, monkeypatch)
    watch = PublisherWatch(node, [], needs_estimates=True)
    content = PublisherWatch(node, [])

    def look():
        for _ in range(4):
            watch.look()
            content.look()

    look()
    assert watch.trouble == ""  # the robot is not there either
    robot = node.create_publisher(JointState, "joint_states", 1)
    ros.wait_until(lambda: node.count_publishers("joint_states"), "the robot")
    watch.look()
    assert watch.trouble == ""  # the estimator may come a moment later
    look()
    missing = "'/left/joint_states' has a publisher, '/left/estimated_joint_states' has none"
    assert watch.trouble == missing
    assert content.trouble == ""
    (text,) = log.warnings
    assert text == f"{missing}: start estimator_node, or set use_estimated_states to false"
    estimator = node.create_publisher(JointState, "estimated_joint_states", 1)
    ros.wait_until(lambda: node.count_publishers("estimated_joint_states"), "the estimator")
    look()
    assert watch.trouble == ""
    node.destroy_publisher(estimator)
    ros.wait_until(lambda: not node.count_publishers("estimated_joint_states"), "its end")
    look()
    assert watch.trouble == missing
    assert len(log.warnings) == 2
    node.destroy_publisher(robot)
