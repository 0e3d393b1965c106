"""A PyBullet world with one robot in it, rid of what PyBullet adds to rigid-body dynamics.

Constraint impulses, those of brakes, friction, rotors and contacts, are solved for by PyBullet's
Dantzig solver, a direct one. They are coupled through the whole arm: sequential impulses,
PyBullet's other way, take several times as long for them and stop some percent short, where that
is exact to rounding (docs/simulated_robot.md). Should it find no solution, PyBullet falls back to
the latter.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from sim_bridge.bullet.client import BulletClient
from sim_bridge.bullet.obstacle_bodies import BulletObstacles
from sim_bridge.bullet.obstacles import ContactMaterial
from sim_bridge.bullet.quiet_pybullet import pybullet, silenced
from sim_bridge.urdf.preparation import FramePlacement, PreparedUrdf
from viability_bounds_pkg.robot_description import RobotDescriptionError

# What PyBullet adds to rigid-body dynamics: 4 % of damping and a clip of joint velocities at 100.
_RIGID_BODY = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e9}
# Of sequential impulses. With PyBullet's defaults (50 rounds, 1e-7) a held Baxter arm creeps at
# 1.6e-3 rad/s, with these at 1.6e-7 rad/s.
_SOLVER_ITERATIONS = 500
_SOLVER_RESIDUAL = 1e-14
_GEAR_TORQUE_MAX = 1e9  # far beyond what any gear transmits, N m


class BulletWorld:
    """A world of its own with a robot fixed to the ground, its motors and brakes off.

    Torques and wrenches act in the next step only, brakes until they are set anew.

    Args:
        prepared: the robot.
        joints: its n joints, in the order of all arrays.
        physics_dt: the physics step, s.
        gravity: shape (3,), m/s^2.
        material: of what the robot may touch.

    Attributes:
        obstacles: what else is in the world.
        client_id: PyBullet's physics client; -1 when closed.
        body_id: the robot in that client.
        joint_states: returns a tuple for each joint: position, velocity, reaction, and what its
            brake applied.

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
        with silenced(1):  # it says which solver it takes
            bullet.setPhysicsEngineParameter(
                constraintSolverType=pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
            )
        self.body_id = body = self._load(prepared.text)
        infos = [bullet.getJointInfo(body, i) for i in range(bullet.getNumJoints(body))]
        indices = {info[1].decode(): info[0] for info in infos}
        self._joints = [indices[name] for name in joints]
        self._rotors = {indices[joint]: indices[rotor] for joint, rotor in prepared.rotors.items()}
        self._links = dict.fromkeys(prepared.principal_inertias, -1)  # -1 is the base
        self._links.update({info[12].decode(): info[0] for info in infos})
        # Apart: PyBullet forgets about the link as soon as anything of the whole body is set.
        bullet.changeDynamics(body, -1, **_RIGID_BODY)
        for link, index in self._links.items():
            inertia = prepared.principal_inertias[link].tolist()
            bullet.changeDynamics(body, index, localInertiaDiagonal=inertia, lateralFriction=1.0)
        control = partial(bullet.setJointMotorControlArray, body, self._joints)
        self._push_joints = partial(control, pybullet.TORQUE_CONTROL)
        self._stop_joints = partial(control, pybullet.VELOCITY_CONTROL)
        self.joint_states = partial(bullet.getJointStates, body, self._joints)
        for info in infos:  # PyBullet starts with the motors on
            if info[2] != pybullet.JOINT_FIXED:
                bullet.setJointMotorControl2(body, info[0], pybullet.VELOCITY_CONTROL, force=0.0)
        for joint, rotor in self._rotors.items():
            self._couple(joint, rotor)
        names = {index: link for link, index in self._links.items()}
        self.obstacles = BulletObstacles(bullet, body, names, material, physics_dt, gravity)

    def _load(self, urdf: str) -> int:
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "robot.urdf"  # PyBullet reads files only
            path.write_text(urdf, encoding="utf-8")
            try:
                return self._bullet.loadURDF(
                    str(path), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE
                )
            except pybullet.error as error:
                self.close()
                raise RobotDescriptionError(f"URDF does not load: {error}") from error

    def _couple(self, joint: int, rotor: int) -> None:
        """Let a rotor turn with its joint.

        Brakes and friction must act on the joint, not on the rotor: between a gear and a motor on
        its second joint, Dantzig's solver overlooks the coupling.
        """
        unused = [0.0, 0.0, 0.0]  # axes and pivots mean nothing to a gear
        gear = self._bullet.createConstraint(
            self.body_id, joint, self.body_id, rotor, pybullet.JOINT_GEAR, unused, unused, unused
        )
        # Velocities are equal at the end of each step; how far the rotor has turned is nobody's
        # concern. PyBullet asks for v + ratio * v_rotor = 0.
        self._bullet.changeConstraint(gear, gearRatio=-1.0, erp=0.0, maxForce=_GEAR_TORQUE_MAX)

    def step(self) -> None:
        """Make a physics step."""
        if self.obstacles:
            self.obstacles.before_step()
            self._bullet.stepSimulation()
            self.obstacles.after_step()
        else:
            self._bullet.stepSimulation()

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        """Put the joints at positions `q`, rad, with velocities `v`, rad/s, shape (n,) each."""
        for index, *state in zip(self._joints, q.tolist(), v.tolist(), strict=True):
            self._bullet.resetJointState(self.body_id, index, *state)
            if index in self._rotors:
                self._bullet.resetJointState(self.body_id, self._rotors[index], *state)
        self.obstacles.reset()

    def set_torques(self, torques: np.ndarray) -> None:
        """Apply joint torques, shape (n,), N m."""
        self._push_joints(forces=torques.tolist())

    def set_brakes(self, torque_limits: np.ndarray) -> None:
        """Let zero-velocity motors apply up to `torque_limits`, shape (n,), N m."""
        self._stop_joints(forces=torque_limits.tolist())

    def push(self, frame: FramePlacement, force: list[float], torque: list[float]) -> None:
        """Apply a force, N, and a torque, N m, in world axes at the origin of `frame`."""
        bullet, body, index = self._bullet, self.body_id, self._links[frame.link]
        point = self.pose(frame)[0].tolist()
        bullet.applyExternalForce(body, index, force, point, pybullet.WORLD_FRAME)
        bullet.applyExternalTorque(body, index, torque, pybullet.WORLD_FRAME)

    def pose(self, frame: FramePlacement) -> tuple[np.ndarray, np.ndarray]:
        """Return position and quaternion of a frame, from the joints' present positions."""
        index = self._links[frame.link]
        if index < 0:
            return frame.position.copy(), frame.orientation.copy()
        link = self._bullet.getLinkState(self.body_id, index, computeForwardKinematics=1)
        centre, (x, y, z, w) = link[:2]
        # Products with a quaternion from the left, and with its conjugate from the right.
        left = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
        right = np.array([[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z], [x, y, z, w]])
        return centre + (left @ right)[:3, :3] @ frame.position, left @ frame.orientation

    def close(self) -> None:
        """Leave the world; after that it is of no more use."""
        if self.client_id >= 0:
            self._bullet.disconnect()
            self.client_id = -1
