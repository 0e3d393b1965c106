# SPDX-License-Identifier: Apache-2.0
"""Stop law for drives: brings an arm to rest with all limits kept, without commands.

`docs/theory/whole_arm.md` derives and proves it.

At each step of the drive, h, the joints slow down in proportion to their speeds, so that the arm
keeps its direction and all joints come to rest together, as soon as their acceleration limits
allow:

    T = max_i abs(v_i) / A_i,    a_i = -v_i / max(T, h),

where A_i is a_max for a joint that moves backwards and -a_min otherwise. A joint whose limits need
more braking brakes more: a is clipped to the exact acceleration bounds. The torque is that of the
inverse dynamics in the middle of the step. Where a motor cannot give it the accelerations change
by the least amount, see `within_torque_limits`.

A joint outside its kernel, after a push for example, brakes harder than its acceleration limits
where that still keeps a limit and the motors can; one beyond a position limit comes back slowly.

At rest the joints hold the place where they are, by the same law with another wish,

    a = omega^2 (q_rest - q) - 2 omega v.

With an observer, what the joints accelerate more than commanded is attributed to a torque that
acts on the joints (friction, a payload, a push), and this torque is balanced.

Commands that are held because the next one is late, and those that return, go through the same
bounds: the accelerations wanted are then those that the command would give. After a stop

    a_wanted = a_command + (a_stop - a_command,0) (1 - t / T_return),

so that the torque goes on from that of the stop without a step, and ends at that of the command.

Motors whose torque follows with a first-order lag 1 / omega make (q + v / omega, v + a / omega) a
double integrator that the torques asked for drive at once. All of the law is for that state then.

Where torques may change by a limited amount in each step, they are given a range for the next one.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError, joint_array
from viability_bounds_pkg.robot.dynamics import Dynamics, within_torque_limits
from viability_bounds_pkg.viability import BoundsSolver

Array = NDArray[np.float64]

HORIZON = 2.0
"""Horizon of the bounds in steps: one late call is covered, and the bounds do not chatter."""

MARGIN = 0.05
"""How far accelerations may be off within a step, as a share of the acceleration limits."""

REST_SPEED = 1e-3
"""The arm is at rest when no joint is faster, rad/s; above the noise of the velocities."""

HARDER = 3.0
"""Hardest braking outside the kernel in units of the acceleration limits, where motors can."""

RESERVE = 1.1
"""Braking outside the kernel in units of what would just be enough."""

RETURN_SPEED = 0.1
"""Speed of the way back from outside the position limits, as a share of the speed limit."""

SOFT_REST = 0.03
"""Time constant in which the arm comes to rest at last, where torques may not change at once, s:
the torque of hard braking, taken off too late, would be the next motion."""

HOLD_GAIN = 30.0
"""omega, 1/s."""

HOLD_WINDOW = 2e-4
"""Distance from the place held within which the observer rests, rad: no stick-slip."""

HOLD_CLEARANCE = 4e-4
"""Distance of the place held from the position limits, rad, more than `HOLD_WINDOW`: at a limit,
the bounds would turn noise of the torque into torque steps."""

GIVE_WAY = 0.02
"""Distance from the place held at which the arm stops anew instead of going back, rad."""

PASS_TIME = 0.05
"""How long commands must be within the limits before they act by themselves again, s."""

RETURN_TIME = 0.1
"""In which commands that return after a stop get back all of their effect, s."""


class CoordinatedStop:
    """A law for the drives of an arm that brings it to rest and holds it, without commands.

    Call `start` once when a command is missing, then at each step of the drive `follow` as long as
    the last command is held, `torque` when it is not any more, and `follow` again with those that
    return, until `returned`. Arrays are of shape (n,), in the order of `limits.names`: positions
    q, rad, velocities v, rad/s, accelerations a, rad/s^2, torques, N m.

    Args:
        model: the arm, with the joints of `limits` in any order, one degree of freedom each.
        limits: those of the arm that must be kept; accelerations that the motors can give.
        tau_max: torque limits of the motors, N m.
        dt: step of the drive, between two calls of `torque`, s.
        observer_time: time constant of the observer of disturbances, s; inf for none. It needs
            velocities whose noise is far below the acceleration limits times this time.
        motor_lag: time constants of the motors' torques, shape (n,), s; none where not given.
        soft: whether the arm comes to rest softly, as where torques may not change at once.

    Attributes:
        acceleration: chosen in the last step, rad/s^2.
        at_rest: whether the arm came to rest and is held.
        torque_range: lowest and highest torques that the motors can give in the next step, each of
            shape (n,), N m; to be written where they may not change at once.
        returned: whether commands have all of their effect, and the limits have let them through
            for `PASS_TIME`: then they may act by themselves.

    Raises:
        JointLimitsError: other joints in `limits` than in `model`, or numbers that cannot be.
    """

    def __init__(
        self,
        model: pin.Model,
        limits: JointLimits,
        tau_max: ArrayLike,
        dt: float,
        *,
        observer_time: float = math.inf,
        motor_lag: ArrayLike | None = None,
        soft: bool = False,
    ) -> None:
        self._dynamics = Dynamics(model, limits.names)
        n = len(limits)
        torques = joint_array("tau_max", tau_max, limits.names)
        for name, value in zip(limits.names, torques.tolist(), strict=True):
            if not (math.isfinite(value) and value > 0.0):
                raise JointLimitsError("tau_max", name, value, "must be finite and positive")
        given = np.zeros(n) if motor_lag is None else motor_lag
        lag = joint_array("motor_lag", given, limits.names)
        margin = MARGIN * np.minimum(-limits.a_min, limits.a_max)
        self._solver = BoundsSolver(limits, HORIZON * dt, margin, period=dt)
        self._limits, self._dt, self._tau_max = limits, dt, torques
        self._share = 0.0 if math.isinf(observer_time) else -math.expm1(-dt / observer_time)
        self._scale = 0.5 * (limits.a_max - limits.a_min)
        self._lag = lag if lag.any() else None
        self.torque_range = -torques, torques
        self._soonest = max(dt, SOFT_REST) if soft else dt
        clear = np.minimum(HOLD_CLEARANCE, 0.5 * (limits.q_max - limits.q_min))
        self._lowest, self._highest = limits.q_min + clear, limits.q_max - clear
        self.start(np.zeros(n), np.zeros(n))

    def start(
        self,
        q: ArrayLike,
        v: ArrayLike,
        motor_torque: Array | None = None,
        acceleration: Array | None = None,
    ) -> None:
        """Start a stop; what an earlier one held and observed is forgotten.

        With an observer, and where the motors' last torque and the acceleration that it gave are
        told, what acts besides is balanced from the first step on, not only once it is observed:
        friction that is not known may be a torque step.
        """
        n = len(self._limits)
        q = joint_array("q", q, self._limits.names)
        v = joint_array("v", v, self._limits.names)
        self.acceleration: Array = np.zeros(n)
        self.at_rest = False
        self._place = q.copy()
        self._disturbance = np.zeros(n)
        self._expected = v.copy()
        if self._share and motor_torque is not None and acceleration is not None:
            besides = self._dynamics.torque(q, v, acceleration) - motor_torque
            self._disturbance = np.clip(besides, -self._tau_max, self._tau_max)
        self._M: Array | None = None
        self._resting = False  # the last step was one of a stop
        self._difference, self._share_left = np.zeros(n), 0.0
        self._passed_for = 0.0  # s; commands in a row that the limits let through

    @property
    def returned(self) -> bool:
        """Whether commands have all of their effect, and the limits let them through."""
        through = self._passed_for >= PASS_TIME
        return through and not (self._resting or self._share_left > 0.0)

    def time_to_rest(self, v: Array) -> float:
        """Return how long the arm takes to rest at most, but for a few steps, s."""
        return float((np.abs(v) / self._braking(v)).max())

    def forget_step(self) -> None:
        """The last torque did not act for just one step: learn no disturbance from it."""
        self._M = None

    def torque(self, q: Array, v: Array, motor_torque: Array | None = None) -> Array:
        """Return the torques to ask of the motors for the next step of the drive, N m.

        They are finite and within the torque limits for every finite state. `motor_torque` is that
        of the motors now, used where they have a lag; None where it is unknown: the lag is not
        accounted for then.
        """
        return self._torque(q, v, motor_torque, None)

    def follow(
        self, q: Array, v: Array, command: Array, motor_torque: Array | None = None
    ) -> Array:
        """Return the torques nearest to a command that keep the limits, N m; else as `torque`.

        After steps of a stop they go on from its torque.
        """
        return self._torque(q, v, motor_torque, command)

    def _torque(
        self, q: Array, v: Array, motor_torque: Array | None, command: Array | None
    ) -> Array:
        lead = v
        if self._lag is not None and motor_torque is not None:
            lead = v + self._lag * self._dynamics.acceleration(q, v, motor_torque)
        if self._share:
            self._observe(q, lead)
        if self._lag is not None and motor_torque is not None:
            a = self._dynamics.acceleration(q, v, motor_torque + self._disturbance)
            q, v = q + self._lag * v, v + self._lag * a
        h = self._dt
        lower, upper, viable = self._solver.bounds(q, v)
        outside = not viable.all()
        if outside:
            lower, upper = self._gentle_return(q, v, lower, upper)
        wanted = self._stopping(q, v) if command is None else self._commanded(q, v, command)
        a = np.minimum(np.maximum(wanted, lower), upper)
        if outside:
            a = np.where(viable, a, self._harder(q, v, a))
        # Commands that the limits change are not safe to act by themselves.
        passed = bool((np.abs(a - wanted) <= MARGIN * self._scale).all())
        self._passed_for = self._passed_for + h if passed and command is not None else 0.0
        middle = q + 0.5 * h * v + 0.125 * h * h * a, v + 0.5 * h * a
        tau = self._dynamics.torque(*middle, a) - self._disturbance
        low, high = self.torque_range
        feasible = bool(((tau >= low) & (tau <= high)).all())
        if self._share or not feasible:
            self._M = M = self._dynamics.mass_matrix(middle[0])
            if not feasible:
                nearest = self._nearest(tau, a, lower, upper, M, (low, high))
                tau = np.clip(tau + M @ (nearest - a), low, high)
                middle = q + 0.5 * h * v + 0.125 * h * h * nearest, v + 0.5 * h * nearest
                a = self._dynamics.acceleration(*middle, tau + self._disturbance)
        self.acceleration = a
        self._expected = lead + h * a
        return tau

    def _gentle_return(
        self, q: Array, v: Array, lower: Array, upper: Array
    ) -> tuple[Array, Array]:
        """Return bounds by which joints come back from outside at `RETURN_SPEED`, not at once."""
        limits, time = self._limits, HORIZON * self._dt
        speed = RETURN_SPEED * limits.v_max
        down = np.minimum((-speed - v) / time, limits.a_max)
        up = np.maximum((speed - v) / time, limits.a_min)
        above, below = (q > limits.q_max) & (v <= 0.0), (q < limits.q_min) & (v >= 0.0)
        return (
            np.where(below, np.minimum(lower, up), lower),
            np.where(above, np.maximum(upper, down), upper),
        )

    def _harder(self, q: Array, v: Array, a: Array) -> Array:
        """Return `a`, or more braking where that stops a joint outside its kernel in time."""
        limits, speed = self._limits, np.abs(v)
        room = np.where(v > 0.0, limits.q_max - q, q - limits.q_min)
        at_once = speed / self._dt
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.where(room > 0.0, 0.5 * v * v / room, at_once)
        lowest, highest = limits.velocities(q)
        allowed = np.where(v > 0.0, highest, -lowest)
        needed = RESERVE * np.maximum(needed, (speed - allowed) / self._dt)
        most = self._braking(v)
        braking = np.minimum(np.minimum(needed, HARDER * most), at_once)
        harder = np.where(v > 0.0, np.minimum(a, -braking), np.maximum(a, braking))
        return np.where(needed > RESERVE * most, harder, a)

    def _braking(self, v: Array) -> Array:
        """Return the hardest braking within the acceleration limits, rad/s^2."""
        return np.where(v > 0.0, -self._limits.a_min, self._limits.a_max)

    def _stopping(self, q: Array, v: Array) -> Array:
        """Return accelerations that stop the arm, or hold it, regardless of its limits."""
        self._resting = True
        if not self.at_rest and float(np.abs(v).max()) <= REST_SPEED:
            self.at_rest = True
            self._place = np.clip(q, self._lowest, self._highest)
        if self.at_rest:
            off = self._place - q
            if float(np.abs(off).max()) <= GIVE_WAY:
                return HOLD_GAIN * (HOLD_GAIN * off - 2.0 * v)
            self.at_rest = False
        return -v * np.maximum(
            self._clearing(q, v), 1.0 / max(self.time_to_rest(v), self._soonest)
        )

    def _clearing(self, q: Array, v: Array) -> Array:
        """Return braking by which joints come to rest before `HOLD_CLEARANCE`, per speed, 1/s.

        It is that of the place where the speed limit lets them rest at the latest.
        """
        speed = np.abs(v)
        room = np.where(v > 0.0, self._highest - q, q - self._lowest) - self._limits.rest_distance
        at_once = np.where(speed > REST_SPEED, 1.0 / self._dt, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.minimum(np.where(room > 0.0, 0.5 * speed / room, np.inf), at_once)

    def _commanded(self, q: Array, v: Array, command: Array) -> Array:
        """Return the accelerations that a command gives; after a stop less of the difference."""
        a = self._dynamics.acceleration(q, v, command + self._disturbance)
        if self._resting:
            self._difference, self._share_left = self.acceleration - a, 1.0
        self._resting = self.at_rest = False
        self._share_left = max(0.0, self._share_left - self._dt / RETURN_TIME)
        return a + self._share_left * self._difference

    def _observe(self, q: Array, v: Array) -> None:
        """Attribute what the last step's velocity is off to a torque, but for a joint at rest."""
        if self._M is None:
            return
        torque = self._M @ ((v - self._expected) / self._dt)
        change = self._disturbance + self._share * torque
        settled = self.at_rest & (np.abs(self._place - q) < HOLD_WINDOW)
        self._disturbance = np.where(
            settled, self._disturbance, np.clip(change, -self._tau_max, self._tau_max)
        )

    def _nearest(
        self,
        tau: Array,
        a: Array,
        lower: Array,
        upper: Array,
        M: Array,
        torques: tuple[Array, Array],
    ) -> Array:
        """Return the accelerations nearest to `a` that the motors can give."""
        # More than the acceleration limits costs no other limit.
        lower = np.where(lower <= self._limits.a_min, -np.inf, lower)
        upper = np.where(upper >= self._limits.a_max, np.inf, upper)
        return within_torque_limits(a, lower, upper, self._scale, M, tau, *torques)
