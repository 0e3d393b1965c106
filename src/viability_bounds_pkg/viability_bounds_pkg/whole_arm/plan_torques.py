# SPDX-License-Identifier: Apache-2.0
"""Torques along a braking plan, at all of its samples at once."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.whole_arm.braking_plan import fill_plan, passed, samples, stop_times

Array = NDArray[np.float64]


class PlanTorques:
    """The plan that was looked at last, its torques and what they leave of the limits.

    Arrays have one row for each sample, and a column for each of the n joints.

    Args:
        model: the arm, n joints with one coordinate each.
        q_min: lowest positions at which plans end, shape (n,), rad.
        q_max: highest, shape (n,), rad.
        braking: hardest braking where no position limit asks for more, shape (n,), rad/s^2.
        tau_max: torque that the plans may use, shape (n,), N m.
        dt: control period, s.
        tolerance: by how far a joint may come to stand beyond a position limit, shape (n,), rad.

    Attributes:
        times: when each joint stands, shape (n,), s.
        clock: times of the samples, s; inf at rest.
        positions: rad.
        velocities: rad/s.
        accelerations: rad/s^2.
        tau: torques that are needed, N m.
        loads: largest torque of each joint along the plan, as a share of its limit, shape (n,).
        busiest: samples after the first at which most of each is needed, shape (n,).
        beyond: by how far a position limit is passed, less the tolerance, rad; 0 where none is.
    """

    def __init__(
        self,
        model: pin.Model,
        q_min: Array,
        q_max: Array,
        braking: Array,
        tau_max: Array,
        dt: float,
        tolerance: Array,
    ) -> None:
        n = model.nv
        count = samples(n)
        self._q_min, self._q_max, self._braking = q_min, q_max, braking
        self._tau_max, self._dt, self._tolerance = tau_max, dt, tolerance
        self._pool = pin.ModelPool(model, 1)
        self.times, self.clock = np.full(n, dt), np.zeros(count)
        self.positions, self.velocities, self.accelerations, self.tau = (
            np.zeros((count, n)) for _ in range(4)
        )
        # Pinocchio has a column for each sample.
        self._columns = tuple(
            each.T for each in (self.positions, self.velocities, self.accelerations, self.tau)
        )
        self.loads, self.busiest = np.zeros(n), np.zeros(n, dtype=np.int64)
        self.beyond = 0.0

    def plan(self, q: Array, v: Array, T: float, extra: Array) -> float:
        """Make the plan of time `T`; return what `follow` does.

        Args:
            q: positions at its beginning, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            T: time of the plan, s.
            extra: torque that the motors give besides, shape (n,), N m.
        """
        stop_times(
            q,
            v,
            T,
            self._q_min,
            self._q_max,
            self._tolerance,
            self._braking,
            self._dt,
            self.times,
        )
        return self.follow(q, v, self.times, extra)

    def follow(self, q: Array, v: Array, times: Array, extra: Array) -> float:
        """Compute the plan of given times; return the least share that it leaves of a limit.

        Negative where a torque limit is passed.

        Args:
            q: positions at its beginning, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            times: when each joint stands, shape (n,), s.
            extra: torque that the motors give besides, shape (n,), N m.
        """
        self.times[:] = times
        self.beyond = passed(q, v, times, self._q_min, self._q_max, self._tolerance)
        fill_plan(
            q,
            v,
            times,
            self.positions,
            self.velocities,
            self.accelerations,
            self.clock,
        )
        pin.rneaInParallel(1, self._pool, *self._columns)
        slack: float = measure(self.tau, extra, self._tau_max, self.loads, self.busiest)
        return slack

    @property
    def cost(self) -> float:
        """How much of the torque limits the plan needs, of all joints together."""
        squares = self.loads * self.loads
        return float(squares @ squares)


@compiled
def measure(
    tau: Array, extra: Array, tau_max: Array, loads: Array, busiest: NDArray[np.int64]
) -> float:
    """Add `extra` to torques in place, fill in the largest shares; return 1 less the largest.

    Args:
        tau: torques at the samples, shape (k, n), N m.
        extra: shape (n,), N m.
        tau_max: shape (n,), N m.
        loads: largest share of each joint's limit, shape (n,).
        busiest: the sample after the first with the largest torque of each joint, shape (n,).
    """
    count, n = tau.shape
    most = 0.0
    for j in range(n):
        loads[j] = -1.0
        busiest[j] = count - 1
    for k in range(count - 1, -1, -1):
        for j in range(n):
            tau[k, j] += extra[j]
            load = abs(tau[k, j]) / tau_max[j]
            # Written so that a NaN counts as too much.
            if not load <= loads[j]:
                loads[j] = load
                if k > 0:
                    busiest[j] = k
    for j in range(n):
        if not loads[j] <= most:
            most = loads[j]
    return 1.0 - most
