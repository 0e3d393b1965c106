# SPDX-License-Identifier: Apache-2.0
"""Makes the controller from its configuration and the URDF: which parts, in which order."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from torque_safety_controller.controller import Controller
from torque_safety_controller.parameters.contact_parameters import ContactPoint
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.avoidance import Collision
from torque_safety_controller.parts.collision.model import build_collision_model
from torque_safety_controller.parts.contact.contacts import FrictionContact
from torque_safety_controller.parts.contact.interaction import Interaction
from torque_safety_controller.parts.contact.wrench_sensor import WrenchSensor
from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.parts.friction import Friction
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.integral import Integral, make_integral
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.parts.slow_down import SlowDown
from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part
from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError, did_you_mean
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_parameters import (
    Bounds,
    BoundsConfiguration,
    make_bounds,
)
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    inertia_beyond,
)
from viability_bounds_pkg.ros.robot_urdf import robot_urdf, warn_of_unusual
from viability_bounds_pkg.stop import MARGIN
from viability_bounds_pkg.viability import BoundsSolver

if TYPE_CHECKING:
    from rclpy.node import Node

HORIZON = 2.0
"""Control periods that an acceleration is assumed to last, as in the bounds: no chatter."""

DISTURBANCE_MAX = 2.0
"""Disturbances beyond this many torque limits are not integrated."""


def make_controller(
    config: ControllerConfiguration,
    node: Node | None = None,
    declared: BoundsConfiguration | None = None,
) -> tuple[Controller, pin.SE3]:
    """Return a controller, warmed up, and the placement of the base frame.

    Args:
        config: checked parameters.
        node: listens for the URDF if it comes from a topic.
        declared: of the robot, for the bounds node.

    Raises:
        SettingError: parameters that do not fit the URDF.
    """
    robot, base, urdf = load_robot(config, node)
    controller = Controller(
        robot,
        make_parts(config, robot, urdf, declared),
        config.torque_max,
        config.torque_rate_max,
        config.qp_solver,
        config.gains.hold_kd,
    )
    controller.warm_up()
    return controller, base


def make_parts(
    config: ControllerConfiguration,
    robot: RobotModel,
    urdf: str,
    declared: BoundsConfiguration | None,
) -> list[Part]:
    """Return the parts of a controller that its parameters ask for, in their order.

    A part reads only what parts before it have written. Tasks and limits are in the root frame of
    the URDF; `LoadedRobot.base` converts what is in `base_frame`.

    Args:
        config: checked parameters.
        robot: model of the arm.
        urdf: text of its URDF.
        declared: of the robot, for the bounds node.

    Raises:
        SettingError: parameters that do not fit the URDF.
    """
    goals = Goals(robot.n, config.gains, len(robot.others))
    parts = [
        # It may make the hand's pose the goal, and soften the pose task.
        make_interaction(config, robot, urdf, goals),
        goals,
        # What is added to the model's torque leaves less of it to the QP and to plans.
        make_integral_part(config, robot),
        Friction(config.friction_settings),
        # A change of that torque disturbs before it can be measured.
        make_disturbance(config),
        # All before can run while the limits are on their way; all after narrows their bounds.
        JointBounds(make_own_bounds(config, declared)),
        make_safety_filter(config, robot.model),
        # A slowed arm is slowed inside of what the filter allows.
        SlowDown(config.position_min, config.position_max, config.dt),
        # It counts on no more braking than the bounds leave.
        make_collision(config, robot.model),
    ]
    return [part for part in parts if part is not None]


def make_integral_part(config: ControllerConfiguration, robot: RobotModel) -> Integral:
    """Return the integral action; a torque that is taken over fades where it is off."""
    mode, settings = config.integral.integral_action, config.integral_settings
    most = DISTURBANCE_MAX * config.torque_max
    return Integral(make_integral(mode, settings, most, 1 + len(robot.others)), robot)


def make_disturbance(config: ControllerConfiguration) -> Disturbance | None:
    """Return what estimates disturbances; None where that is off."""
    time = config.gains.disturbance_time
    return Disturbance(len(config.joints), time) if time else None


def make_safety_filter(config: ControllerConfiguration, model: pin.Model) -> SafetyFilter | None:
    """Return what keeps a plan in hand; None where that is off.

    Args:
        config: checked parameters.
        model: of the arm.
    """
    if not config.safety_filter:
        return None
    limits = config.collision
    return SafetyFilter(
        model,
        config.position_min,
        config.position_max,
        limits.acceleration_min,
        limits.acceleration_max,
        config.torque_max,
        config.dt,
        config.torque_reserve,
    )


def make_own_bounds(
    config: ControllerConfiguration, declared: BoundsConfiguration | None
) -> Bounds | None:
    """Return the bounds in HOLD while those of ``acceleration_limits`` are stale.

    They are those of the bounds node, as far as its parameters are known and its method keeps
    limits. Else they know nothing of declared errors and delays, and keep a share of the
    acceleration instead.

    Args:
        config: checked parameters; None is returned where they lack limits.
        declared: parameters of the bounds node.
    """
    if declared is not None and declared.method == "exact":
        with suppress(ArmSafetyError):  # the node that they are for says so
            return make_bounds(declared)
    low, high = config.collision.acceleration_min, config.collision.acceleration_max
    n = len(config.joints)
    if not (len(low) == len(high) == n and np.isfinite(config.velocity_max).all()):
        return None
    limits = JointLimits(
        config.joints, config.position_min, config.position_max, config.velocity_max, low, high
    )
    margin = MARGIN * np.minimum(-low, high)
    return BoundsSolver(limits, HORIZON * config.dt, margin, period=config.dt).bounds


class LoadedRobot(NamedTuple):
    """What the URDF says.

    Attributes:
        robot: model of the arm.
        base: placement of the base frame in the URDF's root frame.
        urdf: its text.
    """

    robot: RobotModel
    base: pin.SE3
    urdf: str


def load_robot(config: ControllerConfiguration, node: Node | None = None) -> LoadedRobot:
    """Read the URDF, once, and return what is made of it.

    Args:
        config: checked parameters.
        node: listens for the URDF if it comes from a topic.

    Raises:
        SettingError: a URDF that does not load, or a joint or frame that it does not have.
    """
    urdf = robot_urdf(config, node)
    model = load_model(config, urdf)
    if node is not None:
        warn_of_unusual(node, config, urdf)
    frame, (first, *others) = config.end_effector_frame, config.end_effectors
    if len(others) > 1 or first in others:
        raise SettingError("end_effector_frame", frame, "a frame of the URDF, or two of them")
    try:
        robot = RobotModel(model, first, config.dt, others)
    except RobotDescriptionError as error:
        allowed = f"a frame of the URDF ({error})"
        raise SettingError("end_effector_frame", frame, allowed) from error
    return LoadedRobot(robot, _base_placement(model, config.base_frame), urdf)


def _base_placement(model: pin.Model, frame: str) -> pin.SE3:
    if not model.existFrame(frame):
        known = [each.name for each in model.frames if each.parentJoint == 0]
        allowed = f"a frame fixed to the root: {', '.join(known)}{did_you_mean(frame, known)}"
        raise SettingError("base_frame", frame, allowed)
    found = model.frames[model.getFrameId(frame)]
    if found.parentJoint != 0:
        raise SettingError("base_frame", frame, "a frame fixed to the root, not a moving one")
    return found.placement


def make_collision(config: ControllerConfiguration, model: pin.Model) -> Collision | None:
    """Return the collision avoidance of an arm; None where that is off.

    Args:
        config: checked parameters.
        model: of the arm.

    Raises:
        SettingError: there are no capsules, or those of a link that there is not.
    """
    collision = config.collision
    if not collision.collision_avoidance:
        return None
    if not collision.capsules:
        tool = "ros2 run torque_safety_controller fit_capsules FILE"
        raise SettingError("collision_capsules", [], f"capsules, which '{tool}' writes")
    for index, obstacle in enumerate(collision.bodies):
        if model.existFrame(obstacle.name, pin.FrameType.BODY):
            raise SettingError(f"obstacles[{index}].name", obstacle.name, "no name of a link")
    limited = model.copy()
    limited.lowerPositionLimit = config.position_min
    limited.upperPositionLimit = config.position_max
    return Collision(
        build_collision_model(
            limited,
            collision.capsules,
            collision.posture(config),
            collision.bodies,
            config.base_frame,
        ),
        collision.acceleration_min,
        collision.acceleration_max,
        HORIZON * config.dt,
    )


def make_interaction(
    config: ControllerConfiguration, robot: RobotModel, urdf: str, goals: Goals
) -> Interaction | None:
    """Return what handles forces; None without a sensor.

    Args:
        config: checked parameters.
        robot: model of the arm.
        urdf: text of its URDF.
        goals: of the arm.

    Raises:
        SettingError: a frame that the URDF does not have or that is not where it must be.
    """
    sensor = _sensor(config, robot, urdf)
    contact = _contact(config.interaction.points, robot)
    if sensor is None:
        return None
    if contact is None:
        return Interaction(goals, sensor, settings=config.interaction.settings)
    placement = _between(robot.model, robot.frame, contact.frame)
    return Interaction(goals, sensor, contact, placement, config.interaction.settings)


def _sensor(config: ControllerConfiguration, robot: RobotModel, urdf: str) -> WrenchSensor | None:
    settings, model = config.interaction, robot.model
    frame = settings.ft_frame
    if not frame:
        return None
    if not model.existFrame(frame, pin.FrameType.BODY):
        links = [each.name for each in model.frames if each.type == pin.FrameType.BODY]
        allowed = f"a link of the URDF, or empty{did_you_mean(frame, links)}"
        raise SettingError("ft_frame", frame, allowed)
    if _joint_of(model, frame) != _joint_of(model, robot.frame):
        raise SettingError("ft_frame", frame, f"a link fixed to {robot.frame!r}")
    try:
        inertia = inertia_beyond(urdf, frame, config.locked)
    except RobotDescriptionError as error:
        raise SettingError("ft_frame", frame, f"a link of the URDF ({error})") from error
    placement = _between(model, robot.frame, frame)
    return WrenchSensor(placement, inertia, model.gravity.linear)


def _contact(points: Sequence[ContactPoint], robot: RobotModel) -> FrictionContact | None:
    """Return the contact of the hand; None without points."""
    if not points:
        return None
    for index, point in enumerate(points):
        if not robot.model.existFrame(point.frame):
            hint = did_you_mean(point.frame, (each.name for each in robot.model.frames))
            allowed = f"a frame of the URDF{hint}"
            raise SettingError(f"contacts[{index}].frame", point.frame, allowed)
    first = points[0]
    frames = list(dict.fromkeys(each.frame for each in points))
    if len(frames) > 1 or _joint_of(robot.model, first.frame) != _joint_of(
        robot.model, robot.frame
    ):
        raise SettingError("contacts", frames, f"one link, fixed to {robot.frame!r}")
    places = np.array([each.point for each in points])
    return FrictionContact(first.frame, places, first.normal, first.friction)


def _joint_of(model: pin.Model, frame: str) -> int:
    return int(model.frames[model.getFrameId(frame)].parentJoint)


def _between(model: pin.Model, frame: str, other: str) -> pin.SE3:
    """Return the placement of a frame in another that is fixed to the same joint."""
    first, second = (model.frames[model.getFrameId(name)].placement for name in (frame, other))
    return first.actInv(second)
