"""The body of a robot in a PyBullet world: its links, and all that acts on them but motors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import fromstring

import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.bullet.force_torque_sensor import ForceTorqueSensor, Push
from sim_bridge.bullet.obstacles import Contact, ContactMaterial, Obstacle
from sim_bridge.bullet.vectors import finite_vector
from sim_bridge.bullet.world import BulletWorld
from sim_bridge.urdf.links import carried_links
from sim_bridge.urdf.preparation import FramePlacement, prepare_urdf
from viability_bounds_pkg.robot_description import RobotDescriptionError


class BulletBody:
    """The links of a robot fixed to the ground, alone in a world but for obstacles.

    Args:
        urdf_text: the URDF.
        joints: names of the n joints that move.
        physics_dt: the physics step, s.
        locked_positions: where other joints are locked, rad or m; those left out are at zero.
        gravity: acceleration of gravity in the base frame, m/s^2.
        mass_scales: factors for mass and inertia of links, by name.
        mechanical_stops: stop joints hard at their position limits.
        visuals: load the visual shapes, for cameras.
        collisions: load the collision shapes, meshes as their convex hulls, for contacts.
        material: of obstacles; hard, with a friction of 0.5, by default.
        sensor_frame: link that is a force/torque sensor; none if empty.
        rotor_inertias: as `prepare_urdf` has them.

    Attributes:
        description: URDF, moving joints, and where others are locked.
        client_id: PyBullet's physics client, for cameras.
        body_id: the robot in that client.

    Raises:
        RobotDescriptionError: the URDF does not load, or as `prepare_urdf` does.
        ValueError: `physics_dt` or `gravity` is out of range.
    """

    def __init__(
        self,
        urdf_text: str,
        joints: Sequence[str],
        *,
        physics_dt: float,
        locked_positions: Mapping[str, float] | None = None,
        gravity: ArrayLike = (0.0, 0.0, -9.81),
        mass_scales: Mapping[str, float] | None = None,
        mechanical_stops: bool = False,
        visuals: bool = False,
        collisions: bool = True,
        material: ContactMaterial | None = None,
        sensor_frame: str = "",
        rotor_inertias: Mapping[str, float] | None = None,
    ) -> None:
        if not (math.isfinite(physics_dt) and physics_dt > 0.0):
            raise ValueError(f"physics_dt must be positive and finite, not {physics_dt}")
        self.joints, self.physics_dt = tuple(joints), physics_dt
        self.description = urdf_text, self.joints, dict(locked_positions or {})
        gravity = finite_vector("gravity", gravity, 3)
        prepared = prepare_urdf(
            urdf_text,
            joints,
            locked_positions,
            visuals=visuals,
            collisions=collisions,
            mechanical_stops=mechanical_stops,
            apart=carried_links(fromstring(urdf_text), sensor_frame) if sensor_frame else (),
            mass_scales=mass_scales,
            rotor_inertias=rotor_inertias,
        )
        self._frames = prepared.frames
        self._shapeless = "; ".join(prepared.missing) if collisions else "none was asked for"
        self._wrenches: dict[str, tuple[FramePlacement, list[float], list[float]]] = {}
        self._world = BulletWorld(
            prepared,
            self.joints,
            physics_dt,
            gravity.tolist(),
            material or ContactMaterial(),
        )
        self._sensor = None
        if sensor_frame:
            self._sensor = ForceTorqueSensor(
                urdf_text,
                sensor_frame,
                self.joints,
                locked_positions,
                mass_scales,
                gravity,
                physics_dt,
            )
        self.client_id, self.body_id = self._world.client_id, self._world.body_id

    def apply_wrench(self, link: str, force: ArrayLike, torque: ArrayLike) -> None:
        """Push on a link, from the next physics step until `clear_wrenches`.

        Wrenches on several links add up; a new one on the same link replaces the old.

        Args:
            link: any link of the URDF; the wrench acts at its origin. On a link that stands
                still with the base it has no effect.
            force: shape (3,), N, in world-aligned axes.
            torque: shape (3,), N m, in world-aligned axes.
        """
        frame = self._frame(link)
        force, torque = finite_vector("force", force, 3), finite_vector("torque", torque, 3)
        self._wrenches[link] = frame, force.tolist(), torque.tolist()

    def clear_wrenches(self, link: str | None = None) -> None:
        """Take the wrench on `link` off, or all wrenches."""
        if link is None:
            self._wrenches.clear()
        else:
            self._wrenches.pop(link, None)

    def add_obstacle(self, obstacle: Obstacle) -> None:
        """Put an obstacle into the world, in place of the one of its name if there is one.

        Raises:
            RobotDescriptionError: the robot's collision shapes are not all there.
            ObstacleError: the robot is where it should be.
        """
        if self._shapeless:
            raise RobotDescriptionError(f"collision shapes are missing: {self._shapeless}")
        self._world.obstacles.add(obstacle)

    def remove_obstacle(self, name: str) -> bool:
        """Take an obstacle out of the world; return whether there was one of that name."""
        return self._world.obstacles.remove(name)

    def clear_obstacles(self) -> None:
        """Take all obstacles out of the world."""
        self._world.obstacles.clear()

    @property
    def obstacles(self) -> dict[str, Obstacle]:
        """All obstacles, by name."""
        return self._world.obstacles.present

    def contacts(self) -> list[Contact]:
        """Return where obstacles pushed on the robot in the last physics step."""
        return self._world.obstacles.contacts()

    def contact_force(self) -> tuple[float, float]:
        """Return the largest force of an obstacle, N: in the last step, and since the reset."""
        return self._world.obstacles.force, self._world.obstacles.force_max

    def sensor_wrench(self) -> np.ndarray:
        """Return what the force/torque sensor felt in the last physics step.

        Returns:
            Force, N, and moment, N m, on the sensor of all that is mounted on it: contacts and
            pushes, weight and inertia; at the origin of `sensor_frame`, in its axes, shape (6,).
            Right after a reset it is what it would feel if nothing accelerated.

        Raises:
            ValueError: there is no sensor.
        """
        if self._sensor is None:
            raise ValueError("the robot has no force/torque sensor")
        return self._sensor.wrench.copy()

    def _feel(self, q: np.ndarray, v: np.ndarray, v_next: np.ndarray) -> None:
        """Let the sensor feel a step from (q, v) to v_next; see `ForceTorqueSensor`."""
        pushes = [Push(link, None, *wrench[1:]) for link, wrench in self._wrenches.items()]
        pushes += [Push(*force) for force in self._world.obstacles.forces()]
        self._sensor.update(q, v, v_next, pushes)

    def link_pose(self, link: str) -> tuple[np.ndarray, np.ndarray]:
        """Return where a link is, by PyBullet's own joint positions.

        Returns:
            Position, shape (3,), m, and orientation, shape (4,), a quaternion x, y, z, w, of
            any link of the URDF in the frame of its root link.
        """
        return self._world.pose(self._frame(link))

    def close(self) -> None:
        """Leave the physics world; after that the robot is of no more use."""
        self._world.close()

    def _frame(self, link: str) -> FramePlacement:
        """Return the placement of `link`, or raise `RobotDescriptionError`."""
        if link not in self._frames:
            known = ", ".join(self._frames)
            raise RobotDescriptionError(f"unknown link {link!r}; the URDF has: {known}")
        return self._frames[link]
