# SPDX-License-Identifier: Apache-2.0
"""A robot arm in PyBullet whose state follows exactly the discrete-time model of the papers.

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
depend on position, link poses and the limit monitor use q; but for speed limits that depend on
position, which are those at x. A bound that x keeps for ever with
deceleration a, v <= sqrt(2 a r) at distance r, is exceeded by q by

    q - q_max = -r + (h/2) v <= -r + (h/2) sqrt(2 a r) <= a h^2 / 8,

the maximum being at r = a h^2 / 8: 2 microrad for 15 rad/s^2 at 1 kHz.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.body import BulletBody
from sim_bridge.bullet.client import finite_vector
from sim_bridge.bullet.friction import JointFriction
from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.position_drive import PositionDrive
from sim_bridge.hardware import Motors
from viability_bounds_pkg.stop import CoordinatedStop

Array = NDArray[np.float64]


class RobotState(NamedTuple):
    """State of the joints, arrays of shape (n,) in the order of the robot's joints."""

    q: Array  # position at the same time as v, rad
    v: Array  # velocity, rad/s
    motor_torque: Array  # of the motors or brakes in the last physics step, N m


class BulletRobot(BulletBody):
    """One arm with motors and brakes, fixed to the ground, in a world of its own.

    Its dynamics equal those of the Pinocchio model that
    `viability_bounds_pkg.robot.description.build_model` makes of the same arguments, plus joint
    friction, rotors and scaled masses where given. Call `close` after use; `contextlib.closing`
    does. Methods raise `ValueError` for an array of another shape or with numbers that are not
    finite, `RobotDescriptionError` for a link that the URDF does not have.

    Args:
        urdf_text, joints, physics_dt: as of `BulletBody`; all arrays are in the order of `joints`.
        joint_friction: friction and rotors of the joints; none by default.
        motors: what the torques of `step` and of the drives pass through; ideal by default.
        body: further options of `BulletBody`: locked joints, gravity, obstacles, masses, a sensor.

    Attributes:
        monitor: updated at every physics step, unless None.

    Raises:
        RobotDescriptionError: as `BulletBody` does.
        ValueError: as `BulletBody` does, or `joint_friction` is that of another number of joints.
    """

    def __init__(
        self,
        urdf_text: str,
        joints: Sequence[str],
        *,
        physics_dt: float,
        joint_friction: JointFriction | None = None,
        motors: Motors | None = None,
        **body: Any,
    ) -> None:
        n = len(joints)
        friction = joint_friction or JointFriction(n)
        if friction.rotor_inertia.shape != (n,):
            size = friction.rotor_inertia.size
            raise ValueError(f"joint_friction is that of {size} joints, not of {n}")
        inertias = zip(joints, friction.simulated_inertia(physics_dt).tolist(), strict=True)
        super().__init__(
            urdf_text,
            joints,
            physics_dt=physics_dt,
            rotor_inertias={joint: inertia for joint, inertia in inertias if inertia > 0.0},
            **body,
        )
        self.monitor: LimitMonitor | None = None
        self._rotor_inertia = friction.rotor_inertia
        self._friction = None if friction.ideal else friction
        # PyBullet's position, half a step ahead of the velocity; see the module.
        self._q, self._v, self._motor_torque = np.zeros((3, n))
        self._motors = motors
        self._asked = self._motor_torque if motors is None else np.zeros(n)
        self._brakes = np.zeros(n)
        self._drive: PositionDrive | None = None  # made when first needed: it builds a model
        self._driving = False
        self._law: CoordinatedStop | None = None  # the one in charge
        self._stepped = False  # since the last reset
        self._v_before = self._v  # at the start of the last physics step, rad/s

    @property
    def finite(self) -> bool:
        """Whether the state is made of numbers; a push without measure leaves none."""
        return all(map(math.isfinite, (self._q + self._v).tolist()))

    def reset(self, q: ArrayLike, v: ArrayLike) -> None:
        """Set the state of the joints, motors off; wrenches and monitor are not changed.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
        """
        v = finite_vector("v", v, len(self.joints))
        raw = finite_vector("q", q, len(self.joints)) + 0.5 * self.physics_dt * v
        if not self.finite:
            self._make_world()  # after a push without measure: PyBullet keeps what is no number
        self._set_state(raw, v)
        self._q[:], self._v[:] = raw, v
        self._motor_torque.fill(0.0)
        if self._motors is not None:
            self._motors.reset()
        self._driving = self._stepped = False
        self._law = None

    def step(self, tau: ArrayLike, substeps: int = 1) -> None:
        """Apply joint torques for some physics steps.

        Args:
            tau: torques of the motors, shape (n,), N m; not clipped.
            substeps: how many physics steps, at least 1.
        """
        tau = finite_vector("tau", tau, len(self.joints))
        self._driving, self._law = False, None
        self._release_brakes()
        self._asked[:] = tau
        self._advance(substeps)

    def step_by(self, torque: Callable[[], Array], substeps: int = 1) -> None:
        """Apply joint torques that the drives compute anew in each physics step.

        Args:
            torque: returns those of the motors, shape (n,), N m; not clipped.
            substeps: how many physics steps, at least 1.
        """
        self._driving, self._law = False, None
        self._release_brakes()
        self._advance(substeps, torque)

    def move(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque_limits: ArrayLike,
        speed_limits: ArrayLike,
        substeps: int = 1,
    ) -> None:
        """Let the motors' drives control the position for some physics steps.

        The transfer from torque control or brakes is bumpless.

        Args:
            q: position at the end, shape (n,), rad.
            v: velocity there, shape (n,), rad/s.
            torque_limits: greatest torque of each motor, shape (n,), N m, not negative.
            speed_limits: greatest reference velocity of a drive, shape (n,), rad/s, not negative.
            substeps: how many physics steps, at least 1.
        """
        n = len(self.joints)
        q_des, v_des = finite_vector("q", q, n), finite_vector("v", v, n)
        v_max = finite_vector("speed_limits", speed_limits, n, signed=False)
        tau_max = finite_vector("torque_limits", torque_limits, n, signed=False)
        self._law = None
        self._release_brakes()
        drive = self._drive = self._drive or PositionDrive(
            *self.description, self._rotor_inertia, self.physics_dt
        )
        if not self._driving:
            last = self.believed_torque if self._stepped else None
            drive.reset(*self.state()[:2], tau_max, last)
            self._driving = True

        def control() -> Array:
            return drive.torque(*self.state()[:2], q_des, v_des, v_max, tau_max)

        self._advance(substeps, control)

    def brake(self, substeps: int, torque_limits: ArrayLike) -> None:
        """Brake for some physics steps, as a drive does without commands, and hold.

        Each brake applies the torque that makes the velocity zero at the end of a physics step, up
        to its limit: it is implicit, so that it neither chatters nor overshoots.

        Args:
            substeps: how many physics steps, at least 1.
            torque_limits: greatest torque of each brake, shape (n,), N m, not negative.
        """
        limits = finite_vector("torque_limits", torque_limits, len(self.joints), signed=False)
        self._driving, self._law = False, None
        if self._motors is not None:
            self._motors.switch_off()
        self._brakes[:] = limits
        if self._friction is None:
            self._set_brakes(limits)
        self._advance(substeps, braking=True)

    def stop(self, law: CoordinatedStop, substeps: int = 1) -> None:
        """Let the drives bring the arm to rest within its limits, and hold it there.

        Args:
            law: for the joints of this robot in their order, with its physics step; it begins
                anew when the last call was neither of this method nor of `follow`.
            substeps: how many physics steps, at least 1.
        """
        self._by_law(law, law.torque, substeps)

    def follow(self, law: CoordinatedStop, tau: ArrayLike, substeps: int = 1) -> None:
        """Apply joint torques as far as the drives' own law lets them through.

        Args:
            law: as of `stop`.
            tau: torques of the motors, shape (n,), N m.
            substeps: how many physics steps, at least 1.
        """
        command = finite_vector("tau", tau, len(self.joints))
        self._by_law(law, lambda q, v, now: law.follow(q, v, command, now), substeps)

    @property
    def returning(self) -> bool:
        """Whether commands do not have all of their effect yet after a stop."""
        return self._law is not None and not self._law.returned

    def _by_law(
        self,
        law: CoordinatedStop,
        torque: Callable[[Array, Array, Array | None], Array],
        substeps: int,
    ) -> None:
        if self._law is not law:
            self._driving = False
            self._release_brakes()
            q, v, _ = self.state()
            if self._stepped:
                law.start(q, v, self.believed_torque, (v - self._v_before) / self.physics_dt)
            else:
                law.start(q, v)
            self._law = law
        motors = self._motors

        def control() -> Array:
            q, v, _ = self.state()
            return torque(q, v, None if motors is None else motors.believed)

        self._advance(substeps, control)

    def state(self) -> RobotState:
        """Return the joint state, in new arrays."""
        q = self._q - 0.5 * self.physics_dt * self._v
        return RobotState(q, self._v.copy(), self._motor_torque.copy())

    @property
    def believed_torque(self) -> Array:
        """Torques that the drives believe their motors to give; of brakes, the true ones, N m.

        A new array of shape (n,).
        """
        believed = None if self._motors is None else self._motors.believed
        return (self._motor_torque if believed is None else believed).copy()

    def _advance(
        self, substeps: int, control: Callable[[], Array] | None = None, braking: bool = False
    ) -> None:
        """Make physics steps under `_asked`, the torques of `control`, or the brakes."""
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, not {substeps}")
        for remaining in range(substeps, 0, -1):
            if control is not None:
                self._asked[:] = control()
            if self._motors is not None and not braking:
                self._motor_torque[:] = self._motors.step(self._asked, self._q)
            if self._friction is not None:
                self._apply_friction(self._friction, braking)
            elif not braking:
                self._set_torques(self._motor_torque)
            self._step()
            self._stepped = True
            before = self._q.copy(), self._v.copy()
            states = self._joint_states()
            self._q[:] = [state[0] for state in states]
            self._v[:] = [state[1] for state in states]
            if braking:  # PyBullet counts friction in, and the last of a brake now off
                applied = [state[3] for state in states]
                self._motor_torque[:] = np.clip(applied, -self._brakes, self._brakes)
            if remaining == 1:
                self._v_before = before[1]
                self._measure(*before, self._v)
            if self.monitor is not None:
                lead = 0.5 * self.physics_dt
                self.monitor.update(self._q, self._v, self._motor_torque, lead)

    def _apply_friction(self, model: JointFriction, braking: bool) -> None:
        """Apply the torques of the motors, and friction together with the brakes."""
        tau = np.zeros_like(self._v) if braking else self._motor_torque
        torque, dry_friction = model.loads(self._v, tau)
        self._set_torques(torque)
        self._set_brakes(dry_friction + self._brakes)

    def _release_brakes(self) -> None:
        if self._brakes.any():
            self._brakes.fill(0.0)
            self._set_brakes(self._brakes)
