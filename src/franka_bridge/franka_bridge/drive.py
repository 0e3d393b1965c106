# SPDX-License-Identifier: Apache-2.0
"""Which torques are sent to the robot: those of commands, or of the project's stop law.

In this project a torque is all that a motor gives. The robot adds g(q) of itself and of the load
that it was told, so what is sent is

    sent = tau - g_told(q),    tau = command + g(q), or command where that includes gravity.

A load that the robot does not know yet is in g, not in g_told: then it is part of what is sent.

Commands act by themselves as long as they come, and the limits of torque and torque rate let them
through. Others go through the stop law, which lets accelerations give way, not single torques.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.robot.gravity import Gravity, gravity_beyond
from viability_bounds_pkg.robot.payload import Payload
from viability_bounds_pkg.stop import CoordinatedStop

Array = NDArray[np.float64]

_OBSERVER_TIME = 0.01
"""Of the stop law's observer, s: measured velocities have noise."""

_SAME_TORQUE = 1e-3
"""Largest difference of what was sent and what the robot has of it, N m."""

_WITHIN = 1.0 - 1e-6
"""Share of steps of the torque that is used: states have torques with seven digits."""

_LEAST_RANGE = 0.1
"""Of the torques that the law counts with, in steps of the torque, where some came late."""


class Drive:
    """The law of the drives; arrays are of shape (n,), in the order of the joints.

    Args:
        model: of the arm, with the joints of `limits` in their order.
        limits: that a stop keeps.
        tau_max: torque limits, N m.
        rate_max: of what is sent, N m/s.
        dt: control period, s.
        gravity_included, effort_included: whether commands and reported torques include gravity.

    Attributes:
        stop: the stop law.
        payload: what the arm carries; `told` is what the robot knows of it.
        clipped: periods whose command was beyond the limits of torque or torque rate.
    """

    def __init__(
        self,
        model: pin.Model,
        limits: JointLimits,
        tau_max: Array,
        rate_max: Array,
        dt: float,
        gravity_included: bool,
        effort_included: bool,
    ) -> None:
        known = model.copy()
        self._model, self._frames = model, model.frames
        self.payload, self.told = Payload(model), Payload(known)
        self._gravity: Gravity | None = gravity_beyond(model, gravity_included)
        self._not_reported = gravity_beyond(model, effort_included)
        self._added = gravity_beyond(known, False) or (lambda q: np.zeros_like(q))
        self._tau_max, self._step = tau_max, _WITHIN * rate_max * dt
        self.stop = CoordinatedStop(
            model,
            limits,
            tau_max,
            dt,
            observer_time=_OBSERVER_TIME,
            soft=True,
        )
        self.clipped = 0
        self._sent = self._applied = np.zeros(len(limits))
        self._by_law = True  # until commands act by themselves

    @property
    def load_is_told(self) -> bool:
        """Whether the robot knows what the arm carries."""
        payload, told = self.payload, self.told
        return (payload.link, payload.inertia) == (told.link, told.inertia)

    def tell_load(self, flange: str) -> pin.Inertia:
        """Return the load that the robot is to be told, in the flange's axes; it is told then.

        Only what hangs on the flange's joint can be told.
        """
        link, load = self.payload.link, self.payload.inertia
        at = self._frames[frame_id(self._model, flange)]
        on = self._frames[frame_id(self._model, link)] if link else at
        if on.parentJoint != at.parentJoint:
            link, load = "", pin.Inertia.Zero()
        self.told.carry(link, load.mass, load.lever, load.inertia)
        return at.placement.actInv(on.placement.act(load))

    def start(self, q: Array, v: Array, applied: Array) -> None:
        """Begin with an arm to hold.

        Args:
            q: positions, rad.
            v: velocities, rad/s.
            applied: torques that the robot has as the last ones sent, N m.
        """
        self._sent = self._applied = applied.copy()
        self._start_law(q, v)

    def asked(self, q: Array, command: Array) -> Array:
        """Return the torque of the motors that a command asks for, N m."""
        return command if self._gravity is None else command + self._gravity(q)

    def reported(self, q: Array, measured: Array) -> Array:
        """Return the torques to report for those that the robot measures, N m."""
        return measured if self._not_reported is None else measured - self._not_reported(q)

    def torque(
        self,
        q: Array,
        v: Array,
        command: Array | None,
        held: bool,
        applied: Array,
        in_turn: bool = True,
    ) -> Array:
        """Return what to send, N m: finite, within the limits of torque and torque rate.

        Args:
            q: positions, rad.
            v: velocities, rad/s.
            command: torques; None to stop and hold.
            held: whether the command is one of an earlier period.
            applied: torques that the robot has as the last ones sent, N m.
            in_turn: whether the state is that of the period after the last one.
        """
        added, sent = self._added(q), self._sent
        if not (in_turn and _same(applied, sent)):
            self.stop.forget_step()
        # A step from what was sent last, and from what the robot has if that may be lost.
        base = applied if _same(applied, self._applied) else sent
        self._applied = applied
        highest = np.minimum(np.minimum(sent, base) + self._step, self._tau_max)
        lowest = np.maximum(np.maximum(sent, base) - self._step, -self._tau_max)
        lowest = np.minimum(lowest, highest)
        tau, follows = None, False
        if command is not None:
            tau = np.clip(self.asked(q, command), -self._tau_max, self._tau_max)
            wanted = tau - added
            through = bool(((lowest <= wanted) & (wanted <= highest)).all())
            self.clipped += not through
            follows = through and not held
        if not (self._by_law or follows):
            self._start_law(q, v)
        wide = np.minimum(lowest, highest - _LEAST_RANGE * self._step)
        low, high = np.clip([wide + added, highest + added], -self._tau_max, self._tau_max)
        self.stop.torque_range = low, high
        if tau is None:
            tau = self.stop.torque(q, v)
        elif self._by_law:
            tau = self.stop.follow(q, v, tau)
            self._by_law = held or not self.stop.returned
        sent = np.minimum(np.maximum(tau - added, lowest), highest)
        self._sent = np.where(np.isfinite(sent), sent, self._sent)
        return self._sent

    def _start_law(self, q: Array, v: Array) -> None:
        self.stop.start(q, v)
        self._by_law = True


def _same(one: Array, other: Array) -> bool:
    return bool((np.abs(one - other) <= _SAME_TORQUE).all())
