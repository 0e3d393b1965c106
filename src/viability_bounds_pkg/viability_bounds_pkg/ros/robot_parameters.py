"""Parameters that say which robot it is, for every node that loads one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
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
    Parameter,
    joint_names,
    per_joint,
)
from viability_bounds_pkg.ros.runtime import LATCHED_QOS, make_executor

ROBOT_TABLE = (
    Parameter("robot_description", str, "URDF: path, package:// URI, or 'topic': from that topic"),
    Parameter("joints", list[str], "joints that move, base to tip, in the order of all arrays"),
    Parameter("locked_joints", list[str], "other joints that are not at zero", default=()),
    Parameter("locked_positions", list[float], "where they are, rad", default=np.zeros(0)),
    Parameter("position_min", list[float], "lower position limits, rad"),
    Parameter("position_max", list[float], "upper position limits, rad"),
    Parameter("torque_max", list[float], "torque limits of the motors, N m"),
    Parameter(
        "rotor_inertia",
        list[float],
        "inertia of the rotors as seen from the joints, kg m^2; none if empty",
        default=np.zeros(0),
    ),
)


TOPIC = "topic"
"""Value of ``robot_description`` that asks for what the topic of that name carries."""

_TOPIC_TIMEOUT = 10.0


def robot_urdf(values: Mapping[str, Any], node: Node | None = None) -> str:
    """Return the text of the URDF that ``robot_description`` names.

    Args:
        values: parameter values by name.
        node: not in an executor yet; listens if the URDF is to come from the topic. None for
            the robot itself, which publishes it.

    Raises:
        SettingError: there is none.
    """
    source = values["robot_description"]
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

    subscription = node.create_subscription(String, "robot_description", take, LATCHED_QOS)
    executor = make_executor(node.context)
    executor.add_node(node)
    executor.spin_until_future_complete(received, timeout_sec=_TOPIC_TIMEOUT)
    executor.remove_node(node)
    node.destroy_subscription(subscription)
    if not received.done():
        raise RobotDescriptionError(f"nothing on the topic for {_TOPIC_TIMEOUT:g} s")
    return received.result()


def load_model(values: Mapping[str, Any], node: Node) -> pin.Model:
    """Return the model of the arm that the parameters of `ROBOT_TABLE` describe.

    Args:
        values: parameter values by name.
        node: listens for the URDF if it comes from a topic.

    Raises:
        SettingError: a URDF that does not load, a joint that it does not have, or rotor
            inertias that cannot be.
    """
    return model_from(values, robot_urdf(values, node))


def model_from(values: Mapping[str, Any], urdf: str) -> pin.Model:
    """Return the model of the arm from the text of its URDF; see `load_model`."""
    joints = joint_names(values)
    rotors = not_negative(values, "rotor_inertia", joints)
    try:
        return build_model(urdf, joints, locked_joints(values), rotors)
    except RobotDescriptionError as error:
        name, allowed = _culprit(urdf, joints)
        raise SettingError(name, values[name], f"{allowed} ({error})") from error


def _culprit(urdf: str, joints: tuple[str, ...]) -> tuple[str, str]:
    """Return which parameter keeps a model from being built, and what it may be."""
    for name, allowed, chosen in (
        ("robot_description", "a URDF", ()),
        ("joints", "joints of the URDF, base to tip", joints),
    ):
        try:
            build_model(urdf, chosen)
        except RobotDescriptionError:
            return name, allowed
    return "locked_joints", "other joints of the URDF"


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


def position_limits(
    values: Mapping[str, Any], joints: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``position_min`` and ``position_max``, shape (n,) each, rad.

    Raises:
        SettingError: one has the wrong length, or a range is empty.
    """
    q_min = per_joint(values, "position_min", joints)
    q_max = per_joint(values, "position_max", joints)
    if not (q_min < q_max).all():
        raise SettingError("position_max", q_max, "above position_min everywhere")
    return q_min, q_max


def all_positive(values: Mapping[str, Any], name: str, joints: Sequence[str]) -> np.ndarray:
    """Return a parameter of one finite positive number a joint, shape (n,).

    Raises:
        SettingError: it is something else.
    """
    value = per_joint(values, name, joints)
    if not (np.isfinite(value).all() and (value > 0).all()):
        raise SettingError(name, value, "finite numbers > 0")
    return value


def not_negative(values: Mapping[str, Any], name: str, joints: Sequence[str]) -> np.ndarray:
    """Return a parameter of one finite number >= 0 a joint, shape (n,); zeros if it is empty.

    Raises:
        SettingError: it is something else.
    """
    if not len(values[name]):
        return np.zeros(len(joints))
    value = per_joint(values, name, joints)
    if not (np.isfinite(value).all() and (value >= 0).all()):
        raise SettingError(name, value, "finite numbers >= 0")
    return value
