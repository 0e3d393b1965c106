"""Obstacles in a PyBullet world, and what they do to the robot in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_bridge.obstacles import Contact, ContactMaterial, Obstacle
from sim_bridge.quiet_pybullet import pybullet


class BulletObstacles:
    """The obstacles of one robot.

    Args:
        bullet: PyBullet's functions, bound to a physics client.
        body: the robot in that client.
        links: names of its links, by PyBullet's indices.
        material: of the obstacles.
    """

    def __init__(
        self, bullet: Any, body: int, links: Mapping[int, str], material: ContactMaterial
    ) -> None:
        self._bullet, self._body, self._links = bullet, body, links
        self._material = material
        self._bodies: dict[str, int] = {}
        self._names: dict[int, str] = {}

    def __len__(self) -> int:
        return len(self._bodies)

    def add(self, obstacle: Obstacle) -> None:
        """Put an obstacle into the world, in place of the one of its name if there is one."""
        bullet = self._bullet
        self.remove(obstacle.name)
        x, _, z = obstacle.size
        if obstacle.shape == "box":
            extents = (0.5 * obstacle.size).tolist()
            shape = bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=extents)
        elif obstacle.shape == "sphere":
            shape = bullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.5 * x)
        else:
            shape = bullet.createCollisionShape(pybullet.GEOM_CYLINDER, radius=0.5 * x, height=z)
        body = bullet.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            basePosition=obstacle.position.tolist(),
            baseOrientation=obstacle.orientation.tolist(),
        )
        # PyBullet multiplies the two coefficients; the robot's links have 1.
        bullet.changeDynamics(body, -1, lateralFriction=self._material.friction)
        self._bodies[obstacle.name] = body
        self._names[body] = obstacle.name

    def remove(self, name: str) -> bool:
        """Take an obstacle out of the world; return whether there was one of that name."""
        body = self._bodies.pop(name, None)
        if body is None:
            return False
        del self._names[body]
        self._bullet.removeBody(body)
        return True

    def clear(self) -> None:
        """Take all obstacles out of the world."""
        for name in list(self._bodies):
            self.remove(name)

    def contacts(self) -> list[Contact]:
        """Return where the robot was pushed in the last physics step."""
        if not self._bodies:
            return []
        found = []
        for point in self._bullet.getContactPoints(self._body):
            _, _, other, link, _, position, _, normal, distance, pressure, *friction = point
            if other not in self._names or pressure == 0.0:
                continue
            normal = np.array(normal)
            force = pressure * normal
            for size, direction in zip(friction[::2], friction[1::2], strict=True):
                force += size * np.array(direction)
            found.append(
                Contact(
                    self._links[link],
                    self._names[other],
                    np.array(position),
                    normal,
                    force,
                    distance,
                )
            )
        return found
