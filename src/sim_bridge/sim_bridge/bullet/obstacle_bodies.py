"""Obstacles in a PyBullet world, and what they do to the robot in it.

An obstacle is hard, but not rigid: rigid ones would leave open how hard a robot with friction in
its joints presses on them, and the solver, for which one solution is as good as another, would
jump about between them. Its surface has no mass and moves by x against a spring and a damper,

    F = k x+ + d v+,    x+ = x + h v+,

with F the force of the robot: it is implicit and thus stable however stiff it is. PyBullet
moves a body of mass m by m (v+ - v) = h (F + f), which is the same for

    m = h d + h^2 k,    f = -k x - (d + h k) v.

Along the surface PyBullet lets the robot slide: its Dantzig solver replaces the cone of Coulomb's
law by a box, whose size is that of the pressure without friction. `contact_friction` has that law.

Four points under a flat hand are one more than it takes, and Dantzig's solver finds no solution.
It does when there is some softness in all constraints; it is far too little to be noticed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sim_bridge.bullet.contact_friction import Bristle
from sim_bridge.bullet.obstacles import Contact, ContactMaterial, Obstacle, ObstacleError
from sim_bridge.bullet.quiet_pybullet import pybullet

_OVERLAP_MAX = 1e-3  # m, with the robot, of an obstacle that is new
_RELEASED = 1e-9  # m; a surface that is nearer to its place is put there
_OBSTACLES_MEET_ROBOTS = (64, 1)  # collision group of the former, that of the latter
_INERTIA = 1e15  # kg m^2: surfaces do not turn
_SOFTNESS = 1e-11  # m/s of all constraints for each N (rad/s, N m), while there are obstacles


class LinkForce(NamedTuple):
    """A force on a link of the robot."""

    link: str
    point: np.ndarray  # shape (3,), m
    force: np.ndarray  # shape (3,), N


class _Surface:
    """An obstacle in the world."""

    def __init__(self, obstacle: Obstacle, body: int) -> None:
        self.obstacle, self.body = obstacle, body
        self.place = tuple(obstacle.position.tolist())
        self.moved = False


class BulletObstacles:
    """The obstacles of one robot.

    Args:
        bullet: PyBullet's functions, bound to a physics client.
        body: the robot in that client.
        links: names of its links, by PyBullet's indices.
        material: of the obstacles.
        physics_dt: the physics step, s.
        gravity: shape (3,), m/s^2.

    Attributes:
        force: the largest that one obstacle exerted in the last physics step, N.
        force_max: the same of all steps since the last reset, N.
    """

    def __init__(
        self,
        bullet: Any,
        body: int,
        links: Mapping[int, str],
        material: ContactMaterial,
        physics_dt: float,
        gravity: Sequence[float],
    ) -> None:
        self._bullet, self._body, self._links = bullet, body, links
        self._material, self._dt = material, physics_dt
        self._mass = physics_dt * (material.damping + physics_dt * material.stiffness)
        self._hold = [-self._mass * x for x in gravity]
        self._surfaces: dict[str, _Surface] = {}
        self._by_body: dict[int, _Surface] = {}
        # By link and body of the obstacle, of those in touch.
        self._bristles: dict[tuple[int, int], Bristle] = {}
        self._points: dict[tuple[int, int], np.ndarray] = {}
        self.force = self.force_max = 0.0
        self._friction: list[tuple[tuple[int, int], LinkForce]] = []

    def __len__(self) -> int:
        return len(self._surfaces)

    @property
    def present(self) -> dict[str, Obstacle]:
        """All obstacles, by name."""
        return {name: surface.obstacle for name, surface in self._surfaces.items()}

    def add(self, obstacle: Obstacle) -> None:
        """Put an obstacle into the world, in place of the one of its name if there is one.

        Raises:
            ObstacleError: the robot is there.
        """
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
        overlap = -min((point[8] for point in near), default=0.0)
        if overlap > _OVERLAP_MAX:
            self.remove(obstacle.name)
            raise ObstacleError(
                f"obstacle {obstacle.name!r} overlaps the robot by {1e3 * overlap:.1f} mm"
            )

    def remove(self, name: str) -> bool:
        """Take an obstacle out of the world; return whether there was one of that name."""
        surface = self._surfaces.pop(name, None)
        if surface is None:
            return False
        del self._by_body[surface.body]
        self.force = 0.0
        for key in [key for key in self._bristles if key[1] == surface.body]:
            del self._bristles[key]
            self._points.pop(key, None)
        self._bullet.removeBody(surface.body)
        if not self._surfaces:
            self._bullet.setPhysicsEngineParameter(globalCFM=0.0)
        return True

    def clear(self) -> None:
        """Take all obstacles out of the world."""
        for name in list(self._surfaces):
            self.remove(name)

    def before_step(self) -> None:
        """Let springs, dampers and friction act in the step to come."""
        bullet = self._bullet
        k, c = (
            self._material.stiffness,
            self._material.damping + self._dt * self._material.stiffness,
        )
        touched = {body for _, body in self._bristles}
        for surface in self._by_body.values():
            body, place, force = surface.body, surface.place, self._hold
            if surface.moved:
                place, _ = bullet.getBasePositionAndOrientation(body)
                v, _ = bullet.getBaseVelocity(body)
                x = [a - b for a, b in zip(place, surface.place, strict=True)]
                if body not in touched and max(map(abs, x)) < _RELEASED:
                    self._put_back(surface)
                    x = v = (0.0, 0.0, 0.0)
                force = [f - k * s - c * w for f, s, w in zip(force, x, v, strict=True)]
            bullet.applyExternalForce(body, -1, force, place, pybullet.WORLD_FRAME)
        self._friction.clear()
        for key, bristle in self._bristles.items():
            link, _ = key
            state = bullet.getLinkState(self._body, link, 1, 1)  # kinematics of now
            motion = np.array((*state[0], *state[6], *state[7]))
            bristle.update(self._points[key], motion, self._material.friction)
            force, point = bristle.force.copy(), bristle.point.copy()
            bullet.applyExternalForce(
                self._body, link, force.tolist(), point.tolist(), pybullet.WORLD_FRAME
            )
            self._friction.append((key, LinkForce(self._links[link], point, force)))

    def reset(self) -> None:
        """Let go of the robot, and forget how hard it was pushed."""
        self.force = self.force_max = 0.0
        self._bristles.clear()
        self._points.clear()
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
        """See where the robot was touched in the step."""
        rows: dict[tuple[int, int], list[tuple[float, ...]]] = {}
        for point in self._bullet.getContactPoints(self._body):
            if point[9] > 0.0 and point[2] in self._by_body:
                rows.setdefault((point[3], point[2]), []).append((*point[5], *point[7], point[9]))
        self._points = {key: np.array(value) for key, value in rows.items()}
        known = self._bristles
        self._bristles = {
            key: known.get(key) or Bristle(self._dt, self._material.stiffness) for key in rows
        }
        total: dict[int, np.ndarray] = {}
        for key, points in self._points.items():
            total[key[1]] = total.get(key[1], 0.0) + points[:, 6] @ points[:, 3:6]
            self._by_body[key[1]].moved = True
        for (_, body), friction in self._friction:
            total[body] = total.get(body, 0.0) + friction.force
        self.force = max((float(np.linalg.norm(force)) for force in total.values()), default=0.0)
        self.force_max = max(self.force, self.force_max)

    def forces(self) -> list[LinkForce]:
        """Return all that acted on the robot in the last physics step."""
        pressures = [
            LinkForce(self._links[link], row[:3], row[6] * row[3:6])
            for (link, _), rows in self._points.items()
            for row in rows
        ]
        return pressures + [force for _, force in self._friction]

    def contacts(self) -> list[Contact]:
        """Return where the robot was touched in the last physics step."""
        found = []
        friction = dict(self._friction)
        for key, rows in self._points.items():
            link, body = key
            along = friction[key].force if key in friction else np.zeros(3)
            for row in rows:
                position, normal, pressure = row[:3], row[3:6], row[6]
                # The friction acts at the centre of pressure, as if it were shared out like this.
                force = pressure * normal + pressure / rows[:, 6].sum() * along
                name = self._by_body[body].obstacle.name
                found.append(Contact(self._links[link], name, position, normal, force))
        return found


def shape_arguments(obstacle: Obstacle) -> dict[str, Any]:
    """Return what PyBullet's `createCollisionShape` takes for an obstacle."""
    x, y, z = (0.5 * obstacle.size).tolist()
    if obstacle.shape == "box":
        return {"shapeType": pybullet.GEOM_BOX, "halfExtents": [x, y, z]}
    if obstacle.shape == "sphere":
        return {"shapeType": pybullet.GEOM_SPHERE, "radius": x}
    return {"shapeType": pybullet.GEOM_CYLINDER, "radius": x, "height": 2.0 * z}
