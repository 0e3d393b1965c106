# SPDX-License-Identifier: Apache-2.0
"""A robot in a PyBullet world of its own, without what PyBullet adds to rigid-body dynamics.

PyBullet's Dantzig solver, a direct one, computes the constraint impulses of brakes, friction,
rotors and contacts, exact to rounding (docs/guides/simulation.md). If it finds no solution,
PyBullet falls back to sequential impulses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.client import BulletClient, finite_vector, pybullet, silenced
from sim_bridge.bullet.obstacles import BulletObstacles, ContactMaterial, LinkWrench
from sim_bridge.bullet.sensor import ForceTorqueSensor
from sim_bridge.urdf import FramePlacement, PreparedUrdf, prepare_urdf
from viability_bounds_pkg.robot.description import unknown_name
from viability_bounds_pkg.robot.files import RobotDescriptionError

Array = NDArray[np.float64]

# What PyBullet adds to rigid-body dynamics: 4 % of damping and a clip of joint velocities at 100.
_RIGID_BODY = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e9}
# Of sequential impulses. With PyBullet's defaults (50 rounds, 1e-7) a held Baxter arm creeps at
# 1.6e-3 rad/s, with these at 1.6e-7 rad/s.
_SOLVER_ITERATIONS = 500
_SOLVER_RESIDUAL = 1e-14
_GEAR_TORQUE_MAX = 1e9  # N m, beyond what any gear transmits


class BulletBody:
    """The links of a robot fixed to the ground, in a world of its own with obstacles.

    Args:
        urdf_text: the URDF.
        joints: names of the n joints that move, in the order of all arrays.
        physics_dt: the physics step, s.
        locked_positions: where other joints are locked, rad or m; those left out are at zero.
        gravity: acceleration of gravity in the base frame, m/s^2.
        mass_scales: factors for mass and inertia of links, by name.
        material: of obstacles; stiff, with a friction of 0.5, by default.
        sensor_frame: link that is a force/torque sensor; no sensor if empty.
        rotor_inertias: of `prepare_urdf`.

    Attributes:
        description: URDF, moving joints, and where others are locked.
        locked: positions of all other movable joints by name, rad or m.
        obstacles: all other bodies in the world; the collision shapes of the robot's meshes, with
            which it touches them, are their convex hulls.
        sensor: the force/torque sensor; None if there is none.
        client_id: PyBullet's physics client; -1 when closed.
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
        material: ContactMaterial | None = None,
        sensor_frame: str = "",
        rotor_inertias: Mapping[str, float] | None = None,
    ) -> None:
        if not (math.isfinite(physics_dt) and physics_dt > 0.0):
            raise ValueError(f"physics_dt must be positive and finite, not {physics_dt}")
        self.joints, self.physics_dt = tuple(joints), physics_dt
        self.description = urdf_text, self.joints, dict(locked_positions or {})
        self._gravity = finite_vector("gravity", gravity, 3)
        self._prepared = prepared = prepare_urdf(
            *self.description,
            sensor_frame=sensor_frame,
            mass_scales=mass_scales,
            rotor_inertias=rotor_inertias,
        )
        self.sensor: ForceTorqueSensor | None = None
        if sensor_frame:
            self.sensor = ForceTorqueSensor(prepared.arm, sensor_frame, self._gravity, physics_dt)
        self.locked = prepared.locked
        self._material = material or ContactMaterial()
        self._wrenches: dict[str, LinkWrench] = {}
        self._bullet = BulletClient()
        self.client_id = self._bullet.id
        self._make_world()

    def _make_world(self) -> None:
        """Make a world anew: the robot, its motors and brakes off, and no obstacles."""
        bullet = self._bullet
        bullet.resetSimulation()
        bullet.setGravity(*self._gravity.tolist())
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=self.physics_dt,
            numSolverIterations=_SOLVER_ITERATIONS,
            solverResidualThreshold=_SOLVER_RESIDUAL,
            deterministicOverlappingPairs=1,
        )
        with silenced(1):  # PyBullet prints which solver it uses
            bullet.setPhysicsEngineParameter(
                constraintSolverType=pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
            )
        self._load(self._prepared)
        self.obstacles = BulletObstacles(
            bullet,
            self.body_id,
            {index: link for link, index in self._links.items()},
            self._material,
            self.physics_dt,
            self._gravity.tolist(),
            self._prepared.missing,
        )

    def _load(self, prepared: PreparedUrdf) -> None:
        """Load the robot, its motors and brakes off."""
        bullet = self._bullet
        self._frames = prepared.frames
        try:
            self.body_id = body = bullet.load_urdf(
                prepared.text, flags=pybullet.URDF_USE_INERTIA_FROM_FILE
            )
        except pybullet.error as error:
            self.close()
            raise RobotDescriptionError(f"URDF does not load: {error}") from error
        infos = bullet.joint_infos(body)
        indices = {info.name: info.id for info in infos}
        self._indices = [indices[name] for name in self.joints]
        self._rotors = {indices[joint]: indices[rotor] for joint, rotor in prepared.rotors.items()}
        self._links = dict.fromkeys(prepared.principal_inertias, -1)  # -1 is the base
        self._links.update({info.link: info.id for info in infos})
        # In a call of its own: PyBullet ignores the link index when a value of the body is set.
        bullet.changeDynamics(body, -1, **_RIGID_BODY)
        for link, index in self._links.items():
            inertia = prepared.principal_inertias[link].tolist()
            bullet.changeDynamics(body, index, localInertiaDiagonal=inertia, lateralFriction=1.0)
        control = partial(bullet.setJointMotorControlArray, body, self._indices)
        self._apply_torques = partial(control, pybullet.TORQUE_CONTROL)
        self._apply_brakes = partial(control, pybullet.VELOCITY_CONTROL)
        # For each joint: position, velocity, reaction, and the torque that its brake applied.
        self._joint_states = partial(bullet.getJointStates, body, self._indices)
        for info in infos:  # PyBullet starts with the motors on
            if info.kind != pybullet.JOINT_FIXED:
                bullet.setJointMotorControl2(body, info.id, pybullet.VELOCITY_CONTROL, force=0.0)
        for joint, rotor in self._rotors.items():
            self._couple(joint, rotor)

    def _couple(self, joint: int, rotor: int) -> None:
        """Couple a rotor to its joint by a gear constraint.

        Brakes and friction must act on the joint, not on the rotor: Dantzig's solver misses the
        coupling between a gear and a motor on its second joint.
        """
        unused = [0.0, 0.0, 0.0]  # a gear has no axes and pivots
        gear: int = self._bullet.createConstraint(
            self.body_id, joint, self.body_id, rotor, pybullet.JOINT_GEAR, unused, unused, unused
        )
        # Velocities are equal at the end of each step; the rotor's position does not matter.
        # PyBullet's constraint is v + ratio * v_rotor = 0.
        self._bullet.changeConstraint(gear, gearRatio=-1.0, erp=0.0, maxForce=_GEAR_TORQUE_MAX)

    # The physics step

    def _set_state(self, q: Array, v: Array) -> None:
        """Put the joints at positions `q`, rad, with velocities `v`, rad/s, shape (n,) each."""
        for index, *state in zip(self._indices, q.tolist(), v.tolist(), strict=True):
            self._bullet.resetJointState(self.body_id, index, *state)
            if index in self._rotors:
                self._bullet.resetJointState(self.body_id, self._rotors[index], *state)
        self.obstacles.reset()
        self._measure(q, v, v)

    def _set_torques(self, torques: Array) -> None:
        """Apply joint torques in the next step, shape (n,), N m."""
        self._apply_torques(forces=torques.tolist())

    def _set_brakes(self, torque_limits: Array) -> None:
        """Set the torque limits of the zero-velocity motors, shape (n,), N m, until set again."""
        self._apply_brakes(forces=torque_limits.tolist())

    def _step(self) -> None:
        """Make a physics step under the wrenches."""
        bullet, body = self._bullet, self.body_id
        for link, wrench in self._wrenches.items():
            index, point = self._links[self._frames[link].link], self.link_pose(link).translation
            force, torque = wrench.force.tolist(), wrench.torque.tolist()
            bullet.applyExternalForce(body, index, force, point.tolist(), pybullet.WORLD_FRAME)
            bullet.applyExternalTorque(body, index, torque, pybullet.WORLD_FRAME)
        if self.obstacles:
            self.obstacles.before_step()
            bullet.stepSimulation()
            self.obstacles.after_step()
        else:
            bullet.stepSimulation()

    def _measure(self, q: Array, v: Array, v_next: Array) -> None:
        """Update the sensor, if there is one, by a step from (q, v) to v_next."""
        if self.sensor is not None:
            wrenches = [*self._wrenches.values(), *self.obstacles.wrenches()]
            self.sensor.update(q, v, v_next, wrenches)

    # Links

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

    def clear_wrenches(self, link: str | None = None) -> None:
        """Remove the wrench on `link`, or all wrenches."""
        if link is None:
            self._wrenches.clear()
        else:
            self._wrenches.pop(link, None)

    def link_pose(self, link: str) -> pin.SE3:
        """Return the pose of any link of the URDF in the frame of its root link.

        It is PyBullet's, at PyBullet's own joint positions.
        """
        frame = self._frame(link)
        index = self._links[frame.link]
        if index < 0:
            return frame.placement.copy()
        centre, orientation, *_ = self._bullet.getLinkState(
            self.body_id, index, computeForwardKinematics=1
        )
        principal = pin.SE3(pin.Quaternion(np.array(orientation)), np.array(centre))
        return principal * frame.placement

    def close(self) -> None:
        """Disconnect from PyBullet; the robot cannot be used afterwards."""
        if self.client_id >= 0:
            self._bullet.disconnect()
            self.client_id = -1

    def _frame(self, link: str) -> FramePlacement:
        """Return the placement of `link`, or raise `RobotDescriptionError`."""
        if link not in self._frames:
            raise unknown_name("link", link, self._frames)
        return self._frames[link]
