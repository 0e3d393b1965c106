# SPDX-License-Identifier: Apache-2.0
"""Topics and services: each declared once, for its nodes and for the reference pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from viability_bounds_pkg.ros.runtime import CONTROL_QOS, LATCHED_QOS, SLOW_QOS, STATUS_QOS

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
        qos: that this project's nodes publish and subscribe with.
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

    def publisher(self, node: Node, name: str | None = None) -> Publisher:
        """Return a publisher; `name` is for topics that a parameter names."""
        return node.create_publisher(self.message, name or self.name, self.qos)

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
    ("bullet_node",),
    ("bounds_node", "controller_node", "estimator_node", "scenario_node"),
    "positions, rad, and velocities, rad/s; `effort` is the torque of the motors, N m; joints in "
    "any order, further joints are ignored; the stamp names the control step; `bullet_node` sends "
    "the movable joints that are locked, too",
)
ESTIMATED_JOINT_STATES = Topic(
    "estimated_joint_states",
    JointState,
    CONTROL_QOS,
    ("estimator_node",),
    ("bounds_node", "controller_node"),
    "positions, rad, and velocities, rad/s, expected at the instant when the command that answers "
    "them begins to act; `effort` and stamp are those of the joint state they are made of; only "
    "where `use_estimated_states` is set",
)
ACCELERATION_LIMITS = Topic(
    "acceleration_limits",
    JointTrajectory,
    CONTROL_QOS,
    ("bounds_node",),
    ("controller_node", "scenario_node"),
    "`points[0].accelerations` lower, `points[1].accelerations` upper, rad/s²; stamp of the state "
    "they answer",
)
JOINT_COMMANDS = Topic(
    "joint_commands",
    JointState,
    CONTROL_QOS,
    ("controller_node",),
    ("bullet_node", "estimator_node", "scenario_node"),
    "`effort` in N m; or `position` (and `velocity`) without effort: position control by the "
    "drives; stamp of the state they answer",
)
FT_WRENCH = Topic(
    "ft_wrench",
    WrenchStamped,
    CONTROL_QOS,
    ("bullet_node",),
    ("controller_node", "scenario_node"),
    "what the wrist's sensor measures, tool and bias included, in the axes of `ft_frame`, N and "
    "N m; positive is what acts on the arm; only where `ft_frame` is set",
)
LIMIT_DISTANCES = Topic(
    "limit_distances",
    JointState,
    STATUS_QOS,
    ("bounds_node",),
    (USER,),
    "by how much joints are inside the limits of `bounds_node`, negative outside, in the fields "
    "of a joint state: `position` to the nearer of position_min and position_max, rad, .inf "
    "without them; `velocity` to velocity_max, rad/s; `effort` from the motors' torque to "
    "torque_max, N m, where both are known; 20 times a second, silent when the robot is; stamp of "
    "the joint state",
)
SLOW_JOINT_STATES = Topic(
    "slow/joint_states",
    JointState,
    SLOW_QOS,
    ("bounds_node",),
    ("viewer_node", "moveit_node", USER),
    "the joint state that `bounds_node` answered last, 20 times a second, silent when the robot "
    "is: for who looks on, or is connected by a slow network",
)
SLOW_ACCELERATION_LIMITS = Topic(
    "slow/acceleration_limits",
    JointTrajectory,
    SLOW_QOS,
    ("bounds_node",),
    ("viewer_node", USER),
    "the last `acceleration_limits`, as `slow/joint_states`",
)
ROBOT_DESCRIPTION = Topic(
    "robot_description",
    String,
    LATCHED_QOS,
    ("bullet_node",),
    ("estimator_node", "controller_node", "viewer_node"),
    "the URDF; read at start where the parameter `robot_description` is `topic`",
)
DIAGNOSTICS = Topic(
    "/diagnostics",
    DiagnosticArray,
    STATUS_QOS,
    ("bounds_node", "estimator_node", "controller_node", "bullet_node"),
    ("scenario_node", "viewer_node"),
    "mode and why, refused messages by reason, margins, latency, solver, closest approach; the "
    "name of a status is that of its node with the namespace, as in `left/bullet_node`",
)


def state_topic(estimated: bool) -> Topic:
    """Return the topic of the joint states that a node works on: estimated ones, or reported."""
    return ESTIMATED_JOINT_STATES if estimated else JOINT_STATES


SHARED_TOPICS = (
    JOINT_STATES,
    ESTIMATED_JOINT_STATES,
    ACCELERATION_LIMITS,
    JOINT_COMMANDS,
    FT_WRENCH,
    LIMIT_DISTANCES,
    SLOW_JOINT_STATES,
    SLOW_ACCELERATION_LIMITS,
    ROBOT_DESCRIPTION,
    DIAGNOSTICS,
)
"""Topics between nodes of different packages, and those of the bounds node."""
