# SPDX-License-Identifier: Apache-2.0
"""The task that brings the joints to a posture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import RobotModel

Array = NDArray[np.float64]

_RANK_REGULARISATION = 1e-9


@dataclass(slots=True)
class PostureTask:
    """Brings the joints to `q_des`: eq. (34) of [DelPrete2018], eq. (6) of [Benallegue2021].

    In the paper posture and pose compete by their weights, and the pose comes to rest off its
    goal by about the ratio of the weights in m per rad. In the null space the stiffness acts only
    where it does not move the end effector, so that the pose is reached; damping acts everywhere
    either way.

    Attributes:
        q_des: desired positions, shape (n,), rad.
        kp: stiffness, 1/s^2.
        kd: damping, 1/s.
        weight: of the squared error of acceleration.
        in_null_space: whether the stiffness leaves the end effector alone.
        feedforward: ``kd v_des + a_des``, shape (n,), rad/s^2; None for a goal at rest.
        others: indices in `RobotModel.others` of further end effectors that the stiffness leaves
            alone, too.
    """

    q_des: Array
    kp: float
    kd: float
    weight: float
    in_null_space: bool = False
    feedforward: Array | None = None
    others: tuple[int, ...] = ()

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``a = kp (q_des - q) - kd v + feedforward`` as a term of the cost."""
        b = np.empty(len(self.q_des))
        J = robot.J if self.in_null_space else None
        if self.others:
            hands = [robot.others[hand].J for hand in self.others]
            J = np.vstack(hands if J is None else [J, *hands])
        _spring_and_damper(self.q_des, robot.q, robot.v, self.kp, self.kd, J, b)
        if self.feedforward is not None:
            b = b + self.feedforward
        return TaskTerm(None, b, self.weight)


@njit(cache=True, error_model="numpy")
def _spring_and_damper(
    q_des: Array, q: Array, v: Array, kp: float, kd: float, J: Array | None, b: Array
) -> None:
    """Write ``P kp (q_des - q) - kd v`` to b, shape (n,).

    P leaves what moves no hand, ``I - J' (J J' + r I)^-1 J`` with J of shape (m, n); r counts
    where J has lost rank, and there leaves in what the pose cannot feel. P is I without J.
    Compiled, and solved by Gauss without pivots, because NumPy takes four times as long.
    """
    for j in range(q.size):
        b[j] = kp * (q_des[j] - q[j])
    if J is not None:
        m = len(J)
        inner = np.zeros((m, m + 1))  # the last column becomes the solution
        for i in range(m):
            inner[i, i] = _RANK_REGULARISATION
            for j in range(q.size):
                inner[i, m] += J[i, j] * b[j]
                for k in range(m):
                    inner[i, k] += J[i, j] * J[k, j]
        for i in range(m):
            for row in range(m):
                if row != i:
                    factor = inner[row, i] / inner[i, i]
                    for k in range(i, m + 1):
                        inner[row, k] -= factor * inner[i, k]
        for i in range(m):
            for j in range(q.size):
                b[j] -= J[i, j] * inner[i, m] / inner[i, i]
    for j in range(q.size):
        b[j] -= kd * v[j]
