"""The admittance task: the hand moves until it feels the wrench that it should.

[Benallegue2021], III-E (b), in the end effector's axes, with F what the environment does to the
arm:

    g_ob = -Kp (F_ref - F) - Kv (F_ref' - F').                                         (27)

Alone in the air, (27) and the damping kd of the pose task, with equal weights, would let the hand
go at Kp |F_ref| / kd. A limit of that speed, which the paper has not, keeps it from rushing at
what it is to touch, and from running away when what it leans on gives way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from torque_safety_controller.qp.terms import TaskTerm
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.compiled import compiled


@dataclass(frozen=True)
class AdmittanceGains:
    """Gains of (27); the defaults are those of Table I.

    Attributes:
        force_kp: m/s^2 per N.
        force_kd: m/s^2 per N/s.
        moment_kp: rad/s^2 per N m.
        moment_kd: rad/s^2 per N m/s.
        speed_max: m/s that it asks for at most, against the damping of the pose task.
        turn_max: rad/s, likewise.
    """

    force_kp: float = 5e-3
    force_kd: float = 1e-7
    moment_kp: float = 5e-3
    moment_kd: float = 1e-7
    speed_max: float = math.inf
    turn_max: float = math.inf

    def acceleration(
        self, error: np.ndarray, error_rate: np.ndarray, damping: float
    ) -> np.ndarray:
        """Return g_ob of (27), shape (6,), m/s^2 and rad/s^2, within the limits of speed.

        Args:
            error: F_ref - F, shape (6,), N and N m.
            error_rate: its time derivative, shape (6,).
            damping: that it acts against, 1/s.
        """
        return _acceleration(
            error,
            error_rate,
            self.force_kp,
            self.force_kd,
            damping * self.speed_max,
            self.moment_kp,
            self.moment_kd,
            damping * self.turn_max,
        )


@compiled
def _acceleration(
    error: np.ndarray,
    error_rate: np.ndarray,
    force_kp: float,
    force_kd: float,
    force_most: float,
    moment_kp: float,
    moment_kd: float,
    moment_most: float,
) -> np.ndarray:
    """Return g_ob of (27), shape (6,); parts beyond their greatest size are made shorter."""
    g = np.empty(6)
    for first, kp, kd, most in (
        (0, force_kp, force_kd, force_most),
        (3, moment_kp, moment_kd, moment_most),
    ):
        size = 0.0
        for i in range(first, first + 3):
            g[i] = -kp * error[i] - kd * error_rate[i]
            size += g[i] * g[i]
        size = math.sqrt(size)
        if size > most:
            for i in range(first, first + 3):
                g[i] *= most / size
    return g


@dataclass(slots=True)
class AdmittanceTask:
    """(27) as a task on the joint accelerations.

    It shares the Jacobian of the pose task. With the weight of that, each is served by half, as
    in the paper: along a direction of both the hand accelerates by their mean.

    Attributes:
        acceleration: g_ob, shape (6,).
        weight: of the squared error of acceleration.
        rows: directions in which it acts, shape (m,), indices; None for all.
    """

    acceleration: np.ndarray
    weight: float
    rows: np.ndarray | None = None

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``J a = g_ob - J' v`` as a term of the cost."""
        b = self.acceleration - robot.drift
        if self.rows is None:
            return TaskTerm(robot.J, b, self.weight)
        return TaskTerm(robot.J[self.rows], b[self.rows], self.weight)
