# SPDX-License-Identifier: Apache-2.0
"""Parameters of the collision avoidance: the table, and what is made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.collision.avoidance import CollisionAvoidance, CollisionSettings
from torque_safety_controller.collision.bodies import SHAPES, CollisionBody, make_obstacle
from torque_safety_controller.collision.geometry import load_geometry
from torque_safety_controller.collision.model import build_collision_model
from torque_safety_controller.parameters.entries import Entry
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError
from viability_bounds_pkg.ros.parameters import (
    NEGATIVE,
    POSITIVE,
    Parameter,
    Range,
    above,
    per_joint,
)
from viability_bounds_pkg.ros.robot_parameters import RobotConfiguration

Array = NDArray[np.float64]

HORIZON = 2.0
"""Control periods that an acceleration is assumed to last, as in the bounds: no chatter."""

_BEYOND = 0.003  # m; beyond margin and reserve, pairs nearer than this are too near from the start
_NEAR = 0.028  # m; beyond margin and reserve, pairs that never come nearer need no guard

_DEFAULTS = CollisionSettings()
_OBSTACLE_FIELDS = ("name", "shape", "size", "position", "rpy")
_EQUAL = {"cylinder": 2, "sphere": 3}  # of the numbers of a size, how many are one diameter

COLLISION_TABLE = (
    Parameter(
        "collision_avoidance",
        bool,
        "whether links keep away from each other and from the obstacles below",
        default=False,
    ),
    Parameter(
        "collision_margin",
        float,
        "distance kept between links and to obstacles, m",
        default=_DEFAULTS.margin,
        within=Range(0.0, 0.5),
    ),
    Parameter(
        "collision_speed_max",
        float,
        "largest speed of approach, m/s",
        default=_DEFAULTS.speed_max,
        within=above(0.0, 10.0),
    ),
    Parameter(
        "collision_pairs",
        list[str],
        "pairs of links to keep apart; chosen automatically if empty",
        default=(),
        note="each two links, as in 'link_a link_b'",
    ),
    Parameter(
        "collision_posture",
        list[float],
        "for the automatic choice, a posture free of collisions, rad: what is nearer there than "
        "the margin is not kept apart; the middle of the position limits if empty",
        default=np.zeros(0),
        per_joint=True,
        note="within the position limits",
    ),
    Parameter(
        "acceleration_min",
        list[float],
        "for collision_avoidance: lower acceleration limits, rad/s^2",
        default=np.zeros(0),
        per_joint=True,
        within=NEGATIVE,
    ),
    Parameter(
        "acceleration_max",
        list[float],
        "for collision_avoidance: upper acceleration limits, rad/s^2",
        default=np.zeros(0),
        per_joint=True,
        within=POSITIVE,
    ),
    Parameter(
        "obstacles",
        list[str],
        "obstacles to keep away from, fixed in base_frame: position of the centre, of a "
        "half_space a point on its surface, m; rpy, rotations about the fixed axes x, y, z, rad, "
        "0 if left out, a half_space is where z < 0; size, m, as in a Marker: edges of a box, "
        "diameter three times of a sphere, diameter, diameter and height along z of a cylinder, "
        "nothing of a half_space",
        default=(),
        note="each a YAML mapping '{name: wall, shape: box, size: [x, y, z], position: [x, y, z], "
        f"rpy: [r, p, y]}}' with another name; shape is one of {', '.join(SHAPES)}",
    ),
)


@dataclass(frozen=True, eq=False)
class CollisionConfiguration:
    """Checked parameters of the collision avoidance; arrays of shape (n,) in `joints` order.

    Attributes:
        settings: distances and speeds.
        pairs: of links to keep apart; None to choose them automatically.
        posture: free of collisions, rad.
        q_min: position limits, rad: postures within them are searched for links that can touch.
        q_max: rad.
        a_min: acceleration limits, rad/s^2.
        a_max: rad/s^2.
        obstacles: in the base frame.
        base_frame: in which obstacles are.
        dt: how long an acceleration is assumed to last, s.
    """

    settings: CollisionSettings
    pairs: tuple[tuple[str, str], ...] | None
    posture: Array
    q_min: Array
    q_max: Array
    a_min: Array
    a_max: Array
    obstacles: tuple[CollisionBody, ...]
    base_frame: str
    dt: float


def collision_configuration(
    values: Mapping[str, Any], joints: Sequence[str], q_min: Array, q_max: Array
) -> CollisionConfiguration | None:
    """Check everything but what the URDF decides, which `load_collision` needs.

    Args:
        values: parameter values by name.
        joints: names of the n joints.
        q_min: position limits, shape (n,), rad.
        q_max: shape (n,), rad.

    Returns:
        None without collision avoidance; the parameters are checked all the same.

    Raises:
        SettingError: a value cannot be used.
    """
    obstacles = _obstacles(values["obstacles"])
    pairs = tuple(_pair(text) for text in values["collision_pairs"])
    posture = _posture(values, q_min, q_max)
    if not values["collision_avoidance"]:
        return None
    return CollisionConfiguration(
        settings=CollisionSettings(
            margin=values["collision_margin"], speed_max=values["collision_speed_max"]
        ),
        pairs=pairs or None,
        posture=posture,
        q_min=q_min,
        q_max=q_max,
        a_min=per_joint(values, "acceleration_min", joints),
        a_max=per_joint(values, "acceleration_max", joints),
        obstacles=obstacles,
        base_frame=values["base_frame"],
        dt=HORIZON / values["rate_hz"],
    )


def load_collision(
    config: CollisionConfiguration | None, robot: RobotConfiguration, urdf: str, model: pin.Model
) -> CollisionAvoidance | None:
    """Return the collision avoidance of an arm, or None without one.

    Args:
        config: of `collision_configuration`.
        robot: which arm it is.
        urdf: text of the URDF.
        model: made of it.

    Raises:
        SettingError: collision geometry that does not load, or a link that there is not.
    """
    if config is None:
        return None
    for index, obstacle in enumerate(config.obstacles):
        if model.existFrame(obstacle.name, pin.FrameType.BODY):
            raise SettingError(f"obstacles[{index}].name", obstacle.name, "no name of a link")
    limited = model.copy()
    limited.lowerPositionLimit, limited.upperPositionLimit = config.q_min, config.q_max
    kept = config.settings.kept
    try:
        geometry = load_geometry(urdf, model, robot.locked)
    except RobotDescriptionError as error:
        allowed = f"a URDF whose collision geometry loads ({error})"
        raise SettingError("robot_description", robot.description, allowed) from error
    collision = build_collision_model(
        limited,
        geometry,
        config.posture,
        config.obstacles,
        config.pairs,
        config.base_frame,
        near=kept + _NEAR,
        clearance=kept + _BEYOND,
    )
    return CollisionAvoidance(collision, config.a_min, config.a_max, config.dt, config.settings)


def _obstacles(texts: Sequence[str]) -> tuple[CollisionBody, ...]:
    obstacles: dict[str, CollisionBody] = {}
    for index, text in enumerate(texts):
        entry = Entry("obstacles", index, text, _OBSTACLE_FIELDS)
        name, shape = entry.text("name"), entry.text("shape")
        if name in obstacles:
            raise entry.refused("name", "a name that no other obstacle has")
        if shape not in SHAPES:
            raise entry.refused("shape", f"one of {', '.join(SHAPES)}")
        size = np.zeros(3) if shape == "half_space" else entry.vector("size", within=POSITIVE)
        if len(set(size[: _EQUAL.get(shape, 1)])) > 1:
            raise entry.refused("size", f"the same diameter {_EQUAL[shape]} times")
        rotation = pin.rpy.rpyToMatrix(entry.vector("rpy", (0.0, 0.0, 0.0)))
        orientation = pin.Quaternion(rotation).coeffs()
        obstacles[name] = make_obstacle(name, shape, size, entry.vector("position"), orientation)
    return tuple(obstacles.values())


def _pair(text: str) -> tuple[str, str]:
    links = text.split()
    if len(links) != 2:
        raise SettingError("collision_pairs", text, "two links, as in 'link_a link_b'")
    return links[0], links[1]


def _posture(values: Mapping[str, Any], q_min: Array, q_max: Array) -> Array:
    posture: Array = values["collision_posture"]
    if len(posture):
        if not ((q_min <= posture) & (posture <= q_max) & np.isfinite(posture)).all():
            raise SettingError("collision_posture", posture, "within the position limits")
        return posture
    limited = np.isfinite(q_min) & np.isfinite(q_max)
    return np.where(limited, 0.5 * (np.where(limited, q_min, 0.0) + q_max), 0.0)
