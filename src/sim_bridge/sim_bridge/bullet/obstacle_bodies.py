# SPDX-License-Identifier: Apache-2.0
"""Obstacles in a PyBullet world, and their forces on the robot in it.

The surface of an obstacle has no mass and moves by x against a spring and a damper,

    F = k x+ + d v+,    x+ = x + h v+,

with F the force of the robot: it is implicit and thus stable for every stiffness. PyBullet
moves a body of mass m by m (v+ - v) = h (F + f), which is the same for

    m = h d + h^2 k,    f = -k x - (d + h k) v.

Along the surface PyBullet's contacts are frictionless; `contact_friction` has Coulomb's law.
docs/simulated_robot.md tells why.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_bridge.bullet.client import BulletClient, pybullet
from sim_bridge.bullet.contact_friction import CONTACT_POINT, Bristle
from sim_bridge.bullet.obstacles import (
    Contact,
    ContactMaterial,
    LinkWrench,
    Obstacle,
    ObstacleError,
)
from viability_bounds_pkg.robot.description import RobotDescriptionError

Array = NDArray[Any]
Kept = TypeVar("Kept")

_OVERLAP_MAX = 1e-3  # m, with the robot, of an obstacle that is new
_RELEASED = 1e-9  # m; a surface that is nearer to its place is put there
_OBSTACLES_MEET_ROBOTS = (64, 1)  # collision group of the former, that of the latter
_INERTIA = 1e15  # kg m^2: surfaces do not turn
# m/s of all constraints for each N (rad/s, N m), while there are obstacles: Dantzig's solver finds
# no solution for four points under a flat hand, one more than is needed.
_SOFTNESS = 1e-11


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
        self._hold = [-self._mass * x for x in gravity]
        self._surfaces: dict[str, _Surface] = {}
        self._by_body: dict[int, _Surface] = {}
        self._bristles: dict[_Touching, Bristle] = {}
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
        shape = bullet.createCollisionShape(**shape_arguments(obstacle))
        body = bullet.createMultiBody(
            baseMass=self._mass,
            baseCollisionShapeIndex=shape,
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
        bullet.setCollisionFilterGroupMask(body, -1, *_OBSTACLES_MEET_ROBOTS)
        bullet.setPhysicsEngineParameter(globalCFM=_SOFTNESS)
        surface = _Surface(obstacle, body)
        self._surfaces[obstacle.name] = self._by_body[body] = surface
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
        for key in [key for key in self._bristles if key.body == surface.body]:
            del self._bristles[key]
        self._bullet.removeBody(surface.body)
        if not self._surfaces:
            self._bullet.setPhysicsEngineParameter(globalCFM=0.0)
        return True

    def follow(self, body: int, links: Mapping[int, str]) -> None:
        """Go on with the robot loaded anew; contacts go on, too.

        Args:
            body: the robot in PyBullet.
            links: names of its links, by PyBullet's indices.
        """
        indices = {link: index for index, link in links.items()}

        def renamed(old: Mapping[_Touching, Kept]) -> dict[_Touching, Kept]:
            return {
                key._replace(link=indices[self._links[key.link]]): kept
                for key, kept in old.items()
            }

        self._bristles, self._friction = renamed(self._bristles), renamed(self._friction)
        self._body, self._links = body, links

    def clear(self) -> None:
        """Remove all obstacles."""
        for name in list(self._surfaces):
            self.remove(name)

    def before_step(self) -> None:
        """Apply the forces of springs, dampers and friction in the next step."""
        bullet, material = self._bullet, self._material
        k, c = material.stiffness, material.damping + self._dt * material.stiffness
        touched = {key.body for key in self._bristles}
        for surface in self._by_body.values():
            body, place = surface.body, surface.place
            push: Sequence[float] = self._hold
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
        for key, bristle in self._bristles.items():
            centre, *_, v, omega = bullet.getLinkState(self._body, key.link, 1, 1)
            motion = np.array((*centre, *v, *omega)).reshape(3, 3)
            bristle.update(motion)
            force, point = bristle.force.copy(), bristle.point.copy()
            bullet.applyExternalForce(
                self._body, key.link, force.tolist(), point.tolist(), pybullet.WORLD_FRAME
            )
            self._friction[key] = LinkWrench(self._links[key.link], point, force)

    def reset(self) -> None:
        """Release the robot, and reset the largest force."""
        self.force = self.force_max = 0.0
        self._bristles.clear()
        self._friction.clear()
        for surface in self._by_body.values():
            if surface.moved:
                self._put_back(surface)

    def _put_back(self, surface: _Surface) -> None:
        none = (0.0, 0.0, 0.0)
        _, orientation = self._bullet.getBasePositionAndOrientation(surface.body)
        self._bullet.resetBasePositionAndOrientation(surface.body, surface.place, orientation)
        self._bullet.resetBaseVelocity(surface.body, none, none)
        surface.moved = False

    def after_step(self) -> None:
        """Read the contacts of the step."""
        found: dict[_Touching, list[tuple[Any, ...]]] = {}
        for contact in self._bullet.getContactPoints(self._body):
            _, _, body, link, _, position, _, normal, _, pressure, *_ = contact
            if pressure > 0.0 and body in self._by_body:
                row = (*position, *normal, pressure)
                found.setdefault(_Touching(link, body), []).append(row)
        known, total = self._bristles, dict[int, Array]()
        self._bristles = {
            key: known.get(key) or Bristle(self._dt, self._material) for key in found
        }
        for key, bristle in self._bristles.items():
            points = bristle.points = np.array(found[key]).view(CONTACT_POINT)[:, 0]
            total[key.body] = total.get(key.body, 0.0) + points["pressure"] @ points["normal"]
            self._by_body[key.body].moved = True
        for key, friction in self._friction.items():
            total[key.body] = total.get(key.body, 0.0) + friction.force
        self.force = max((float(np.linalg.norm(force)) for force in total.values()), default=0.0)
        self.force_max = max(self.force, self.force_max)

    def wrenches(self) -> list[LinkWrench]:
        """Return all wrenches of obstacles on the robot in the last physics step."""
        contacts = [
            LinkWrench(self._links[key.link], position, pressure * normal)
            for key, bristle in self._bristles.items()
            for position, normal, pressure in bristle.points
        ]
        return contacts + list(self._friction.values())

    def contacts(self) -> list[Contact]:
        """Return the contact points of the last physics step."""
        found = []
        for key, bristle in self._bristles.items():
            link, name = self._links[key.link], self._by_body[key.body].obstacle.name
            friction = self._friction.get(key)
            along = np.zeros(3) if friction is None else friction.force
            # The friction acts at the centre of pressure, as if distributed like this.
            whole = bristle.points["pressure"].sum()
            for position, normal, pressure in bristle.points:
                force = pressure * normal + pressure / whole * along
                found.append(Contact(link, name, position, normal, force))
        return found


def shape_arguments(obstacle: Obstacle) -> dict[str, Any]:
    """Return what PyBullet's `createCollisionShape` takes for an obstacle."""
    x, y, z = (0.5 * obstacle.size).tolist()
    if obstacle.shape == "box":
        return {"shapeType": pybullet.GEOM_BOX, "halfExtents": [x, y, z]}
    if obstacle.shape == "sphere":
        return {"shapeType": pybullet.GEOM_SPHERE, "radius": x}
    return {"shapeType": pybullet.GEOM_CYLINDER, "radius": x, "height": 2.0 * z}
