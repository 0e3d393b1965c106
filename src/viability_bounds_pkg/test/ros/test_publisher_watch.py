# SPDX-License-Identifier: Apache-2.0
import pytest
from rclpy.node import Node
from std_msgs.msg import String

from viability_bounds_pkg.ros.publisher_watch import PublisherWatch

TOPIC = "/left/command"


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
    watch = PublisherWatch(node)
    watch.add(TOPIC)
    ros.wait_until(lambda: node.count_publishers(TOPIC) == 1, "its own")
    return node, watch, log


def rival_of(ros, name="rival", namespace="left", topic="command"):
    rival = ros.add(Node(name, context=ros.context, namespace=namespace))
    rival.create_publisher(String, topic, 1)
    return rival


def test_a_second_publisher_is_told_once_and_once_when_it_is_gone(ros, watched):
    _, watch, log = watched
    rival = rival_of(ros)
    ros.wait_until(lambda: watch.rivals, "the rival")
    assert watch.rivals == {TOPIC: ("/left/arm", "/left/rival")}
    assert watch.trouble == "2 publishers of '/left/command': /left/arm, /left/rival"
    for _ in range(5):
        watch.check()
    (text,) = log.warnings
    assert text.startswith("'/left/command' has 2 publishers: /left/arm, /left/rival; stop ")
    ros.stop(rival)
    ros.wait_until(lambda: not watch.rivals, "its end")
    watch.check()
    assert log.infos == ["'/left/command' has no second publisher any more"]
    assert watch.trouble == ""
    rival_of(ros, "next")
    ros.wait_until(lambda: watch.rivals, "the next one")
    assert len(log.warnings) == 2


@pytest.mark.parametrize("name", ["rival", "arm"])
def test_messages_are_obeyed_while_there_is_one_publisher(ros, watched, name):
    """Not from the first message after which the graph has a second one, until it leaves."""
    node, watch, log = watched
    assert watch.admits(TOPIC)
    assert not log.infos
    rival = rival_of(ros, name)
    ros.wait_until(lambda: node.count_publishers(TOPIC) == 2, "the rival")
    assert not watch.admits(TOPIC)
    assert watch.rivals == {TOPIC: ("/left/arm", f"/left/{name}")}
    ros.stop(rival)
    ros.wait_until(lambda: node.count_publishers(TOPIC) == 1, "its end")
    assert watch.admits(TOPIC)
    assert not watch.rivals


def test_other_namespaces_and_topics_are_no_rivals(ros, watched):
    _, watch, log = watched
    rival_of(ros, namespace="right")
    rival_of(ros, "other", topic="remark")
    ros.hears("/right/command")
    ros.hears("/left/remark")
    watch.check()
    assert watch.admits(TOPIC)
    assert not watch.rivals
    assert not log.warnings
