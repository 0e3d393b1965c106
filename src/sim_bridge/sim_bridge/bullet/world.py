# SPDX-License-Identifier: Apache-2.0
"""A PyBullet world with one robot, without what PyBullet adds to rigid-body dynamics.

PyBullet's Dantzig solver, a direct one, computes the constraint impulses of brakes, friction,
rotors and contacts. They are coupled through the whole arm: sequential impulses, PyBullet's other
solver, take several times as long and leave an error of some percent, while Dantzig's solver is
exact to rounding (docs/simulated_robot.md). If it finds no solution, PyBullet falls back to
sequential impulses.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.bullet.client import BulletClient, pybullet, silenced
from sim_bridge.bullet.obstacle_bodies import BulletObstacles
from sim_bridge.bullet.obstacles import ContactMaterial, LinkWrench
from sim_bridge.urdf.preparation import FramePlacement, PreparedUrdf
from viability_bounds_pkg.robot_description import RobotDescriptionError

Array = NDArray[np.float64]

# What PyBullet adds to rigid-body dynamics: 4 % of damping and a clip of joint velocities at 100.
_RIGID_BODY = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e9}
# Of sequential impulses. With PyBullet's defaults (50 rounds, 1e-7) a held Baxter arm creeps at
# 1.6e-3 rad/s, with these at 1.6e-7 rad/s.
_SOLVER_ITERATIONS = 500
_SOLVER_RESIDUAL = 1e-14
_GEAR_TORQUE_MAX = 1e9  # N m, beyond what any gear transmits


class BulletWorld:
    """A private physics world with a robot fixed to the ground, its motors and brakes off.

    Torques and wrenches act in the next step only, brakes until they are set again.

    Args:
        prepared: the robot.
        joints: its n joints, in the order of all arrays.
        physics_dt: the physics step, s.
        gravity: shape (3,), m/s^2.
        material: of the obstacles.

    Attributes:
        obstacles: all other bodies in the world.
        client_id: PyBullet's physics client; -1 when closed.
        body_id: the robot in that client.
        joint_states: returns a tuple for each joint: position, velocity, reaction, and the
            torque that its brake applied.

    Raises:
        RobotDescriptionError: PyBullet does not load the robot.
    """

    def __init__(
        self,
        prepared: PreparedUrdf,
        joints: Sequence[str],
        physics_dt: float,
        gravity: Sequence[float],
        material: ContactMaterial,
    ) -> None:
        self._bullet = bullet = BulletClient()
        self.client_id = bullet.id
        bullet.setGravity(*gravity)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=physics_dt,
            numSolverIterations=_SOLVER_ITERATIONS,
            solverResidualThreshold=_SOLVER_RESIDUAL,
            deterministicOverlappingPairs=1,
        )
        with silenced(1):  # PyBullet prints which solver it uses
            bullet.setPhysicsEngineParameter(
                constraintSolverType=pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
            )
        try:
            self.body_id = body = bullet.load_urdf(
                prepared.text, flags=pybullet.URDF_USE_INERTIA_FROM_FILE
            )
        except pybullet.error as error:
            self.close()
            raise RobotDescriptionError(f"URDF does not load: {error}") from error
        infos = bullet.joint_infos(body)
        indices = {info.name: info.id for info in infos}
        self._joints = [indices[name] for name in joints]
        self._rotors = {indices[joint]: indices[rotor] for joint, rotor in prepared.rotors.items()}
        self._links = dict.fromkeys(prepared.principal_inertias, -1)  # -1 is the base
        self._links.update({info.link: info.id for info in infos})
        # In a call of its own: PyBullet ignores the link index when a value of the body is set.
        bullet.changeDynamics(body, -1, **_RIGID_BODY)
        for link, index in self._links.items():
            inertia = prepared.principal_inertias[link].tolist()
            bullet.changeDynamics(body, index, localInertiaDiagonal=inertia, lateralFriction=1.0)
        control = partial(bullet.setJointMotorControlArray, body, self._joints)
        self._apply_torques = partial(control, pybullet.TORQUE_CONTROL)
        self._apply_brakes = partial(control, pybullet.VELOCITY_CONTROL)
        self.joint_states = partial(bullet.getJointStates, body, self._joints)
        for info in infos:  # PyBullet starts with the motors on
            if info.kind != pybullet.JOINT_FIXED:
                bullet.setJointMotorControl2(body, info.id, pybullet.VELOCITY_CONTROL, force=0.0)
        for joint, rotor in self._rotors.items():
            self._couple(joint, rotor)
        names = {index: link for link, index in self._links.items()}
        self.obstacles = BulletObstacles(bullet, body, names, material, physics_dt, gravity)

    def _couple(self, joint: int, rotor: int) -> None:
        """Couple a rotor to its joint by a gear constraint.

        Brakes and friction must act on the joint, not on the rotor: Dantzig's solver misses the
        coupling between a gear and a motor on its second joint.
        """
        unused = [0.0, 0.0, 0.0]  # a gear has no axes and pivots
        gear = self._bullet.createConstraint(
            self.body_id, joint, self.body_id, rotor, pybullet.JOINT_GEAR, unused, unused, unused
        )
        # Velocities are equal at the end of each step; the rotor's position does not matter.
        # PyBullet's constraint is v + ratio * v_rotor = 0.
        self._bullet.changeConstraint(gear, gearRatio=-1.0, erp=0.0, maxForce=_GEAR_TORQUE_MAX)

    def step(self) -> None:
        """Make a physics step."""
        if self.obstacles:
            self.obstacles.before_step()
            self._bullet.stepSimulation()
            self.obstacles.after_step()
        else:
            self._bullet.stepSimulation()

    def set_state(self, q: Array, v: Array) -> None:
        """Put the joints at positions `q`, rad, with velocities `v`, rad/s, shape (n,) each."""
        for index, *state in zip(self._joints, q.tolist(), v.tolist(), strict=True):
            self._bullet.resetJointState(self.body_id, index, *state)
            if index in self._rotors:
                self._bullet.resetJointState(self.body_id, self._rotors[index], *state)
        self.obstacles.reset()

    def set_torques(self, torques: Array) -> None:
        """Apply joint torques, shape (n,), N m."""
        self._apply_torques(forces=torques.tolist())

    def set_brakes(self, torque_limits: Array) -> None:
        """Set the torque limits of the zero-velocity motors, shape (n,), N m."""
        self._apply_brakes(forces=torque_limits.tolist())

    def apply_wrench(self, frame: FramePlacement, wrench: LinkWrench) -> None:
        """Apply a wrench at the origin of `frame` in the next step."""
        bullet, body, index = self._bullet, self.body_id, self._links[frame.link]
        point = self.pose(frame).translation.tolist()
        force, torque = wrench.force.tolist(), wrench.torque.tolist()
        bullet.applyExternalForce(body, index, force, point, pybullet.WORLD_FRAME)
        bullet.applyExternalTorque(body, index, torque, pybullet.WORLD_FRAME)

    def pose(self, frame: FramePlacement) -> pin.SE3:
        """Return the pose of a frame at the joints' present positions."""
        index = self._links[frame.link]
        if index < 0:
            return frame.placement.copy()
        centre, orientation, *_ = self._bullet.getLinkState(
            self.body_id, index, computeForwardKinematics=1
        )
        principal = pin.SE3(pin.Quaternion(np.array(orientation)), np.array(centre))
        return principal * frame.placement

    def close(self) -> None:
        """Disconnect from PyBullet; the world cannot be used afterwards."""
        if self.client_id >= 0:
            self._bullet.disconnect()
            self.client_id = -1
