# SPDX-License-Identifier: Apache-2.0
"""Reads the URDF that the parameter ``robot_description`` names, or that comes from its topic."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.configuration import TOPIC, RobotConfiguration, check_with_urdf
from viability_bounds_pkg.robot.files import RobotDescriptionError, check_urdf
from viability_bounds_pkg.ros.runtime import make_executor
from viability_bounds_pkg.ros.topics import ROBOT_DESCRIPTION

_TOPIC_TIMEOUT = 10.0


def robot_urdf(config: RobotConfiguration, node: Node | None = None) -> str:
    """Return the text of the URDF that ``robot_description`` names.

    Args:
        config: which robot it is.
        node: not in an executor yet; listens if the URDF is to come from the topic.

    Raises:
        SettingError: there is none.
    """
    source = config.robot_description
    if source != TOPIC or node is None:
        return config.read_urdf()
    try:
        text = urdf_from_topic(node)
        check_urdf(text, "robot_description")
    except RobotDescriptionError as error:
        raise SettingError("robot_description", source, f"a URDF ({error})") from error
    return text


def warn_of_unusual(node: Node, config: RobotConfiguration, urdf: str) -> None:
    """Log what of the parameters is unusual for a URDF.

    Raises:
        SettingError: a joint that the URDF does not have, or angles that must be degrees.
    """
    for line in check_with_urdf(config, urdf):
        node.get_logger().warning(line)


def urdf_from_topic(node: Node) -> str:
    """Return the text that the topic ``robot_description`` carries.

    Args:
        node: not in an executor yet.

    Raises:
        RobotDescriptionError: nothing on the topic.
    """
    received: Future = Future()

    def take(message: String) -> None:
        if not received.done():
            received.set_result(message.data)

    subscription = ROBOT_DESCRIPTION.subscription(node, take)
    node.get_logger().info(f"waiting for a URDF on {subscription.topic_name}")
    executor = make_executor(node.context)
    executor.add_node(node)
    executor.spin_until_future_complete(received, timeout_sec=_TOPIC_TIMEOUT)
    executor.remove_node(node)
    node.destroy_subscription(subscription)
    if not received.done():
        raise RobotDescriptionError(f"nothing on the topic for {_TOPIC_TIMEOUT:g} s")
    return str(received.result())
