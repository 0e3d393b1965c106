# SPDX-License-Identifier: Apache-2.0
"""The messages and service calls of a scenario's events, published and made in time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Transform, Twist
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.scenario.events import (
    AddObstacle,
    EnableTorque,
    Goal,
    PoseGoal,
    PostureGoal,
    Push,
    RemoveObstacle,
    ServiceEvent,
    TrajectoryGoal,
    TriggerCall,
)
from sim_bridge.scenario.scenario import Scenario
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.pose_trajectory import TrajectoryPoint
from viability_bounds_pkg.ros.messages import pose_message, wrench_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS, is_subscribed, set_stamp

_IN_FLIGHT_MAX = GOAL_QOS.depth - 2
"""Messages sent but not yet reported as received: a reader's queue is that long."""

_SHAPES = {"box": Marker.CUBE, "sphere": Marker.SPHERE, "cylinder": Marker.CYLINDER}


class ScenarioRefused(ArmSafetyError, RuntimeError):
    """Another node refused a message or call of the scenario; the text says which and why."""


class ServiceRequest(NamedTuple):
    """A call of a service."""

    service: str
    kind: Any
    """Service type."""
    content: Any


RESET = ServiceRequest("bullet_node/reset", Trigger, Trigger.Request())
"""Sets the robot to its start configuration."""


class ScheduledMessage(NamedTuple):
    """A message that takes effect at its stamp."""

    topic: str
    content: Any
    header: Header
    """The header in the content that carries the stamp."""
    delay: int
    """Stamp from the scenario's start, ns."""


def to_controller(
    scenario: Scenario, base_frame: str, end_effector_frame: str
) -> list[ScheduledMessage]:
    """Return the goals, in order of time.

    Args:
        scenario: its goals are returned.
        base_frame: of poses.
        end_effector_frame: that poses and trajectories move; of wrenches without a frame.
    """
    return [
        _goal(event, base_frame, end_effector_frame)
        for event in scenario.events
        if isinstance(event, Goal)
    ]


def to_robot(scenario: Scenario, base_frame: str) -> list[ScheduledMessage]:
    """Return pushes, their ends, and obstacles in the base frame, in order of time."""
    pushes = [event for event in scenario.events if isinstance(event, Push)]
    # Ends first: where one push directly follows another, the new one must remain.
    messages = [_push(Push(push.time + push.duration, 0.0, push.link)) for push in pushes]
    messages += map(_push, pushes)
    messages += [
        _obstacle(event, base_frame)
        for event in scenario.events
        if isinstance(event, AddObstacle | RemoveObstacle)
    ]
    return sorted(messages, key=lambda each: each.delay)


def to_service(event: ServiceEvent) -> ServiceRequest:
    """Return the service call of an event."""
    if isinstance(event, EnableTorque):
        return ServiceRequest(
            "controller_node/enable_torque", SetBool, SetBool.Request(data=event.enable)
        )
    if isinstance(event, TriggerCall):
        return ServiceRequest(event.service, Trigger, Trigger.Request())
    return change_parameters(event.node, event.values)


def change_parameters(node: str, values: Any) -> ServiceRequest:
    """Return the call that sets parameters of a node, values by name."""
    parameters = [Parameter(key, value=value).to_parameter_msg() for key, value in values.items()]
    return ServiceRequest(
        f"{node}/set_parameters", SetParameters, SetParameters.Request(parameters=parameters)
    )


def pause(data: bool) -> ServiceRequest:
    """Return the call that pauses or resumes the robot."""
    return ServiceRequest("bullet_node/pause", SetBool, SetBool.Request(data=data))


PAUSES = RESET, pause(False), change_parameters("bullet_node", {})
"""Services of a robot that can be reset and paused."""


def refusals(request: ServiceRequest, response: Any) -> Iterator[str]:
    """Yield the reasons for which a call, or a part of it, was refused."""
    if request.kind is SetParameters:
        for parameter, result in zip(request.content.parameters, response.results, strict=True):
            if not result.successful:
                yield result.reason or f"parameter '{parameter.name}' was not set"
    elif not response.success:
        yield response.message or "no reason was given"


def _delay(time: float) -> int:
    return round(1e9 * time)


def _goal(event: Goal, base_frame: str, end_effector_frame: str) -> ScheduledMessage:
    if isinstance(event, PoseGoal):
        pose = pin.XYZQUATToSE3(np.array([*event.position, *event.orientation]))
        message = pose_message(pose, base_frame)
        topic = "target_pose"
    elif isinstance(event, PostureGoal):
        positions = event.positions
        message = JointState(name=list(positions), position=list(positions.values()))
        topic = "target_posture"
    elif isinstance(event, TrajectoryGoal):
        message = MultiDOFJointTrajectory(
            joint_names=[end_effector_frame],
            points=[_point(point) for point in event.trajectory.points],
        )
        message.header.frame_id = base_frame
        topic = "target_trajectory"
    else:
        message = wrench_message(event.frame or end_effector_frame, event.force, event.torque)
        topic = "target_wrench"
    return ScheduledMessage(topic, message, message.header, _delay(event.time))


def _point(point: TrajectoryPoint) -> MultiDOFJointTrajectoryPoint:
    transform, velocity, acceleration = Transform(), Twist(), Twist()
    p, o = transform.translation, transform.rotation
    p.x, p.y, p.z = point.pose.translation.tolist()
    o.x, o.y, o.z, o.w = pin.Quaternion(point.pose.rotation).coeffs().tolist()
    v, a = velocity.linear, acceleration.linear  # nothing in a scenario file turns at a point
    v.x, v.y, v.z = point.velocity[:3].tolist()
    a.x, a.y, a.z = point.acceleration[:3].tolist()
    message = MultiDOFJointTrajectoryPoint(
        transforms=[transform], velocities=[velocity], accelerations=[acceleration]
    )
    set_stamp(message.time_from_start, _delay(point.time))
    return message


def _push(push: Push) -> ScheduledMessage:
    message = wrench_message(push.link, push.force, push.torque)
    return ScheduledMessage("external_wrench", message, message.header, _delay(push.time))


def _obstacle(event: AddObstacle | RemoveObstacle, base_frame: str) -> ScheduledMessage:
    marker = Marker(action=Marker.DELETE)
    if isinstance(event, RemoveObstacle):
        marker.ns = event.name
    else:
        obstacle = event.obstacle
        marker.ns, marker.type, marker.action = obstacle.name, _SHAPES[obstacle.shape], Marker.ADD
        p, o, s = marker.pose.position, marker.pose.orientation, marker.scale
        p.x, p.y, p.z = obstacle.position.tolist()
        o.x, o.y, o.z, o.w = obstacle.orientation.tolist()
        s.x, s.y, s.z = obstacle.size.tolist()
        marker.color.a = 1.0  # or RViz shows nothing
    marker.header.frame_id = base_frame
    return ScheduledMessage(
        "obstacles", MarkerArray(markers=[marker]), marker.header, _delay(event.time)
    )


class ScheduledPublisher:
    """Publishes messages for one receiver before their time, as its queue permits.

    Args:
        node: publishes them.
        receiver: name of the node that they are for.
        messages: in order of time.
    """

    def __init__(self, node: Node, receiver: str, messages: Sequence[ScheduledMessage]) -> None:
        self._node, self._receiver = node, receiver
        kinds = {message.topic: type(message.content) for message in messages}
        self._publishers = {
            topic: node.create_publisher(kind, topic, GOAL_QOS) for topic, kind in kinds.items()
        }
        self._messages = messages
        self._sent = 0

    def without_subscriber(self) -> list[str]:
        """Return the topics that the receiver does not subscribe to."""
        topics = self._publishers
        return [each for each in topics if not is_subscribed(self._node, each, self._receiver)]

    def proceed(self, first: int, pending: int) -> bool:
        """Publish the messages that the receiver has room for.

        Args:
            first: stamp of the scenario's start, ns.
            pending: number of messages that the receiver reports as waiting for their time.

        Returns:
            Whether it has received all of them.
        """
        portion = self._messages[self._sent : pending + _IN_FLIGHT_MAX]
        for message in portion:
            set_stamp(message.header.stamp, first + message.delay)
            self._publishers[message.topic].publish(message.content)
        self._sent += len(portion)
        return pending >= len(self._messages)


class ScheduledCalls:
    """Calls the services of a scenario when they are due, and others when asked.

    Args:
        node: calls them.
        scenario: its service calls are made.
        others: requests of the other services.
    """

    def __init__(self, node: Node, scenario: Scenario, others: Sequence[ServiceRequest]) -> None:
        self._due = deque(each for each in scenario.events if isinstance(each, ServiceEvent))
        self._clients = {
            request.service: node.create_client(request.kind, request.service)
            for request in (*others, *map(to_service, self._due))
        }

    def without_server(self, unused: Sequence[ServiceRequest]) -> list[str]:
        """Return the services that nobody offers, but for those that are not used."""
        names = {request.service for request in unused}
        clients = self._clients.items()
        return [name for name, each in clients if not (name in names or each.service_is_ready())]

    def call(self, request: ServiceRequest, when: str = "") -> Iterator[str]:
        """Call a service; yield what is waited for until it has answered.

        Raises:
            ScenarioRefused: the call was refused; `when` is part of the text.
        """
        answer = self._clients[request.service].call_async(request.content)
        while not answer.done():
            yield f"calling: there is no answer of {request.service}"
        if reasons := "; ".join(refusals(request, answer.result())):
            raise ScenarioRefused(f"{when}{request.service} refused: {reasons}")

    def next_period(self, dt: int) -> int | None:
        """Return the first period, of `dt` ns, when a call is due; None for none."""
        return math.ceil(1e9 * self._due[0].time / dt - 1e-6) if self._due else None

    def call_due(self, period: int, dt: int) -> Iterator[str]:
        """Make the calls that are due when a period, of `dt` ns, begins; yield as `call`."""
        while (due := self.next_period(dt)) is not None and due <= period:
            event = self._due.popleft()
            yield from self.call(to_service(event), f"at {event.time:g} s: ")
