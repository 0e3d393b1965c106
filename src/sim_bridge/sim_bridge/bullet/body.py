# SPDX-License-Identifier: Apache-2.0
"""The links of a robot in a PyBullet world, with external wrenches, obstacles and a sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import fromstring

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.force_torque_sensor import ForceTorqueSensor
from sim_bridge.bullet.obstacles import Contact, ContactMaterial, LinkWrench, Obstacle
from sim_bridge.bullet.vectors import finite_vector
from sim_bridge.bullet.world import BulletWorld
from sim_bridge.urdf.links import carried_links
from sim_bridge.urdf.preparation import FramePlacement, prepare_urdf
from viability_bounds_pkg.robot_description import RobotDescriptionError

Array = NDArray[np.float64]


class BulletBody:
    """The links of a robot fixed to the ground, in a world of its own with obstacles.

    Args:
        urdf_text: the URDF.
        joints: names of the n joints that move.
        physics_dt: the physics step, s.
        locked_positions: where other joints are locked, rad or m; those left out are at zero.
        gravity: acceleration of gravity in the base frame, m/s^2.
        mass_scales: factors for mass and inertia of links, by name.
        collisions: load the collision shapes, meshes as their convex hulls, for contacts.
        material: of obstacles; stiff, with a friction of 0.5, by default.
        sensor_frame: link that is a force/torque sensor; no sensor if empty.
        rotor_inertias: of `prepare_urdf`.

    Attributes:
        description: URDF, moving joints, and where others are locked.
        client_id: PyBullet's physics client.
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
        collisions: bool = True,
        material: ContactMaterial | None = None,
        sensor_frame: str = "",
        rotor_inertias: Mapping[str, float] | None = None,
    ) -> None:
        if not (math.isfinite(physics_dt) and physics_dt > 0.0):
            raise ValueError(f"physics_dt must be positive and finite, not {physics_dt}")
        self.joints, self.physics_dt = tuple(joints), physics_dt
        self.description = urdf_text, self.joints, dict(locked_positions or {})
        gravity_vector = finite_vector("gravity", gravity, 3)
        prepared = prepare_urdf(
            urdf_text,
            joints,
            locked_positions,
            collisions=collisions,
            apart=carried_links(fromstring(urdf_text), sensor_frame) if sensor_frame else (),
            mass_scales=mass_scales,
            rotor_inertias=rotor_inertias,
        )
        self._frames = prepared.frames
        self._missing_shapes = "; ".join(prepared.missing) if collisions else "not loaded"
        self._wrenches: dict[str, LinkWrench] = {}
        self._world = BulletWorld(
            prepared,
            self.joints,
            physics_dt,
            gravity_vector.tolist(),
            material or ContactMaterial(),
        )
        self._sensor: ForceTorqueSensor | None = None
        if sensor_frame:
            self._sensor = ForceTorqueSensor(
                urdf_text,
                sensor_frame,
                self.joints,
                locked_positions,
                mass_scales,
                gravity_vector,
                physics_dt,
            )
        self.client_id, self.body_id = self._world.client_id, self._world.body_id

    def apply_wrench(self, link: str, force: ArrayLike, torque: ArrayLike) -> None:
        """Apply a wrench to a link, from the next physics step until `clear_wrenches`.

        Wrenches on several links add up; a new one on the same link replaces the old.

        Args:
            link: any link of the URDF; the wrench acts at its origin. On a link that stands
                still with the base it has no effect.
            force: shape (3,), N, in world-aligned axes.
            torque: shape (3,), N m, in world-aligned axes.
        """
        self._frame(link)  # or it raises
        self._wrenches[link] = LinkWrench(
            link, None, finite_vector("force", force, 3), finite_vector("torque", torque, 3)
        )

    def _apply_wrenches(self) -> None:
        """Let the wrenches act in the next physics step."""
        for wrench in self._wrenches.values():
            self._world.apply_wrench(self._frames[wrench.link], wrench)

    def clear_wrenches(self, link: str | None = None) -> None:
        """Remove the wrench on `link`, or all wrenches."""
        if link is None:
            self._wrenches.clear()
        else:
            self._wrenches.pop(link, None)

    def add_obstacle(self, obstacle: Obstacle) -> None:
        """Add an obstacle, replacing the one of its name if there is one.

        Raises:
            RobotDescriptionError: collision shapes of the robot are missing.
            ObstacleError: it overlaps the robot.
        """
        if self._missing_shapes:
            raise RobotDescriptionError(f"collision shapes are missing: {self._missing_shapes}")
        self._world.obstacles.add(obstacle)

    def remove_obstacle(self, name: str) -> bool:
        """Remove an obstacle; return whether there was one of that name."""
        return self._world.obstacles.remove(name)

    def clear_obstacles(self) -> None:
        """Remove all obstacles."""
        self._world.obstacles.clear()

    @property
    def obstacles(self) -> dict[str, Obstacle]:
        """All obstacles, by name."""
        return self._world.obstacles.present

    def contacts(self) -> list[Contact]:
        """Return the contact points with obstacles in the last physics step."""
        return self._world.obstacles.contacts()

    def contact_force(self) -> tuple[float, float]:
        """Return the largest force of an obstacle, N: in the last step, and since the reset."""
        return self._world.obstacles.force, self._world.obstacles.force_max

    def sensor_wrench(self) -> Array:
        """Return what the force/torque sensor measured in the last physics step.

        Returns:
            Force, N, and moment, N m, on the sensor of all links beyond it: contacts, external
            wrenches, weight and inertia; at the origin of `sensor_frame`, in its axes, shape (6,).
            After a reset it is that of zero accelerations.

        Raises:
            ValueError: there is no sensor.
        """
        if self._sensor is None:
            raise ValueError("the robot has no force/torque sensor")
        return self._sensor.wrench.copy()

    def _measure(self, q: Array, v: Array, v_next: Array) -> None:
        """Update the sensor, if there is one, by a step from (q, v) to v_next."""
        if self._sensor is None:
            return
        wrenches = [*self._wrenches.values(), *self._world.obstacles.wrenches()]
        self._sensor.update(q, v, v_next, wrenches)

    def link_pose(self, link: str) -> pin.SE3:
        """Return the pose of any link of the URDF in the frame of its root link.

        It is PyBullet's, at PyBullet's own joint positions.
        """
        return self._world.pose(self._frame(link))

    def close(self) -> None:
        """Disconnect from PyBullet; the robot cannot be used afterwards."""
        self._world.close()

    def _frame(self, link: str) -> FramePlacement:
        """Return the placement of `link`, or raise `RobotDescriptionError`."""
        if link not in self._frames:
            known = ", ".join(self._frames)
            raise RobotDescriptionError(f"unknown link {link!r}; the URDF has: {known}")
        return self._frames[link]
