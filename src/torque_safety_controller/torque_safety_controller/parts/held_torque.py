# SPDX-License-Identifier: Apache-2.0
"""Rows of missed deadlines: the acceleration under a torque that is held for all of them.

A torque is right for the middle of a control period. Held for longer, its acceleration drifts on
with the motion: its mean over a time T is

    a + (T - dt) / 2 da/dt,    da/dt = A a + b,

with A and b the same for all accelerations a. The bounds are for this mean, too; that over any
part of T is between both. `docs/theory/bounds.md` has the proof.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.qp import LinearConstraints
from torque_safety_controller.step import Part, Step
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

YIELD = 0.1
"""Scale of the rows. Where they contradict the bounds they yield, as most torques are not held."""


class HeldTorque(Part):
    """Keeps the mean acceleration over the longest time that a torque is held in the bounds.

    Args:
        model: the arm, n joints with one coordinate each.
        held: longest time for which a torque is held, s, more than `dt`.
        dt: control period, s.
    """

    def __init__(self, model: pin.Model, held: float, dt: float) -> None:
        self._model, self._data = model, model.createData()
        self._held, self._later = held, 0.5 * (held - dt)

    def prepare(self, step: Step) -> None:
        """Add the rows ``lower <= a + (T - dt) / 2 (A a + b) <= upper``."""
        robot = step.robot
        state = State(robot.q, robot.v).after(step.a_last, 0.5 * self._held)
        A, b = drift_under_held_torque(self._model, self._data, state)
        G = np.eye(robot.n) + self._later * A
        lower, upper = step.commanded(step.bounds)
        # Rows are for real accelerations; these bounds know of the disturbance already.
        known = G @ step.disturbance - self._later * b
        step.rows[self] = LinearConstraints(
            YIELD * G, YIELD * (lower + known), YIELD * (upper + known)
        )


def drift_under_held_torque(model: pin.Model, data: pin.Data, state: State) -> tuple[Array, Array]:
    """Return A, shape (n, n), 1/s, and b, shape (n,), rad/s^3: da/dt is ``A a + b``.

    By ``M da/dt = -(M' + dh/dv) a - dh/dq v`` at constant torque, h the bias torques, M' = C + C'.
    """
    q, v = state
    C = pin.computeCoriolisMatrix(model, data, q, v)
    M_dot = C + C.T
    h = pin.nonLinearEffects(model, data, q, v)
    by_q, by_v, M_inv = pin.computeABADerivatives(model, data, q, v, h)
    return by_v - M_inv @ M_dot, by_q @ v
