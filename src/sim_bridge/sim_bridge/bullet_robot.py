"""A robot arm in PyBullet whose state moves exactly as the papers assume.

PyBullet steps by semi-implicit Euler: with step h and acceleration a,

    v+ = v + h a,    q+ = q + h v+.

The papers assume constant acceleration, q+ = q + h v + (h^2 / 2) a (eq. (1), [DelPrete2018]).
The q that PyBullet stores is half a step ahead of its v; the position half a step back belongs
to the same instant as v:

    x  = q - (h/2) v,
    x+ = q+ - (h/2) v+ = q + (h/2) v+ = x + (h/2) v + (h/2) (v + h a)
       = x + h v + (h^2 / 2) a,

so that (x, v) follows eq. (1) exactly, however many steps of however changing accelerations.
x is the position that `BulletRobot.state` reports and `BulletRobot.reset` sets. Forces that
depend on position are those at q, as are link poses and what the limit monitor sees. A bound
that x keeps for ever with deceleration a, v <= sqrt(2 a r) at distance r, is passed by q by

    q - q_max = -r + (h/2) v <= -r + (h/2) sqrt(2 a r) <= a h^2 / 8,

the maximum being at r = a h^2 / 8: 2 microrad for 15 rad/s^2 at 1 kHz.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.limit_monitor import LimitMonitor
from sim_bridge.quiet_pybullet import pybullet
from sim_bridge.urdf_preparation import FramePlacement, PreparedUrdf, prepare_urdf
from viability_bounds_pkg.robot_description import RobotDescriptionError

# What PyBullet adds to rigid-body dynamics: 4 % of damping and a clip of joint velocities at 100.
_RIGID_BODY = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e9}
# Brakes are solved one after another, again and again. With PyBullet's defaults (50 rounds,
# 1e-7) a held Baxter arm creeps at 1.6e-3 rad/s, with these at 1.6e-7 rad/s. Without brakes or
# contacts there is nothing to solve, and no cost.
_SOLVER_ITERATIONS = 500
_SOLVER_RESIDUAL = 1e-14


class RobotState(NamedTuple):
    """State of the joints, arrays of shape (n,) in the order of the robot's joints."""

    q: np.ndarray  # position at the same instant as v, rad
    v: np.ndarray  # velocity, rad/s
    motor_torque: np.ndarray  # what the motors or brakes applied in the last physics step, N m


class _Client:
    """PyBullet's functions, bound to a private physics client without a window."""

    def __init__(self) -> None:
        self.id = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        bound = partial(getattr(pybullet, name), physicsClientId=self.id)
        setattr(self, name, bound)  # found directly from now on
        return bound


class BulletRobot:
    """One torque-controlled arm, fixed to the ground, alone in a world of its own.

    Its dynamics equal those of the Pinocchio model that
    `viability_bounds_pkg.robot_description.build_model` makes of the same arguments. Call
    `close` after use; `contextlib.closing` does. Methods raise `ValueError` for an array of
    another shape or with numbers that are not finite, `RobotDescriptionError` for a link that
    the URDF does not have.

    Args:
        urdf_text: the URDF.
        joints: names of the n joints that move; arrays are in this order.
        locked_positions: where other joints are locked, rad or m; those left out are at zero.
        physics_dt: the physics step h, s.
        gravity: acceleration of gravity in the base frame, m/s^2.
        visuals: load the visual and collision shapes, for cameras and contacts.
        mechanical_stops: stop joints hard at their position limits.

    Attributes:
        monitor: told of every physics step, unless None.
        client_id: PyBullet's physics client, for cameras and obstacles.
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
        locked_positions: Mapping[str, float] | None = None,
        physics_dt: float,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        visuals: bool = False,
        mechanical_stops: bool = False,
    ) -> None:
        if not (math.isfinite(physics_dt) and physics_dt > 0.0):
            raise ValueError(f"physics_dt must be positive and finite, not {physics_dt}")
        self.joints, self.physics_dt = tuple(joints), float(physics_dt)
        self.monitor: LimitMonitor | None = None
        gravity = _checked("gravity", gravity, 3)
        prepared = prepare_urdf(
            urdf_text, joints, locked_positions, visuals=visuals, mechanical_stops=mechanical_stops
        )
        self._frames = prepared.frames
        # PyBullet's position, half a step ahead of the velocity; see the module.
        self._q, self._v, self._motor_torque = np.zeros((3, len(self.joints)))
        self._wrenches: dict[str, tuple[FramePlacement, list[float], list[float]]] = {}
        self._bullet = _Client()
        self.client_id = self._bullet.id
        self._load(prepared, gravity.tolist())

    def _load(self, prepared: PreparedUrdf, gravity: list[float]) -> None:
        """Load the robot and take out what PyBullet adds to rigid-body dynamics."""
        bullet = self._bullet
        bullet.setGravity(*gravity)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=self.physics_dt,
            numSolverIterations=_SOLVER_ITERATIONS,
            solverResidualThreshold=_SOLVER_RESIDUAL,
            deterministicOverlappingPairs=1,
        )
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "robot.urdf"  # PyBullet reads files only
            path.write_text(prepared.text, encoding="utf-8")
            try:
                self.body_id = body = bullet.loadURDF(
                    str(path), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE
                )
            except pybullet.error as error:
                self.close()
                raise RobotDescriptionError(f"URDF does not load: {error}") from error
        infos = [bullet.getJointInfo(body, i) for i in range(bullet.getNumJoints(body))]
        indices = {info[1].decode(): info[0] for info in infos}
        self._joint_indices = [indices[name] for name in self.joints]
        self._link_indices = dict.fromkeys(prepared.principal_inertias, -1)  # -1 is the base
        self._link_indices.update({info[12].decode(): info[0] for info in infos})
        # Apart: PyBullet forgets about the link as soon as anything of the whole body is set.
        bullet.changeDynamics(body, -1, **_RIGID_BODY)
        for link, index in self._link_indices.items():
            inertia = prepared.principal_inertias[link].tolist()
            bullet.changeDynamics(body, index, localInertiaDiagonal=inertia)
        self._set_brakes([0.0] * len(self.joints))

    def reset(self, q: ArrayLike, v: ArrayLike) -> None:
        """Put the joints into a state, motors off; wrenches and the monitor stay as they are.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
        """
        v = _checked("v", v, len(self.joints))
        raw = _checked("q", q, len(self.joints)) + 0.5 * self.physics_dt * v
        for index, *state in zip(self._joint_indices, raw.tolist(), v.tolist(), strict=True):
            self._bullet.resetJointState(self.body_id, index, *state)
        self._q[:], self._v[:] = raw, v
        self._motor_torque.fill(0.0)

    def step(self, tau: ArrayLike, substeps: int = 1) -> None:
        """Apply joint torques for some physics steps.

        Args:
            tau: torques of the motors, shape (n,), N m; applied as they are, unclipped.
            substeps: how many physics steps, at least 1.
        """
        tau = _checked("tau", tau, len(self.joints))
        if self._brakes.any():
            self._set_brakes([0.0] * len(self.joints))
        self._motor_torque[:] = tau
        self._advance(substeps, tau.tolist())

    def brake(self, substeps: int, torque_limits: ArrayLike) -> None:
        """Brake for some physics steps, as a drive does by itself, and hold what has stopped.

        Each brake asks for zero velocity at the end of every physics step and applies what that
        takes, up to its limit: it is implicit, so that it neither chatters nor overshoots.

        Args:
            substeps: how many physics steps, at least 1.
            torque_limits: greatest torque of each brake, shape (n,), N m, not negative.
        """
        limits = _checked("torque_limits", torque_limits, len(self.joints))
        if np.any(limits < 0.0):
            raise ValueError(f"torque_limits must not be negative: {limits}")
        self._set_brakes(limits.tolist())
        self._advance(substeps, None)

    def state(self) -> RobotState:
        """Return the joint state, in arrays of the caller's own."""
        q = self._q - 0.5 * self.physics_dt * self._v
        return RobotState(q, self._v.copy(), self._motor_torque.copy())

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
        force, torque = _checked("force", force, 3), _checked("torque", torque, 3)
        self._wrenches[link] = frame, force.tolist(), torque.tolist()

    def clear_wrenches(self) -> None:
        """Take all wrenches off."""
        self._wrenches.clear()

    def link_pose(self, link: str) -> tuple[np.ndarray, np.ndarray]:
        """Return where a link is, by PyBullet's own joint positions.

        Returns:
            Position, shape (3,), m, and orientation, shape (4,), a quaternion x, y, z, w, of
            any link of the URDF in the frame of its root link.
        """
        return self._pose(self._frame(link))

    def close(self) -> None:
        """Leave the physics world; after that the robot is of no more use."""
        if self.client_id >= 0:
            self._bullet.disconnect()
            self.client_id = -1

    def _advance(self, substeps: int, tau: list[float] | None) -> None:
        """Make physics steps under torques or, with None, under the brakes."""
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, not {substeps}")
        bullet, body, joints = self._bullet, self.body_id, self._joint_indices
        for remaining in range(substeps, 0, -1):
            # PyBullet forgets torques and wrenches at the end of each step.
            if tau is not None:
                bullet.setJointMotorControlArray(body, joints, pybullet.TORQUE_CONTROL, forces=tau)
            for frame, force, torque in self._wrenches.values():
                index = self._link_indices[frame.link]
                point = self._pose(frame)[0].tolist()
                bullet.applyExternalForce(body, index, force, point, pybullet.WORLD_FRAME)
                bullet.applyExternalTorque(body, index, torque, pybullet.WORLD_FRAME)
            bullet.stepSimulation()
            if self.monitor is None and remaining > 1:
                continue
            states = bullet.getJointStates(body, joints)
            self._q[:] = [state[0] for state in states]
            self._v[:] = [state[1] for state in states]
            if tau is None:  # PyBullet reports what its motors apply, not commanded torques,
                self._motor_torque[:] = [state[3] for state in states]
                self._motor_torque[self._brakes == 0.0] = 0.0  # and the last of a motor now off
            if self.monitor is not None:
                self.monitor.update(self._q, self._v, self._motor_torque)

    def _set_brakes(self, torque_limits: list[float]) -> None:
        """Let zero-velocity motors apply up to `torque_limits`; PyBullet starts with them on."""
        self._bullet.setJointMotorControlArray(
            self.body_id, self._joint_indices, pybullet.VELOCITY_CONTROL, forces=torque_limits
        )
        self._brakes = np.array(torque_limits)

    def _pose(self, frame: FramePlacement) -> tuple[np.ndarray, np.ndarray]:
        """Return position and quaternion of a frame, from the joints' present positions."""
        index = self._link_indices[frame.link]
        if index < 0:
            return frame.position.copy(), frame.orientation.copy()
        link = self._bullet.getLinkState(self.body_id, index, computeForwardKinematics=1)
        centre, (x, y, z, w) = link[:2]
        # Products with a quaternion from the left, and with its conjugate from the right.
        left = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
        right = np.array([[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z], [x, y, z, w]])
        return centre + (left @ right)[:3, :3] @ frame.position, left @ frame.orientation

    def _frame(self, link: str) -> FramePlacement:
        """Return the placement of `link`, or raise `RobotDescriptionError`."""
        if link not in self._frames:
            known = ", ".join(self._frames)
            raise RobotDescriptionError(f"unknown link {link!r}; the URDF has: {known}")
        return self._frames[link]


def _checked(name: str, value: ArrayLike, size: int) -> np.ndarray:
    """Return `value` as an array of `size` finite numbers, or raise `ValueError`."""
    array = np.asarray(value, dtype=float)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be {size} finite numbers, not {value}")
    return array
