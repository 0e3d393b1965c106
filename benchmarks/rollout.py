# SPDX-License-Identifier: Apache-2.0
"""Drives one arm from goal to goal by the torques of a controller, each held for a period."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np
import pinocchio as pin

SUBSTEPS = 8
"""Steps of the integrator in a control period."""


class Arm(Protocol):
    """A controller of one arm."""

    def set_goal(self, q_des: np.ndarray) -> None:
        """Set the posture to reach, shape (n,), rad."""

    def torque(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return the torque to apply, shape (n,), N m, or None without a solution."""


def drive(arm: Arm, model: pin.Model, given: dict[str, np.ndarray]) -> dict[str, float]:
    """Return by how much limits were passed, over all goals.

    Where a controller has no solution, the arm brakes: it asks for ``-v / dt`` within its
    acceleration limits.

    Args:
        arm: controller.
        model: of the arm, for the integrator.
        given: ``goals``, shape (goals, n), rad; ``steps_per_goal``; ``start``, shape (n,), rad;
            ``dt``, s; the limits ``low``, ``high``, ``v_max``, ``a_max``, ``tau_max``.

    Returns:
        Largest excess of a position, rad, a speed, rad/s, and a torque, N m, below 0 where none
        was passed; share of steps without a solution; time of a step, us of the processor; and
        share of the way to the goals, as far as the limits allow them, that is left at their ends.
    """
    dt, a_max = float(given["dt"]), float(given["a_max"])
    low, high, tau_max = given["low"], given["high"], given["tau_max"]
    data, h = model.createData(), dt / SUBSTEPS
    q, v = given["start"].copy(), np.zeros(model.nv)
    position = speed = excess = -np.inf
    clock, steps, unsolved, left, way = 0.0, 0, 0, 0.0, 0.0
    for goal in given["goals"]:
        arm.set_goal(goal)
        reachable = np.clip(goal, low, high)
        way += np.abs(reachable - q).sum()
        for _ in range(int(given["steps_per_goal"])):
            begin = time.thread_time()
            tau = arm.torque(q, v)
            clock += time.thread_time() - begin
            steps += 1
            if tau is None or not np.isfinite(tau).all():
                unsolved += 1
                tau = pin.rnea(model, data, q, v, np.clip(-v / dt, -a_max, a_max))
                tau = np.clip(tau, -tau_max, tau_max)
            excess = max(excess, float((np.abs(tau) - tau_max).max()))
            for _ in range(SUBSTEPS):
                a = pin.aba(model, data, q + 0.5 * h * v, v, tau)
                q, v = q + h * v + 0.5 * h * h * a, v + h * a
                position = max(position, float(np.maximum(q - high, low - q).max()))
                speed = max(speed, float(np.abs(v).max() - given["v_max"]))
        left += np.abs(reachable - q).sum()
    return {
        "position": position,
        "speed": speed,
        "torque": excess,
        "unsolved": unsolved / steps,
        "microseconds": 1e6 * clock / steps,
        "left": left / way,
    }
