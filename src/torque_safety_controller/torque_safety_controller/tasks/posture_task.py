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
        pull = self.kp * (self.q_des - robot.q)
        hands = [robot.J] if self.in_null_space else []
        hands += [robot.others[hand].J for hand in self.others]
        if hands:
            # Regularised where J has lost rank; there it leaves in what the pose cannot feel.
            J = hands[0] if len(hands) == 1 else np.vstack(hands)
            pull = _in_null_space(J, pull)
        b = pull - self.kd * robot.v
        if self.feedforward is not None:
            b = b + self.feedforward
        return TaskTerm(None, b, self.weight)


@njit(cache=True)
def _in_null_space(J: Array, a: Array) -> Array:
    """Return what of accelerations moves no hand, ``a - J' (J J' + r I)^-1 J a``, shape (n,).

    All of `a` where it or J, shape (m, n), is not finite. Compiled, because NumPy takes
    four times as long.
    """
    inner = J @ J.T + _RANK_REGULARISATION * np.eye(len(J))
    moved = J @ a
    if not (np.isfinite(inner).all() and np.isfinite(moved).all()):
        return a
    return a - J.T @ np.linalg.solve(inner, moved)
