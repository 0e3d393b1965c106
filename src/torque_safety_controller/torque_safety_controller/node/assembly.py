# SPDX-License-Identifier: Apache-2.0
"""Makes the controller from its configuration and the URDF: which parts, in which order."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from torque_safety_controller.controller import Controller
from torque_safety_controller.node.declared import limits_jerk
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.avoidance import Collision
from torque_safety_controller.parts.collision.model import build_collision_model
from torque_safety_controller.parts.contact.contacts import FrictionContact
from torque_safety_controller.parts.contact.interaction import Interaction
from torque_safety_controller.parts.contact.wrench_sensor import WrenchSensor
from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.parts.friction import Friction
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.held_torque import HeldTorque
from torque_safety_controller.parts.integral import Integral, make_integral
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.parts.slow_down import SlowDown
from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part
from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError, did_you_mean
from viability_bounds_pkg.node.bounds_parameters import (
    Bounds,
    BoundsConfiguration,
    limits_of,
    make_bounds,
)
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.description import frame_id, inertia_beyond
from viability_bounds_pkg.robot.files import RobotDescriptionError
from viability_bounds_pkg.robot.locked_joints import LockedJoints
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
) -> tuple[Controller, pin.SE3, LockedJoints]:
    """Return a controller, warmed up, the placement of the base frame, and what keeps its model.

    Tasks and limits are in the root frame of the URDF; the placement converts what is in
    ``base_frame``. It is a part of the model: it changes where a locked joint moves the frame.

    Args:
        config: checked parameters.
        node: listens for the URDF if it comes from a topic.
        declared: of the robot, for the bounds node.

    Raises:
        SettingError: parameters that do not fit the URDF.
    """
    if limits_jerk(declared):
        _check_jerk(config)
    urdf = robot_urdf(config, node)
    model = load_model(config, urdf)
    if node is not None:
        warn_of_unusual(node, config, urdf)
        if config.collision.bodies and not config.collision.collision_avoidance:
            node.get_logger().warning(
                "parameter 'obstacles' is given, but 'collision_avoidance' is false: the arm does "
                "not avoid them"
            )
    roots = ", ".join(each.name for each in model.frames if each.parentJoint == 0)
    base = _frame(model, config.base_frame, "base_frame", f"a frame fixed to the root: {roots}")
    if base.parentJoint != 0:
        allowed = "a frame fixed to the root, not a moving one"
        raise SettingError("base_frame", config.base_frame, allowed)
    robot = _robot(config, model)
    controller = Controller(
        robot,
        make_parts(config, robot, urdf, declared),
        config.torque_max,
        config.torque_rate_max,
        config.qp_solver,
        config.gains.hold_kd,
    )
    controller.warm_up()
    frames = config.end_effectors, config.base_frame
    locked = LockedJoints(config, urdf, model, robot.payload, *frames)
    return controller, base.placement, locked


def _check_jerk(config: ControllerConfiguration) -> None:
    """Raise `SettingError` for parts that know nothing of a limited jerk."""
    for name, value, off in (
        ("disturbance_time", config.gains.disturbance_time, "0"),
        ("safety_filter", config.safety_filter, "false"),
        ("collision_avoidance", config.collision.collision_avoidance, "false"),
    ):
        if value:
            raise SettingError(name, value, f"{off} where bounds_node has jerk_max")


def make_parts(
    config: ControllerConfiguration,
    robot: RobotModel,
    urdf: str,
    declared: BoundsConfiguration | None,
) -> list[Part]:
    """Return the parts of a controller that its parameters ask for, in their order.

    A part reads only what parts before it have written. What is off is left out.

    Args:
        config: checked parameters.
        robot: model of the arm.
        urdf: text of its URDF.
        declared: of the robot, for the bounds node.

    Raises:
        SettingError: parameters that do not fit the URDF.
    """
    hands, time = 1 + len(robot.others), config.gains.disturbance_time
    goals = Goals(robot.n, config.gains, len(robot.others))
    integral = make_integral(
        config.integral.integral_action,
        config.integral_settings,
        DISTURBANCE_MAX * config.torque_max,
        hands,
    )
    parts = [
        # It may make the hand's pose the goal, and soften the pose task.
        _interaction(config, robot, urdf, goals),
        goals,
        # What is added to the model's torque leaves less of it to the QP and to plans. A torque
        # that is taken over fades where integral action is off.
        Integral(integral, robot),
        Friction(config.friction_settings),
        # A change of that torque disturbs before it can be measured.
        Disturbance(robot.n, time) if time else None,
        # All before can run while the limits are on their way; all after narrows their bounds.
        JointBounds(_own_bounds(config, declared)),
        _safety_filter(config, robot.model),
        # A slowed arm is slowed inside of what the filter allows.
        SlowDown(config.position_min, config.position_max, config.dt, limits_jerk(declared)),
        # These bounds are for rows of missed deadlines, too.
        _held_torque(robot, declared),
        # It counts on no more braking than the bounds leave.
        make_collision(config, robot.model),
    ]
    return [part for part in parts if part is not None]


def _held_torque(robot: RobotModel, declared: BoundsConfiguration | None) -> HeldTorque | None:
    periods = 1 if declared is None else declared.declared.periods_held
    return HeldTorque(robot.model, periods * robot.dt, robot.dt) if periods > 1 else None


def _safety_filter(config: ControllerConfiguration, model: pin.Model) -> SafetyFilter | None:
    if not config.safety_filter:
        return None
    return SafetyFilter(
        model,
        config.position_min,
        config.position_max,
        config.collision.acceleration_min,
        config.collision.acceleration_max,
        config.torque_max,
        config.dt,
        config.torque_reserve,
        config.velocity_offset,
        config.deceleration_limit,
    )


def _own_bounds(
    config: ControllerConfiguration, declared: BoundsConfiguration | None
) -> Bounds | None:
    """Return the bounds in HOLD while those of ``acceleration_limits`` are stale.

    They are those of the bounds node, as far as its parameters are known and its method keeps
    limits. Else they know nothing of declared errors and delays, and keep a share of the
    acceleration instead. None without limits.
    """
    if declared is not None and declared.method == "exact":
        with suppress(ArmSafetyError):  # the node that they are for says so
            return make_bounds(declared)
    low, high = config.collision.acceleration_min, config.collision.acceleration_max
    n = len(config.joints)
    if not (len(low) == len(high) == n and np.isfinite(config.velocity_max).all()):
        return None
    limits, margin = limits_of(config, 0.0, config.collision), MARGIN * np.minimum(-low, high)
    return BoundsSolver(limits, HORIZON * config.dt, margin, period=config.dt).bounds


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
    found = build_collision_model(
        limited,
        collision.capsules,
        collision.posture(config),
        collision.bodies,
        config.base_frame,
    )
    return Collision(
        replace(found, arm=model),
        collision.acceleration_min,
        collision.acceleration_max,
        HORIZON * config.dt,
    )


def _interaction(
    config: ControllerConfiguration, robot: RobotModel, urdf: str, goals: Goals
) -> Interaction | None:
    """Return what handles forces; None without a sensor."""
    settings, model = config.interaction, robot.model
    hand = model.frames[frame_id(model, robot.frame)]
    contact, placement = None, None
    if points := settings.points:
        frames = [
            _frame(model, point.frame, f"contacts[{index}].frame", "a frame of the URDF")
            for index, point in enumerate(points)
        ]
        names = list(dict.fromkeys(point.frame for point in points))
        if len(names) > 1 or frames[0].parentJoint != hand.parentJoint:
            raise SettingError("contacts", names, f"one link, fixed to {robot.frame!r}")
        places, first = [point.point for point in points], points[0]
        contact = FrictionContact(first.frame, places, first.normal, first.friction)
        placement = hand.placement.actInv(frames[0].placement)
    if not settings.ft_frame:
        return None
    frame = _frame(
        model, settings.ft_frame, "ft_frame", "a link of the URDF, or empty", links=True
    )
    if frame.parentJoint != hand.parentJoint:
        raise SettingError("ft_frame", settings.ft_frame, f"a link fixed to {robot.frame!r}")
    try:
        tool = inertia_beyond(urdf, settings.ft_frame, config.locked)
    except RobotDescriptionError as error:
        allowed = f"a link of the URDF ({error})"
        raise SettingError("ft_frame", settings.ft_frame, allowed) from error
    at_hand = hand.placement.actInv(frame.placement)
    sensor = WrenchSensor(at_hand, tool, model.gravity.linear, frame=settings.ft_frame)
    return Interaction(goals, sensor, contact, placement, settings.settings)


def _robot(config: ControllerConfiguration, model: pin.Model) -> RobotModel:
    frame, (first, *others) = config.end_effector_frame, config.end_effectors
    if len(config.joints) < 2:
        raise SettingError("joints", config.joints, "two or more")
    if len(others) > 1 or first in others:
        raise SettingError("end_effector_frame", frame, "a frame of the URDF, or two of them")
    try:
        return RobotModel(model, first, config.dt, others)
    except RobotDescriptionError as error:
        allowed = f"a frame of the URDF ({error})"
        raise SettingError("end_effector_frame", frame, allowed) from error


def _frame(
    model: pin.Model, name: str, parameter: str, allowed: str, links: bool = False
) -> pin.Frame:
    """Return a frame that a parameter names, one of a link where only these are allowed."""
    known = {each.name for each in model.frames if not links or each.type == pin.FrameType.BODY}
    if name not in known:
        raise SettingError(parameter, name, allowed + did_you_mean(name, known))
    return model.frames[frame_id(model, name)]
