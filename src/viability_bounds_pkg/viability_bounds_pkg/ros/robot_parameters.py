# SPDX-License-Identifier: Apache-2.0
"""Parameters that describe the robot, for every node that loads its URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import (
    RobotDescriptionError,
    build_model,
    check_urdf,
    read_urdf,
)
from viability_bounds_pkg.ros.parameters import (
    NOT_NEGATIVE,
    POSITIVE,
    Parameter,
    given_or,
    joint_names,
    per_joint,
)
from viability_bounds_pkg.ros.runtime import make_executor
from viability_bounds_pkg.ros.topics import ROBOT_DESCRIPTION

Array = NDArray[np.float64]

ROBOT_TABLE = (
    Parameter("robot_description", str, "URDF: path, package:// URI, or 'topic': from that topic"),
    Parameter(
        "joints",
        list[str],
        "joints that move, base to tip, in the order of all arrays",
        note="at least one name, each once",
    ),
    Parameter("locked_joints", list[str], "other joints that are not at zero", default=()),
    Parameter(
        "locked_positions",
        list[float],
        "where they are, rad",
        default=np.zeros(0),
        note="one for each of 'locked_joints'",
    ),
    Parameter(
        "position_min",
        list[float],
        "lower position limits, rad; -.inf for continuous joints",
        per_joint=True,
    ),
    Parameter(
        "position_max",
        list[float],
        "upper position limits, rad; .inf for continuous joints",
        per_joint=True,
        note="above position_min",
    ),
    Parameter(
        "torque_max",
        list[float],
        "torque limits of the motors, N m",
        per_joint=True,
        within=POSITIVE,
    ),
    Parameter(
        "rotor_inertia",
        list[float],
        "inertia of the rotors as seen from the joints, kg m^2; none if empty",
        default=np.zeros(0),
        per_joint=True,
        within=NOT_NEGATIVE,
    ),
)
"""What says which robot it is."""

TOPIC = "topic"
"""Value of ``robot_description`` that asks for what the topic of that name carries."""

_TOPIC_TIMEOUT = 10.0


@dataclass(frozen=True, eq=False)
class RobotConfiguration:
    """Checked parameters of `ROBOT_TABLE`, but for limits.

    Attributes:
        description: where the URDF comes from.
        joints: names of the n joints.
        locked: where joints are locked that are not at zero, rad by name.
        rotor_inertia: as seen from the joints, shape (n,), kg m^2.
    """

    description: str
    joints: tuple[str, ...]
    locked: dict[str, float]
    rotor_inertia: Array


def robot_configuration(values: Mapping[str, Any]) -> RobotConfiguration:
    """Return which robot the parameters describe.

    Raises:
        SettingError: a value cannot be used.
    """
    joints = joint_names(values)
    rotors = given_or(values, "rotor_inertia", np.zeros(len(joints)))
    return RobotConfiguration(values["robot_description"], joints, locked_joints(values), rotors)


def robot_urdf(source: str, node: Node | None = None) -> str:
    """Return the text of the URDF that ``robot_description`` names.

    Args:
        source: value of that parameter.
        node: not in an executor yet; listens if the URDF is to come from the topic. None for
            the robot itself, which publishes it.

    Raises:
        SettingError: there is none.
    """
    try:
        if source != TOPIC or node is None:
            return read_urdf(source)
        text = _urdf_from_topic(node)
        check_urdf(text, "robot_description")
        return text
    except RobotDescriptionError as error:
        raise SettingError("robot_description", source, f"a URDF ({error})") from error


def _urdf_from_topic(node: Node) -> str:
    received: Future = Future()

    def take(message: String) -> None:
        if not received.done():
            received.set_result(message.data)

    subscription = ROBOT_DESCRIPTION.subscription(node, take)
    executor = make_executor(node.context)
    executor.add_node(node)
    executor.spin_until_future_complete(received, timeout_sec=_TOPIC_TIMEOUT)
    executor.remove_node(node)
    node.destroy_subscription(subscription)
    if not received.done():
        raise RobotDescriptionError(f"nothing on the topic for {_TOPIC_TIMEOUT:g} s")
    return str(received.result())


def load_model(config: RobotConfiguration, urdf: str) -> pin.Model:
    """Return the model of the arm.

    Args:
        config: which robot it is.
        urdf: text of its URDF.

    Raises:
        SettingError: a URDF that does not load, or a joint that it does not have.
    """
    try:
        return build_model(urdf, config.joints, config.locked, config.rotor_inertia)
    except RobotDescriptionError as error:
        name, value, allowed = _culprit(config, urdf)
        raise SettingError(name, value, f"{allowed} ({error})") from error


def _culprit(config: RobotConfiguration, urdf: str) -> tuple[str, Any, str]:
    """Return which parameter keeps a model from being built, its value, and what it may be."""
    joints = config.joints
    for name, value, allowed, chosen in (
        ("robot_description", config.description, "a URDF", ()),
        ("joints", joints, "joints of the URDF, base to tip", joints),
    ):
        try:
            build_model(urdf, chosen)
        except RobotDescriptionError:
            return name, value, allowed
    return "locked_joints", tuple(config.locked), "other joints of the URDF"


def locked_joints(values: Mapping[str, Any]) -> dict[str, float]:
    """Return where joints are locked that are not at zero, rad by name.

    Raises:
        SettingError: as many positions as joints are not given, or one is not finite.
    """
    names, positions = values["locked_joints"], values["locked_positions"]
    if len(names) != len(positions):
        allowed = f"{len(names)} numbers, one for each of 'locked_joints'"
        raise SettingError("locked_positions", positions, allowed)
    if not np.isfinite(positions).all():
        raise SettingError("locked_positions", positions, "finite numbers")
    return dict(zip(names, map(float, positions), strict=True))


def position_limits(values: Mapping[str, Any], joints: Sequence[str]) -> tuple[Array, Array]:
    """Return ``position_min`` and ``position_max``, shape (n,) each, rad.

    Raises:
        SettingError: one has the wrong length, or a range is empty.
    """
    q_min = per_joint(values, "position_min", joints)
    q_max = per_joint(values, "position_max", joints)
    if np.isposinf(q_min).any():
        raise SettingError("position_min", q_min, "numbers below .inf")
    if not (q_min < q_max).all():
        raise SettingError("position_max", q_max, "above position_min everywhere")
    return q_min, q_max
