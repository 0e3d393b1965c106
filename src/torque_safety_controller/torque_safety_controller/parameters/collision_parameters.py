"""Parameters of the collision avoidance: the table, and what is made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pinocchio as pin

from torque_safety_controller.collision.avoidance import CollisionAvoidance, CollisionSettings
from torque_safety_controller.collision.bodies import (
    SHAPES,
    CollisionBody,
    make_obstacle,
)
from torque_safety_controller.collision.geometry import load_geometry
from torque_safety_controller.collision.model import Pruning, build_collision_model
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError
from viability_bounds_pkg.ros.parameters import Parameter, per_joint
from viability_bounds_pkg.ros.robot_parameters import locked_joints

HORIZON = 2.0
"""Control periods that an acceleration is counted on for, as in the bounds: no chatter."""

_BEYOND = 0.003  # m; beyond margin and reserve, nearer than which pairs are in each other's way
_NEAR = 0.028  # m; beyond margin and reserve, pairs that never come nearer need no guard

_SETTINGS = {
    "margin": "distance kept between links and to obstacles, m",
    "braking": "deceleration that a distance counts on at most, m/s^2",
    "speed_max": "greatest speed of approach, m/s",
}

_OBSTACLES = {
    "sizes": "full lengths along their own axes, three for each, m, as in a Marker: edges; "
    "diameters; diameter, diameter and height along z; of a half_space anything",
    "positions": "of their centres in base_frame, three for each, m; of a half_space a point on "
    "its surface",
    "orientations": "of their axes, four for each: x, y, z, w; those of base_frame if empty; of a "
    "half_space z points out of it",
}

TABLE = (
    Parameter(
        "collision_avoidance",
        bool,
        "whether links keep away from each other and from the obstacles below",
        default=False,
    ),
    *(
        Parameter(f"collision_{field.name}", float, _SETTINGS[field.name], default=field.default)
        for field in fields(CollisionSettings)
    ),
    Parameter(
        "collision_pairs",
        list[str],
        "pairs of links to keep apart, each 'link_a link_b'; chosen automatically if empty",
        default=(),
    ),
    Parameter(
        "collision_posture",
        list[float],
        "for the automatic choice, a posture free of collisions, rad: what is nearer there than "
        "the margin is not kept apart; the middle of the position limits if empty",
        default=np.zeros(0),
    ),
    Parameter(
        "acceleration_min",
        list[float],
        "for collision_avoidance: lower acceleration limits, rad/s^2, < 0",
        default=np.zeros(0),
    ),
    Parameter(
        "acceleration_max",
        list[float],
        "for collision_avoidance: upper acceleration limits, rad/s^2, > 0",
        default=np.zeros(0),
    ),
    Parameter("obstacle_names", list[str], "obstacles to keep away from", default=()),
    Parameter(
        "obstacle_shapes", list[str], f"for each of them one of {', '.join(SHAPES)}", default=()
    ),
    *(
        Parameter(f"obstacle_{name}", list[float], text, default=np.zeros(0))
        for name, text in _OBSTACLES.items()
    ),
)


@dataclass(frozen=True, eq=False)
class CollisionConfiguration:
    """Checked parameters of the collision avoidance; arrays of shape (n,) in `joints` order.

    Attributes:
        settings: distances and speeds.
        pairs: of links to keep apart; None to choose them automatically.
        posture: free of collisions, rad.
        q_min: position limits, rad: within them links are looked for in each other's way.
        q_max: rad.
        a_min: acceleration limits, rad/s^2.
        a_max: rad/s^2.
        obstacles: in the base frame.
    """

    settings: CollisionSettings
    pairs: tuple[tuple[str, str], ...] | None
    posture: np.ndarray
    q_min: np.ndarray
    q_max: np.ndarray
    a_min: np.ndarray
    a_max: np.ndarray
    obstacles: tuple[CollisionBody, ...]


def collision_configuration(
    values: Mapping[str, Any], joints: Sequence[str], q_min: np.ndarray, q_max: np.ndarray
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
    settings = CollisionSettings(
        *(values[f"collision_{field.name}"] for field in fields(CollisionSettings))
    )
    obstacles = _obstacles(values)
    pairs = tuple(_pair(text) for text in values["collision_pairs"])
    posture = _posture(values, joints, q_min, q_max)
    if not values["collision_avoidance"]:
        return None
    return CollisionConfiguration(
        settings=settings,
        pairs=pairs or None,
        posture=posture,
        q_min=q_min,
        q_max=q_max,
        a_min=per_joint(values, "acceleration_min", joints),
        a_max=per_joint(values, "acceleration_max", joints),
        obstacles=obstacles,
    )


def load_collision(
    values: Mapping[str, Any],
    config: CollisionConfiguration | None,
    urdf: str,
    model: pin.Model,
) -> CollisionAvoidance | None:
    """Return the collision avoidance of an arm, or None without one.

    Args:
        values: parameter values by name.
        config: made of them.
        urdf: text of the URDF.
        model: made of it.

    Raises:
        SettingError: collision geometry that does not load, or a link that there is not.
    """
    if config is None:
        return None
    limited = model.copy()
    limited.lowerPositionLimit, limited.upperPositionLimit = config.q_min, config.q_max
    kept = config.settings.kept
    try:
        geometry = load_geometry(urdf, model, locked_joints(values))
        collision = build_collision_model(
            limited,
            geometry,
            config.posture,
            config.obstacles,
            config.pairs,
            values["base_frame"],
            Pruning(clearance=kept + _BEYOND, near=kept + _NEAR),
        )
        dt = HORIZON / values["rate_hz"]
        return CollisionAvoidance(collision, config.a_min, config.a_max, dt, config.settings)
    except RobotDescriptionError as error:
        allowed = f"a URDF whose collision geometry loads ({error})"
        raise SettingError("robot_description", values["robot_description"], allowed) from error


def _obstacles(values: Mapping[str, Any]) -> tuple[CollisionBody, ...]:
    names = values["obstacle_names"]
    if len(set(names)) != len(names) or "" in names:
        raise SettingError("obstacle_names", names, "names, each once")
    if len(values["obstacle_shapes"]) != len(names):
        allowed = f"{len(names)} shapes, one for each of 'obstacle_names'"
        raise SettingError("obstacle_shapes", values["obstacle_shapes"], allowed)
    columns = []
    for key, each in (("sizes", 3), ("positions", 3), ("orientations", 4)):
        numbers = values[f"obstacle_{key}"]
        if key == "orientations" and not len(numbers):
            numbers = np.tile([0.0, 0.0, 0.0, 1.0], len(names))
        if len(numbers) != each * len(names):
            allowed = f"{each * len(names)} numbers, {each} for each of 'obstacle_names'"
            raise SettingError(f"obstacle_{key}", numbers, allowed)
        columns.append(numbers.reshape(-1, each))
    obstacles = []
    for row in zip(names, values["obstacle_shapes"], *columns, strict=True):
        try:
            obstacles.append(make_obstacle(*row))
        except SettingError as error:
            field = error.name.split()[0].removesuffix("s")
            raise SettingError(f"obstacle_{field}s", error.value, error.allowed) from error
    return tuple(obstacles)


def _pair(text: str) -> tuple[str, str]:
    links = text.split()
    if len(links) != 2:
        raise SettingError("collision_pairs", text, "two links, as in 'link_a link_b'")
    return links[0], links[1]


def _posture(
    values: Mapping[str, Any], joints: Sequence[str], q_min: np.ndarray, q_max: np.ndarray
) -> np.ndarray:
    if len(values["collision_posture"]):
        posture = per_joint(values, "collision_posture", joints)
        if not ((q_min <= posture) & (posture <= q_max) & np.isfinite(posture)).all():
            raise SettingError("collision_posture", posture, "within the position limits")
        return posture
    limited = np.isfinite(q_min) & np.isfinite(q_max)
    return np.where(limited, 0.5 * (np.where(limited, q_min, 0.0) + q_max), 0.0)
