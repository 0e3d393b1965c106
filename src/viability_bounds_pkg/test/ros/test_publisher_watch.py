# SPDX-License-Identifier: Apache-2.0
"""A second publisher of a topic is reported, and nothing is obeyed meanwhile."""

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from viability_bounds_pkg.ros.publisher_watch import PublisherWatch

TOPIC = "/left/command"
TOLD = "'/left/command' has 2 publishers: /left/arm, /left/{}; stop "
GONE = "'/left/command' has no rival publisher any more"


@pytest.fixture
def watch(ros):
    """Of a node in /left that publishes the topic, too."""
    node = ros.add(Node("arm", context=ros.context, namespace="left"))
    node.create_publisher(String, "command", 1)
    watch = PublisherWatch(node)
    watch.add(TOPIC)
    ros.wait_until(lambda: node.count_publishers(TOPIC) == 1, "its own")
    return watch


def rival_of(ros, name="rival", namespace="left", topic="command"):
    rival = ros.add(Node(name, context=ros.context, namespace=namespace))
    rival.create_publisher(String, topic, 1)
    return rival


def test_a_second_publisher_is_told_once_and_once_when_it_is_gone(ros, watch, capfd):
    rival = rival_of(ros)
    ros.wait_until(lambda: watch.rivals, "the rival")
    for _ in range(5):
        watch.check()
    assert watch.trouble == "2 publishers of '/left/command': /left/arm, /left/rival"
    assert capfd.readouterr().err.count(TOLD.format("rival")) == 1
    ros.stop(rival)
    ros.wait_until(lambda: not watch.rivals, "its end")
    watch.check()
    assert capfd.readouterr().err.count(GONE) == 1
    assert watch.trouble == ""
    rival_of(ros, "next")
    ros.wait_until(lambda: watch.rivals, "the next one")
    assert TOLD.format("next") in capfd.readouterr().err


@pytest.mark.parametrize("name", ["rival", "arm"])
def test_messages_are_obeyed_while_there_is_one_publisher(ros, watch, name):
    """Also where a second one has the same name."""
    assert watch.admits(TOPIC)
    rival = rival_of(ros, name)
    ros.wait_until(lambda: not watch.admits(TOPIC), "the rival")
    assert watch.rivals == {TOPIC: ("/left/arm", f"/left/{name}")}
    ros.stop(rival)
    ros.wait_until(lambda: watch.admits(TOPIC), "its end")
    assert not watch.rivals


def test_other_namespaces_and_topics_are_no_rivals(ros, watch):
    rival_of(ros, namespace="right")
    rival_of(ros, "other", topic="remark")
    ros.hears("/right/command")
    ros.hears("/left/remark")
    watch.check()
    assert watch.admits(TOPIC)
    assert not watch.rivals


def test_a_publisher_of_something_else_does_not_count_until_their_number_changes(ros, watch):
    gripper = rival_of(ros, "gripper")
    ros.wait_until(lambda: not watch.admits(TOPIC), "the gripper")
    assert not watch.admits(TOPIC, of_other=True)
    assert watch.admits(TOPIC)
    assert not watch.trouble
    other = PublisherWatch(ros.probe)  # of a node that does not read the messages itself
    other.add(TOPIC)
    other.check()
    assert other.trouble
    other.share(watch)
    other.check()
    assert not other.trouble
    rival = rival_of(ros)
    ros.wait_until(lambda: not watch.admits(TOPIC), "the rival")
    ros.stop(gripper)
    ros.wait_until(lambda: ros.probe.count_publishers(TOPIC) == 2, "its end")
    assert not watch.admits(TOPIC)  # it may be the rival that is left
    ros.stop(rival)
    ros.wait_until(lambda: watch.admits(TOPIC), "the end")
