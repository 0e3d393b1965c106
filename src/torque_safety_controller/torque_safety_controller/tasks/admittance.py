# SPDX-License-Identifier: Apache-2.0
"""Admittance of the hand: it moves until it feels the wrench that it should.

[Benallegue2021], III-E (b), in the end effector's axes, with F what the environment does to the
arm:

    g_ob = -Kp (F_ref - F) - Kv (F_ref' - F').                                         (27)

Alone in the air, (27) and the damping kd of the pose task, with equal weights, would let the hand
go at Kp |F_ref| / kd. A limit of that speed, which the paper has not, keeps it from rushing at
what it is to touch, and from running away when what it leans on gives way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.pose_task import shorten
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import NOT_NEGATIVE, POSITIVE, numbers

Array = NDArray[np.float64]

KV = 1e-7
"""Kv of (27), that of Table I: m/s^2 per N/s, rad/s^2 per N m/s."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractionSettings:
    """What is done about forces at the hand; it may change while the controller runs.

    Raises:
        SettingError: directions other than zeros and ones.
    """

    force_directions: Array = numbers(
        "1 where target_wrench is exerted, else 0: along and about x, y, z of the end effector",
        length=6,
        default=(0.0,) * 6,
        live=True,
        note="zeros and ones",
    )
    admittance_kp: Array = numbers(
        "gains Kp of (27) for forces, m/s^2 per N, and moments, rad/s^2 per N m",
        NOT_NEGATIVE,
        length=2,
        default=(5e-3, 5e-3),
        live=True,
    )
    yield_threshold: Array = numbers(
        "force, N, and moment, N m, above which the hand yields; never if empty",
        POSITIVE,
        length=2,
        default=(),
        live=True,
    )

    def __post_init__(self) -> None:
        if not np.isin(self.force_directions, (0.0, 1.0)).all():
            raise SettingError("force_directions", self.force_directions, "zeros and ones")


def admittance(
    error: Array, error_rate: Array, kp: Sequence[float], speed_max: Sequence[float], kd: float
) -> Array:
    """Return g_ob of (27) within limits of speed, shape (6,), m/s^2 and rad/s^2.

    Args:
        error: F_ref - F, shape (6,), N and N m.
        error_rate: its time derivative, shape (6,).
        kp: for forces, m/s^2 per N, and for moments, rad/s^2 per N m.
        speed_max: that is asked for at most, against the damping, m/s and rad/s.
        kd: damping of the pose task, 1/s.
    """
    g = -KV * error_rate
    for i, part in enumerate((slice(3), slice(3, 6))):
        g[part] -= kp[i] * error[part]
        shorten(g[part], kd * speed_max[i])
    return g


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
