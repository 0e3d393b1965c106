"""What a scenario's events are on topics and at services."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped, Transform, Twist, WrenchStamped
from rcl_interfaces.srv import SetParameters
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
from sim_bridge.scenario.pose_path import PathPoint
from sim_bridge.scenario.scenario import Scenario
from viability_bounds_pkg.ros.runtime import set_stamp

_NOTHING = (0.0, 0.0, 0.0)
_SHAPES = {"box": Marker.CUBE, "sphere": Marker.SPHERE, "cylinder": Marker.CYLINDER}


class Request(NamedTuple):
    """A call of a service."""

    service: str
    kind: Any
    content: Any


RESET = Request("bullet_node/reset", Trigger, Trigger.Request())
"""Puts the robot at its start."""


class Letter(NamedTuple):
    """A message, where it goes, and when it is to take effect."""

    topic: str
    message: Any
    header: Header
    """Where in the message its stamp is."""
    delay: int
    """From the scenario's beginning, ns."""


def to_controller(scenario: Scenario, base_frame: str, end_effector_frame: str) -> list[Letter]:
    """Return the goals, in order of time.

    Args:
        scenario: whose goals.
        base_frame: of poses.
        end_effector_frame: what they move; of wrenches that name no frame.
    """
    return [
        _goal(event, base_frame, end_effector_frame)
        for event in scenario.events
        if isinstance(event, Goal)
    ]


def to_robot(scenario: Scenario, base_frame: str) -> list[Letter]:
    """Return pushes, their ends, and obstacles in the base frame, in order of time."""
    pushes = [event for event in scenario.events if isinstance(event, Push)]
    # Ends first: where one push follows another at once, that which begins is to stay.
    letters = [_push(push, push.time + push.duration, _NOTHING, _NOTHING) for push in pushes]
    letters += [_push(push, push.time, push.force, push.torque) for push in pushes]
    letters += [
        _obstacle(event, base_frame)
        for event in scenario.events
        if isinstance(event, AddObstacle | RemoveObstacle)
    ]
    return sorted(letters, key=lambda letter: letter.delay)


def to_service(event: ServiceEvent) -> Request:
    """Return the call that an event stands for."""
    if isinstance(event, EnableTorque):
        return Request(
            "controller_node/enable_torque", SetBool, SetBool.Request(data=event.enable)
        )
    if isinstance(event, TriggerCall):
        return Request(event.service, Trigger, Trigger.Request())
    return change_parameters(event.node, event.values)


def change_parameters(node: str, values: Any) -> Request:
    """Return the call that sets parameters of a node, values by name."""
    parameters = [Parameter(key, value=value).to_parameter_msg() for key, value in values.items()]
    return Request(
        f"{node}/set_parameters", SetParameters, SetParameters.Request(parameters=parameters)
    )


def pause(data: bool) -> Request:
    """Return the call that pauses the robot, or lets it go on."""
    return Request("bullet_node/pause", SetBool, SetBool.Request(data=data))


def refusals(request: Request, response: Any) -> Iterator[str]:
    """Return why a call, or parts of it, were refused; nothing if they were not."""
    if request.kind is SetParameters:
        for parameter, result in zip(request.content.parameters, response.results, strict=True):
            if not result.successful:
                yield result.reason or f"parameter '{parameter.name}' was not set"
    elif not response.success:
        yield response.message or "no reason was given"


def _delay(time: float) -> int:
    return round(1e9 * time)


def _goal(event: Goal, base_frame: str, end_effector_frame: str) -> Letter:
    if isinstance(event, PoseGoal):
        message = PoseStamped()
        message.header.frame_id = base_frame
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = event.position
        o.x, o.y, o.z, o.w = event.orientation
        topic = "target_pose"
    elif isinstance(event, PostureGoal):
        positions = event.positions
        message = JointState(name=list(positions), position=list(positions.values()))
        topic = "target_posture"
    elif isinstance(event, TrajectoryGoal):
        message = MultiDOFJointTrajectory(
            joint_names=[end_effector_frame], points=[_point(point) for point in event.points]
        )
        message.header.frame_id = base_frame
        topic = "target_trajectory"
    else:
        message = _wrench(event.frame or end_effector_frame, event.force, event.torque)
        topic = "target_wrench"
    return Letter(topic, message, message.header, _delay(event.time))


def _point(point: PathPoint) -> MultiDOFJointTrajectoryPoint:
    transform, velocity, acceleration = Transform(), Twist(), Twist()
    p, o = transform.translation, transform.rotation
    p.x, p.y, p.z = point.position
    o.x, o.y, o.z, o.w = point.orientation
    v, a = velocity.linear, acceleration.linear
    v.x, v.y, v.z = point.velocity
    a.x, a.y, a.z = point.acceleration
    message = MultiDOFJointTrajectoryPoint(
        transforms=[transform], velocities=[velocity], accelerations=[acceleration]
    )
    set_stamp(message.time_from_start, _delay(point.time))
    return message


def _wrench(frame: str, force: tuple[float, ...], torque: tuple[float, ...]) -> WrenchStamped:
    message = WrenchStamped()
    message.header.frame_id = frame
    f, t = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z = force
    t.x, t.y, t.z = torque
    return message


def _push(push: Push, time: float, force: tuple[float, ...], torque: tuple[float, ...]) -> Letter:
    message = _wrench(push.link, force, torque)
    return Letter("external_wrench", message, message.header, _delay(time))


def _obstacle(event: AddObstacle | RemoveObstacle, base_frame: str) -> Letter:
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
    return Letter("obstacles", MarkerArray(markers=[marker]), marker.header, _delay(event.time))
