# SPDX-License-Identifier: Apache-2.0
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
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import RobotModel

Array = NDArray[np.float64]

_PARTS = slice(3), slice(3, 6)  # of a wrench: force and moment


@dataclass(frozen=True)
class AdmittanceGains:
    """Gains of (27), each for forces and for moments; the defaults are those of Table I.

    Attributes:
        kp: m/s^2 per N, rad/s^2 per N m.
        kd: m/s^2 per N/s, rad/s^2 per N m/s.
        speed_max: that it asks for at most, against the damping of the pose task, m/s, rad/s.
    """

    kp: tuple[float, float] = (5e-3, 5e-3)
    kd: tuple[float, float] = (1e-7, 1e-7)
    speed_max: tuple[float, float] = (math.inf, math.inf)

    def acceleration(self, error: Array, error_rate: Array, damping: float) -> Array:
        """Return g_ob of (27), shape (6,), m/s^2 and rad/s^2, within the limits of speed.

        Args:
            error: F_ref - F, shape (6,), N and N m.
            error_rate: its time derivative, shape (6,).
            damping: that it acts against, 1/s.
        """
        kp, kd = self._by_axis
        g: Array = -kp * error - kd * error_rate
        for part, speed_max in zip(_PARTS, self.speed_max, strict=True):
            if speed_max < math.inf:
                most, size = damping * speed_max, math.hypot(*g[part].tolist())
                if size > most:
                    g[part] *= most / size
        return g

    @cached_property
    def _by_axis(self) -> tuple[Array, Array]:
        return np.repeat(self.kp, 3), np.repeat(self.kd, 3)


@dataclass(frozen=True, eq=False)
class InteractionSettings:
    """What is done about forces at the hand; it may change while the controller runs.

    Attributes:
        directions: of the end effector's axes, those in which force is controlled, shape (6,),
            bool.
        gains: of the admittance task when a wrench is exerted.
        yield_threshold: force and moment above which the hand yields, N and N m; None never.
        yielding_gains: of the admittance task when it does.
    """

    directions: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(6, dtype=bool))
    gains: AdmittanceGains = AdmittanceGains()
    yield_threshold: tuple[float, float] | None = None
    yielding_gains: AdmittanceGains = AdmittanceGains((0.1, 1.0), (0.0, 0.0), (0.25, 1.0))


@dataclass(slots=True)
class AdmittanceTask:
    """(27) as a task on the joint accelerations.

    It shares the Jacobian of the pose task. With the weight of that, each is served by half, as
    in the paper: along a direction of both the hand accelerates by their mean.

    Attributes:
        acceleration: g_ob, shape (6,).
        weight: of the squared error of acceleration.
        rows: directions in which it acts, shape (m,), indices.
    """

    acceleration: Array
    weight: float
    rows: NDArray[np.int64]

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``J a = g_ob - J' v`` as a term of the cost."""
        b = self.acceleration - robot.drift
        return TaskTerm(robot.J[self.rows], b[self.rows], self.weight)
