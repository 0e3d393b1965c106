# SPDX-License-Identifier: Apache-2.0
"""Topics and services: each declared once, for its nodes and for the reference pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from viability_bounds_pkg.ros.runtime import (
    CONTROL_QOS,
    GOAL_QOS,
    LATCHED_QOS,
    NEWEST_QOS,
    STATUS_QOS,
)

USER = "user"
"""Stands for nodes of others."""

BEST_EFFORT = "the quality of service of a publisher is best effort; allowed: reliable"
"""Why nothing comes from a publisher."""


@dataclass(frozen=True)
class Topic:
    """A topic.

    Attributes:
        name: as the nodes use it.
        message: its type.
        qos: that this project's nodes subscribe with.
        source: nodes that publish it.
        sink: nodes that subscribe to it.
        meaning: of its messages, with units.
    """

    name: str
    message: type
    qos: QoSProfile
    source: tuple[str, ...]
    sink: tuple[str, ...]
    meaning: str

    @property
    def offered(self) -> QoSProfile:
        """Quality of service of publishers: reliable subscribers are to hear streams, too."""
        return NEWEST_QOS if self.qos is CONTROL_QOS else self.qos

    def publisher(self, node: Node, name: str | None = None) -> Publisher:
        """Return a publisher; `name` is for topics that a parameter names."""
        return node.create_publisher(self.message, name or self.name, self.offered)

    def subscription(
        self,
        node: Node,
        callback: Callable[[Any], None],
        refuse: Callable[[str], None] | None = None,
    ) -> Subscription:
        """Return a subscription.

        Args:
            node: subscribes.
            callback: called with each message.
            refuse: called with the reason when there is a publisher whose messages cannot come,
                as it is best effort where the subscription is reliable; None leaves it to rclpy,
                which logs it.
        """
        events = SubscriptionEventCallbacks()
        if refuse is not None:
            events.incompatible_qos = lambda _: refuse(BEST_EFFORT)
        return node.create_subscription(
            self.message, self.name, callback, self.qos, event_callbacks=events
        )


@dataclass(frozen=True)
class OfferedService:
    """A service.

    Attributes:
        name: without that of the node.
        kind: its type.
        server: node that offers it.
        meaning: of a call.
    """

    name: str
    kind: type
    server: str
    meaning: str

    def serve(self, node: Node, callback: Callable[[Any, Any], Any]) -> Service:
        """Offer the service."""
        return node.create_service(self.kind, f"~/{self.name}", callback)


JOINT_STATES = Topic(
    "joint_states",
    JointState,
    CONTROL_QOS,
    ("bullet_node", "franka_node"),
    ("bounds_node", "controller_node", "estimator_node", "simulated_fr3", "scenario_node"),
    "positions, rad, and velocities, rad/s; `effort` is the motors' torque, N m; any order; "
    "further joints are ignored",
)
ESTIMATED_JOINT_STATES = Topic(
    "estimated_joint_states",
    JointState,
    CONTROL_QOS,
    ("estimator_node",),
    ("bounds_node", "controller_node"),
    "the state expected when the command for it begins to act; only with `use_estimated_states`",
)
ACCELERATION_LIMITS = Topic(
    "acceleration_limits",
    JointTrajectory,
    CONTROL_QOS,
    ("bounds_node",),
    ("controller_node", "scenario_node"),
    "`points[0].accelerations` lower, `points[1].accelerations` upper, rad/s²",
)
JOINT_COMMANDS = Topic(
    "joint_commands",
    JointState,
    CONTROL_QOS,
    ("controller_node",),
    ("bullet_node", "franka_node", "estimator_node", "scenario_node"),
    "`effort`, N m; or `position` without effort: position control by the drives",
)
COMMANDED_ACCELERATIONS = Topic(
    "commanded_accelerations",
    JointTrajectory,
    CONTROL_QOS,
    ("controller_node",),
    ("bounds_node",),
    "only where `bounds_node` has `jerk_max`: `points[0].accelerations`, rad/s², that the command "
    "with the same stamp stands for",
)
FT_WRENCH = Topic(
    "ft_wrench",
    WrenchStamped,
    CONTROL_QOS,
    ("bullet_node",),
    ("controller_node", "scenario_node"),
    "what the wrist sensor measures, tool and bias included, in the axes of `ft_frame`, N and N"
    " m; positive acts on the arm; a stamp that is repeated is no measurement",
)
PAYLOAD = Topic(
    "payload",
    InertiaStamped,
    GOAL_QOS,
    (USER,),
    ("controller_node", "estimator_node", "franka_node"),
    "what the arm carries from now on besides its own links: mass, kg, centre, m, and moments "
    "about it, kg m², in the axes of the link `frame_id`; a mass of 0: nothing",
)
LIMIT_DISTANCES = Topic(
    "limit_distances",
    JointState,
    STATUS_QOS,
    ("bounds_node",),
    (USER,),
    "distance of each joint to its limits of position, rad, speed, rad/s, and torque, N m; "
    "negative outside; 20 times a second",
)
SLOW_JOINT_STATES = Topic(
    "slow/joint_states",
    JointState,
    NEWEST_QOS,
    ("bounds_node",),
    ("viewer_node", "moveit_node", USER),
    "copy of `joint_states`, 20 times a second, for displays and slow networks",
)
SLOW_ACCELERATION_LIMITS = Topic(
    "slow/acceleration_limits",
    JointTrajectory,
    NEWEST_QOS,
    ("bounds_node",),
    ("viewer_node", USER),
    "copy of `acceleration_limits`, likewise",
)
ROBOT_DESCRIPTION = Topic(
    "robot_description",
    String,
    LATCHED_QOS,
    ("bullet_node", "franka_node"),
    ("estimator_node", "controller_node", "viewer_node"),
    "the URDF; read at start where the parameter `robot_description` is `topic`",
)
DIAGNOSTICS = Topic(
    "/diagnostics",
    DiagnosticArray,
    STATUS_QOS,
    (
        "bounds_node",
        "estimator_node",
        "controller_node",
        "bullet_node",
        "franka_node",
        "simulated_fr3",
    ),
    ("scenario_node", "viewer_node"),
    "mode and reason, refused messages, margins, latency, closest approach; a status has the "
    "name of its node, as `left/bullet_node`",
)


def state_topic(estimated: bool) -> Topic:
    """Return the topic of the joint states that a node works on: estimated ones, or reported."""
    return ESTIMATED_JOINT_STATES if estimated else JOINT_STATES
