# SPDX-License-Identifier: Apache-2.0
"""Obstacles in a PyBullet world, and their forces on the robot in it.

The surface of an obstacle has no mass and moves by x against a spring and a damper,

    F = k x+ + d v+,    x+ = x + h v+,

with F the force of the robot: it is implicit and thus stable for every stiffness. PyBullet
moves a body of mass m by m (v+ - v) = h (F + f), which is the same for

    m = h d + h^2 k,    f = -k x - (d + h k) v.

Along the surface PyBullet's contacts are frictionless; `ContactFriction` has Coulomb's law.
docs/guides/simulation.md gives the reasons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.client import BulletClient, finite_vector, pybullet
from sim_bridge.bullet.friction import ContactFriction
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.parameter import Range, above, check, number
from viability_bounds_pkg.robot.files import RobotDescriptionError

Array = NDArray[np.float64]

SHAPES = ("box", "sphere", "cylinder")
_ROUND = {"sphere": (0, 1, 2), "cylinder": (0, 1)}  # axes along which the sizes are equal
_SIZE_MIN, _SIZE_MAX = 1e-3, 1e3  # m; beyond them PyBullet's collision detection is wrong
_OVERLAP_MAX = 1e-3  # m, with the robot, of an obstacle that is new
_RELEASED = 1e-9  # m; a surface that is nearer to its place is put there
_COLLISION_FILTER = (64, 1)  # group of obstacles, and of what they meet: robots
_INERTIA = 1e15  # kg m^2: surfaces do not turn
# m/s of all constraints for each N (rad/s, N m), while there are obstacles: Dantzig's solver finds
# no solution for four points under a flat hand, one more than is needed.
_SOFTNESS = 1e-11


class ObstacleError(ArmSafetyError, ValueError):
    """An obstacle with invalid properties, or one that overlaps the robot."""


class Obstacle:
    """A fixed solid in the world of a robot.

    Args:
        name: identifies it; not empty.
        shape: box, sphere or cylinder, the last along its z axis.
        size: lengths or diameters along its own axes, as the `scale` of an RViz marker, shape
            (3,), m, from 1 mm to 1 km; equal along the axes of a circular section.
        position: of its centre in the frame of the robot's root link, shape (3,), m.
        orientation: in that frame, quaternion x, y, z, w, shape (4,), of any length but zero; it
            is stored with length one.

    Raises:
        ObstacleError: one of them is invalid.
    """

    def __init__(
        self,
        name: str,
        shape: str,
        size: ArrayLike,
        position: ArrayLike,
        orientation: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        if not name:
            raise ObstacleError("an obstacle needs a name")
        self.name, self.shape = name, shape
        if shape not in SHAPES:
            raise self._error(f"its shape is {shape!r}, none of {', '.join(SHAPES)}")
        try:
            self.size = finite_vector("size", size, 3)
            self.position = finite_vector("position", position, 3)
            self.orientation = finite_vector("orientation", orientation, 4)
        except (ValueError, TypeError) as error:
            raise self._error(str(error)) from error
        if np.any(self.size < _SIZE_MIN) or np.any(self.size > _SIZE_MAX):
            raise self._error(f"its size is {self.size.tolist()} m, not 1 mm to 1 km")
        if len({float(self.size[axis]) for axis in _ROUND.get(shape, ())}) > 1:
            raise self._error(f"a {shape} is round, not {self.size.tolist()} m")
        length = math.hypot(*self.orientation)
        if not (1e-6 < length < 1e6):
            raise self._error(f"its orientation {self.orientation.tolist()} is no quaternion")
        self.orientation = self.orientation / length

    def _error(self, reason: str) -> ObstacleError:
        return ObstacleError(f"obstacle {self.name!r}: {reason}")

    def pybullet_shape(self) -> dict[str, Any]:
        """Return arguments of PyBullet's `createCollisionShape`."""
        x, y, z = (0.5 * self.size).tolist()
        if self.shape == "box":
            return {"shapeType": pybullet.GEOM_BOX, "halfExtents": [x, y, z]}
        if self.shape == "sphere":
            return {"shapeType": pybullet.GEOM_SPHERE, "radius": x}
        return {"shapeType": pybullet.GEOM_CYLINDER, "radius": x, "height": 2.0 * z}


class LinkWrench(NamedTuple):
    """An external wrench on a link of the robot, in world axes."""

    link: str
    point: Array | None  # where the force acts, shape (3,), m; None: the link's origin
    force: Array  # shape (3,), N
    torque: Array = np.zeros(3)  # shape (3,), N m


class Contact(NamedTuple):
    """A contact point between robot and obstacle, in the frame of the robot's root link."""

    link: str  # the first of those that move as one with the touching one
    obstacle: str
    position: Array  # of the point on the robot, shape (3,), m
    normal: Array  # from the obstacle to the robot, shape (3,)
    force: Array  # of the obstacle on the robot, shape (3,), N


@dataclass(frozen=True)
class ContactMaterial:
    """Friction, stiffness and damping of obstacles; each obstacle moves as a whole.

    Raises:
        SettingError: a value is out of range; named as the node's parameters.
    """

    friction: float = number(
        "Coulomb's coefficient between robot and obstacles", Range(0.0, 10.0), default=0.5
    )
    stiffness: float = number(
        "stiffness of obstacles, N/m; 2e5: 0.5 mm at 100 N", above(0.0, 1e9), default=2e5
    )
    damping: float = number("damping of obstacles, N s/m", Range(0.0, 1e9), default=600.0)

    def __post_init__(self) -> None:
        """Check the values."""
        check(self, "obstacle_")


class _Touching(NamedTuple):
    """PyBullet's indices of a link and of an obstacle that touch each other."""

    link: int
    body: int


class _Surface:
    """The body of an obstacle."""

    def __init__(self, obstacle: Obstacle, body: int) -> None:
        self.obstacle, self.body = obstacle, body
        self.place = tuple(obstacle.position.tolist())
        self.moved = False


class BulletObstacles:
    """The obstacles of one robot.

    Args:
        bullet: the physics client.
        body: the robot in that client.
        links: names of its links, by PyBullet's indices.
        material: of the obstacles.
        physics_dt: the physics step, s.
        gravity: shape (3,), m/s^2.
        missing: collision shapes of the robot that are not there; with any there can be no
            obstacles.

    Attributes:
        force: the largest that one obstacle exerted in the last physics step, N.
        force_max: the same of all steps since the last reset, N.
    """

    def __init__(
        self,
        bullet: BulletClient,
        body: int,
        links: Mapping[int, str],
        material: ContactMaterial,
        physics_dt: float,
        gravity: Sequence[float],
        missing: Sequence[str],
    ) -> None:
        self._bullet, self._body, self._links, self._missing = bullet, body, links, missing
        self._material, self._dt = material, physics_dt
        self._mass = physics_dt * (material.damping + physics_dt * material.stiffness)
        self._weight = [-self._mass * x for x in gravity]
        self._surfaces: dict[str, _Surface] = {}
        self._by_body: dict[int, _Surface] = {}
        self._touching: dict[_Touching, ContactFriction] = {}
        self._friction: dict[_Touching, LinkWrench] = {}
        self.force = self.force_max = 0.0

    def __len__(self) -> int:
        """Return the number of obstacles."""
        return len(self._surfaces)

    @property
    def present(self) -> dict[str, Obstacle]:
        """All obstacles, by name."""
        return {name: surface.obstacle for name, surface in self._surfaces.items()}

    def add(self, obstacle: Obstacle) -> None:
        """Add an obstacle, replacing the one of its name if there is one.

        Raises:
            RobotDescriptionError: collision shapes of the robot are missing.
            ObstacleError: it overlaps the robot.
        """
        if self._missing:
            raise RobotDescriptionError(
                f"collision shapes are missing: {'; '.join(self._missing)}"
            )
        bullet = self._bullet
        self.remove(obstacle.name)
        body = bullet.createMultiBody(
            baseMass=self._mass,
            baseCollisionShapeIndex=bullet.createCollisionShape(**obstacle.pybullet_shape()),
            basePosition=obstacle.position.tolist(),
            baseOrientation=obstacle.orientation.tolist(),
        )
        bullet.changeDynamics(
            body,
            -1,
            localInertiaDiagonal=[_INERTIA] * 3,
            lateralFriction=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
        )
        bullet.setCollisionFilterGroupMask(body, -1, *_COLLISION_FILTER)
        bullet.setPhysicsEngineParameter(globalCFM=_SOFTNESS)
        self._surfaces[obstacle.name] = self._by_body[body] = _Surface(obstacle, body)
        near = bullet.getClosestPoints(self._body, body, 0.0)
        overlap = -min((point[8] for point in near), default=0.0)  # the signed distance
        if overlap > _OVERLAP_MAX:
            self.remove(obstacle.name)
            raise ObstacleError(
                f"obstacle {obstacle.name!r} overlaps the robot by {1e3 * overlap:.1f} mm"
            )

    def remove(self, name: str) -> bool:
        """Remove an obstacle; return whether there was one of that name."""
        surface = self._surfaces.pop(name, None)
        if surface is None:
            return False
        del self._by_body[surface.body]
        self.force = 0.0
        for key in [key for key in self._touching if key.body == surface.body]:
            del self._touching[key]
        self._bullet.removeBody(surface.body)
        if not self._surfaces:
            self._bullet.setPhysicsEngineParameter(globalCFM=0.0)
        return True

    def clear(self) -> None:
        """Remove all obstacles."""
        for name in list(self._surfaces):
            self.remove(name)

    def reset(self) -> None:
        """Release the robot, and reset the largest force."""
        self.force = self.force_max = 0.0
        self._touching.clear()
        self._friction.clear()
        for surface in self._by_body.values():
            if surface.moved:
                self._put_back(surface)

    def before_step(self) -> None:
        """Apply the forces of springs, dampers and friction in the next step."""
        bullet, material = self._bullet, self._material
        k, c = material.stiffness, material.damping + self._dt * material.stiffness
        touched = {key.body for key in self._touching}
        for surface in self._by_body.values():
            body, place = surface.body, surface.place
            push: Sequence[float] = self._weight
            if surface.moved:
                place, _ = bullet.getBasePositionAndOrientation(body)
                v, _ = bullet.getBaseVelocity(body)
                x = [a - b for a, b in zip(place, surface.place, strict=True)]
                if body not in touched and max(map(abs, x)) < _RELEASED:
                    self._put_back(surface)
                    x = v = [0.0, 0.0, 0.0]
                push = [f - k * s - c * w for f, s, w in zip(push, x, v, strict=True)]
            bullet.applyExternalForce(body, -1, push, place, pybullet.WORLD_FRAME)
        self._friction.clear()
        for key, friction in self._touching.items():
            centre, *_, v, omega = bullet.getLinkState(self._body, key.link, 1, 1)
            friction.update(*map(np.array, (centre, v, omega)))
            force, point = friction.force, friction.point
            bullet.applyExternalForce(
                self._body, key.link, force.tolist(), point.tolist(), pybullet.WORLD_FRAME
            )
            self._friction[key] = LinkWrench(self._links[key.link], point, force)

    def after_step(self) -> None:
        """Read the contacts of the step."""
        found: dict[_Touching, list[tuple[Any, ...]]] = {}
        for contact in self._bullet.getContactPoints(self._body):
            _, _, body, link, _, position, _, normal, _, pressure, *_ = contact
            if pressure > 0.0 and body in self._by_body:
                row = (*position, *normal, pressure)
                found.setdefault(_Touching(link, body), []).append(row)
        known, material, total = self._touching, self._material, dict[int, Array]()
        self._touching = {
            key: known.get(key) or ContactFriction(self._dt, material.friction, material.stiffness)
            for key in found
        }
        for key, friction in self._touching.items():
            points = friction.points = np.array(found[key])
            total[key.body] = total.get(key.body, 0.0) + points[:, 6] @ points[:, 3:6]
            self._by_body[key.body].moved = True
        for key, wrench in self._friction.items():
            total[key.body] = total.get(key.body, 0.0) + wrench.force
        self.force = max((float(np.linalg.norm(force)) for force in total.values()), default=0.0)
        self.force_max = max(self.force, self.force_max)

    def _put_back(self, surface: _Surface) -> None:
        none = (0.0, 0.0, 0.0)
        _, orientation = self._bullet.getBasePositionAndOrientation(surface.body)
        self._bullet.resetBasePositionAndOrientation(surface.body, surface.place, orientation)
        self._bullet.resetBaseVelocity(surface.body, none, none)
        surface.moved = False

    def wrenches(self) -> list[LinkWrench]:
        """Return all wrenches of obstacles on the robot in the last physics step."""
        contacts = [
            LinkWrench(self._links[key.link], point[:3], point[6] * point[3:6])
            for key, friction in self._touching.items()
            for point in friction.points
        ]
        return contacts + list(self._friction.values())

    def contacts(self) -> list[Contact]:
        """Return the contact points of the last physics step."""
        found = []
        for key, touching in self._touching.items():
            link, name = self._links[key.link], self._by_body[key.body].obstacle.name
            friction = self._friction.get(key)
            along = np.zeros(3) if friction is None else friction.force
            # The friction acts at the centre of pressure, as if distributed like this.
            whole = touching.points[:, 6].sum()
            for point in touching.points:
                normal, pressure = point[3:6], point[6]
                force = pressure * normal + pressure / whole * along
                found.append(Contact(link, name, point[:3], normal, force))
        return found
