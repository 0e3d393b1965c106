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

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sim_bridge.bullet.body import BulletBody
from sim_bridge.bullet.joint_friction import Gears
from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.position_drive import PositionDrive, make_drive
from sim_bridge.bullet.vectors import finite_vector, not_negative_vector


class RobotState(NamedTuple):
    """State of the joints, arrays of shape (n,) in the order of the robot's joints."""

    q: np.ndarray  # position at the same instant as v, rad
    v: np.ndarray  # velocity, rad/s
    motor_torque: np.ndarray  # of the motors or brakes in the last physics step, N m


class BulletRobot(BulletBody):
    """One arm with motors and brakes, fixed to the ground, alone in a world of its own.

    Its dynamics equal those of the Pinocchio model that
    `viability_bounds_pkg.robot_description.build_model` makes of the same arguments, save for
    what it is told to add: gears, and masses that the URDF does not know of. Call
    `close` after use; `contextlib.closing` does. Methods raise `ValueError` for an array of
    another shape or with numbers that are not finite, `RobotDescriptionError` for a link that
    the URDF does not have.

    Args:
        urdf_text: the URDF.
        joints: names of the n joints that move; arrays are in this order.
        physics_dt: the physics step h, s.
        locked_positions: where other joints are locked, rad or m; those left out are at zero.
        gears: friction, rotors and torque biases of the joints; none by default.
        body: further options of `BulletBody`: gravity, shapes, obstacles, masses, a sensor.

    Attributes:
        monitor: told of every physics step, unless None.

    Raises:
        RobotDescriptionError: as `BulletBody` does.
        ValueError: as `BulletBody` does, or `gears` are those of another number of joints.
    """

    def __init__(
        self,
        urdf_text: str,
        joints: Sequence[str],
        *,
        physics_dt: float,
        locked_positions: Mapping[str, float] | None = None,
        gears: Gears | None = None,
        **body: Any,
    ) -> None:
        n = len(joints)
        gears = gears or Gears(n)
        if gears.rotor_inertia.shape != (n,):
            raise ValueError(f"there are {n} joints, but {gears.rotor_inertia.size} gears")
        inertias = zip(joints, gears.simulated_inertia(physics_dt).tolist(), strict=True)
        super().__init__(
            urdf_text,
            joints,
            physics_dt=physics_dt,
            locked_positions=locked_positions,
            rotor_inertias={joint: inertia for joint, inertia in inertias if inertia > 0.0},
            **body,
        )
        self.monitor: LimitMonitor | None = None
        self._gears = None if gears.ideal else gears
        # PyBullet's position, half a step ahead of the velocity; see the module.
        self._q, self._v, self._motor_torque = np.zeros((3, n))
        self._brakes = np.zeros(n)
        # Made when first needed, because it takes a model.
        self._make_drive = partial(
            make_drive, urdf_text, self.joints, locked_positions, gears, physics_dt
        )
        self._drive: PositionDrive | None = None
        self._driving = False
        self._stepped = False  # since the last reset

    def reset(self, q: ArrayLike, v: ArrayLike) -> None:
        """Put the joints into a state, motors off; wrenches and the monitor stay as they are.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
        """
        v = finite_vector("v", v, len(self.joints))
        raw = finite_vector("q", q, len(self.joints)) + 0.5 * self.physics_dt * v
        self._world.set_state(raw, v)
        self._q[:], self._v[:] = raw, v
        self._motor_torque.fill(0.0)
        self._driving = self._stepped = False
        if self._sensor is not None:
            self._feel(self._q, self._v, self._v)

    def step(self, tau: ArrayLike, substeps: int = 1) -> None:
        """Apply joint torques for some physics steps.

        Args:
            tau: torques that the motors are told, shape (n,), N m; applied as they are, unclipped.
            substeps: how many physics steps, at least 1.
        """
        tau = finite_vector("tau", tau, len(self.joints))
        self._driving = False
        self._release_brakes()
        self._motor_torque[:] = tau
        self._advance(substeps)

    def move(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque_limits: ArrayLike,
        speed_limits: ArrayLike,
        substeps: int = 1,
    ) -> None:
        """Let the motors' drives control the position for some physics steps.

        They take over from torque control and from the brakes without a jump in torque.

        Args:
            q: where to be at the end, shape (n,), rad.
            v: how fast to pass there, shape (n,), rad/s.
            torque_limits: greatest torque of each motor, shape (n,), N m, not negative.
            speed_limits: greatest speed that a drive asks for, shape (n,), rad/s, not negative.
            substeps: how many physics steps, at least 1.
        """
        n = len(self.joints)
        target = (
            finite_vector("q", q, n),
            finite_vector("v", v, n),
            not_negative_vector("speed_limits", speed_limits, n),
            not_negative_vector("torque_limits", torque_limits, n),
        )
        self._release_brakes()
        if not self._driving:
            self._drive = self._drive or self._make_drive()
            last = self._motor_torque if self._stepped else None
            self._drive.start(*self.state()[:2], target[-1], last)
            self._driving = True
        self._advance(substeps, target)

    def brake(self, substeps: int, torque_limits: ArrayLike) -> None:
        """Brake for some physics steps, as a drive does by itself, and hold what has stopped.

        Each brake asks for zero velocity at the end of every physics step and applies what that
        takes, up to its limit: it is implicit, so that it neither chatters nor overshoots.

        Args:
            substeps: how many physics steps, at least 1.
            torque_limits: greatest torque of each brake, shape (n,), N m, not negative.
        """
        limits = not_negative_vector("torque_limits", torque_limits, len(self.joints))
        self._driving = False
        self._brakes[:] = limits
        if self._gears is None:
            self._world.set_brakes(limits)
        self._advance(substeps, braking=True)

    def state(self) -> RobotState:
        """Return the joint state, in arrays of the caller's own."""
        q = self._q - 0.5 * self.physics_dt * self._v
        return RobotState(q, self._v.copy(), self._motor_torque.copy())

    def _advance(
        self,
        substeps: int,
        target: tuple[np.ndarray, ...] | None = None,
        braking: bool = False,
    ) -> None:
        """Make physics steps under `_motor_torque`, or the drives' given a target, or brakes."""
        if substeps < 1:
            raise ValueError(f"substeps must be at least 1, not {substeps}")
        world = self._world
        state_matters = target is not None or self._gears is not None or self._sensor is not None
        for remaining in range(substeps, 0, -1):
            if target is not None:
                self._motor_torque[:] = self._drive.torque(*self.state()[:2], *target)
            if self._gears is not None:
                self._load_gears(braking)
            elif not braking:
                world.set_torques(self._motor_torque)
            for wrench in self._wrenches.values():
                world.push(*wrench)
            world.step()
            self._stepped = True
            if self.monitor is None and remaining > 1 and not state_matters:
                continue
            before = self._q.copy(), self._v.copy()
            states = world.joint_states()
            self._q[:] = [state[0] for state in states]
            self._v[:] = [state[1] for state in states]
            if braking:  # PyBullet counts friction in, and the last of a brake now off
                applied = [state[3] for state in states]
                self._motor_torque[:] = np.clip(applied, -self._brakes, self._brakes)
            if self._sensor is not None and remaining == 1:
                self._feel(*before, self._v)
            if self.monitor is not None:
                self.monitor.update(self._q, self._v, self._motor_torque)

    def _load_gears(self, braking: bool) -> None:
        """Apply what the motors deliver, and friction together with the brakes."""
        # A motor that is off has no bias either.
        tau = -self._gears.torque_bias if braking else self._motor_torque
        delivered, friction = self._gears.loads(self._v, tau)
        self._world.set_torques(delivered)
        self._world.set_brakes(friction + self._brakes)

    def _release_brakes(self) -> None:
        if self._brakes.any():
            self._brakes.fill(0.0)
            self._world.set_brakes(self._brakes)
