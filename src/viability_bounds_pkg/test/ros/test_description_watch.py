# SPDX-License-Identifier: Apache-2.0
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from std_msgs.msg import String

from viability_bounds_pkg.ros.messages import Diagnostics
from viability_bounds_pkg.ros.robot_urdf import DescriptionWatch
from viability_bounds_pkg.ros.topics import ROBOT_DESCRIPTION

ARM = "<robot name='arm'><link name='hand'/></robot>"
SAME = "<robot name='arm'>  <!-- of yesterday -->\n  <link name='hand'/>\n</robot>\n"
OTHER = "<robot name='arm'><link name='tool'/></robot>"


def test_a_description_that_changes_is_told_and_reported(ros):
    node = ros.add(Node("arm", context=ros.context))
    watch = DescriptionWatch(node)
    report = DiagnosticStatus.OK, "fine", {}
    told = Diagnostics(node, lambda: report, description=watch)
    robot = ros.talk(String, "robot_description", ROBOT_DESCRIPTION.qos)
    seen = ros.listen(String, "robot_description", ROBOT_DESCRIPTION.qos)

    def publish(text):
        before = len(seen)
        robot.publish(String(data=text))
        ros.wait_until(lambda: len(seen) > before, "the description")
        ros.spin(0.02)

    for text in (ARM, ARM, SAME):
        publish(text)
    assert watch.trouble == ""
    publish(OTHER)
    ros.wait_until(lambda: watch.trouble, "the change")
    assert watch.trouble.startswith("'/robot_description' has changed: restart")
    told.publish()
    ros.wait_until(lambda: "has changed" in ros.reported("arm", "message"), "a report")
    assert ros.diagnostics["arm"]["level"] == DiagnosticStatus.WARN


def test_what_is_no_xml_is_compared_as_it_is(ros):
    node = ros.add(Node("arm", context=ros.context))
    watch = DescriptionWatch(node)
    robot = ros.talk(String, "robot_description", ROBOT_DESCRIPTION.qos)
    robot.publish(String(data=ARM))
    ros.wait_until(lambda: watch._known, "the description")
    robot.publish(String(data="<robot"))
    ros.wait_until(lambda: watch.trouble, "the change")
