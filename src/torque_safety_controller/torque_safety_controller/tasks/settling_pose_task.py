# SPDX-License-Identifier: Apache-2.0
"""The pose task with the curvature of the hand's path, so that it settles out of reach, too.

`PoseTask` alone leaves the linear least-squares problem that its Jacobian makes of a step,
(J'J) a = J' (kp e - kd J v). Where the goal is out of reach the error r that is left cannot act,
J'r = 0, but J turns with the joints: the stiffness is kp (J'J + S) with

    S_ij = -r . d^2 x / dq_i dq_j,

the curvature of the hand's path x(q) in the direction of r. For a joint direction in which J is
weak, sigma, the acceleration is then -kp (1 + S / sigma^2) dq - kd v: far too stiff for its
damping, and infinitely so for an arm that is stretched out. The term

    (a + kd v)' T (a + kd v),    T = S+ / 4,

of the cost, with + for S without its negative eigenvalues, makes the stiffness kp (J'J + S) /
(J'J + T) <= 4 kp in every joint direction and leaves the damping as it is: with a critical kd the
damping ratio is at least 1/2. `NEGLIGIBLE` is taken off the eigenvalues of T. Where the goal can
be reached r = 0, and nothing differs from `PoseTask`. While limits hold the arm back on its way r
is not zero, and T slows it down; `error_max` keeps r small, so that this is little.
`docs/out_of_reach.md` has the numbers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import HandModel
from torque_safety_controller.tasks.pose_task import PoseTask
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

STIFFENING = 4.0
"""How many times kp a joint direction may be stiff."""

NEGLIGIBLE = 1e-3
"""What is taken off the eigenvalues of T, m^2 and rad^2, so that noise of r does nothing.

A posture task with the usual weight of 1e-3 of that of the pose makes up for it.
"""


class SettlingPoseTask(PoseTask):
    """`PoseTask` that comes to rest where its goal is out of reach; for use with `error_max`."""

    __slots__ = ()

    def term(self, robot: HandModel) -> TaskTerm:
        """Return the term of `PoseTask`, with the curvature by the error that did not act.

        That error is what the last step left of the acceleration asked for,
        r = (b - J a_last) / kp.
        """
        J, b, weight = super().term(robot)
        if self.kp == 0.0 or J is None:
            return TaskTerm(J, b, weight)
        return TaskTerm(*with_curvature(J, b, robot.v, robot.a_last, self.kp, self.kd), weight)


@compiled
def with_curvature(
    J: Array, b: Array, v: Array, a_last: Array, kp: float, kd: float
) -> tuple[Array, Array]:
    """Return A and b with |A a - b|^2 = |J a - b|^2 + (a + kd v)' T (a + kd v) + constant.

    Args:
        J: Jacobian of the hand in its own axes, linear rows first, shape (6, n).
        b: acceleration of the hand that is asked for, less J'v, shape (6,).
        v: velocities, shape (n,), rad/s.
        a_last: accelerations commanded last, shape (n,), rad/s^2.
        kp: stiffness, 1/s^2, > 0.
        kd: damping, 1/s.

    Returns:
        As given where T is negligible, or else of shapes (6 + n, n) and (6 + n,).
    """
    n = len(v)
    T = curvature(J, (b - J @ a_last) / (STIFFENING * kp))
    if not np.isfinite(T).all() or n * np.abs(T).max() < NEGLIGIBLE:
        return J, b
    values, vectors = np.linalg.eigh(T)
    rows, right = np.empty((6 + n, n)), np.empty(6 + n)
    rows[:6], right[:6] = J, b
    for k in range(n):
        size = math.sqrt(max(values[k] - NEGLIGIBLE, 0.0))
        speed = 0.0
        for i in range(n):
            rows[6 + k, i] = size * vectors[i, k]
            speed += rows[6 + k, i] * v[i]
        right[6 + k] = -kd * speed
    return rows, right


@compiled
def curvature(J: Array, r: Array) -> Array:
    """Return S_ij = -r . d^2 x / dq_i dq_j of a chain of revolute and prismatic joints.

    Joint j turns with axis w_j and moves the hand with t_j, the columns of J. A joint i nearer to
    the base turns both: d t_j / dq_i = w_i x t_j and d w_j / dq_i = w_i x w_j. The other way round
    the rotation's is zero; its second derivative is the mean of both, because accelerations of a
    rotation are those of the angular velocity.

    Args:
        J: shape (6, n), linear rows first, all in the same axes; joints from base to hand.
        r: error of translation, m, and rotation, rad, in these axes, shape (6,).

    Returns:
        Shape (n, n), symmetric.
    """
    n = J.shape[1]
    S = np.empty((n, n))
    for i in range(n):
        x, y, z = J[3, i], J[4, i], J[5, i]
        # r . (w x t) = t . (r x w)
        linear0, linear1, linear2 = r[1] * z - r[2] * y, r[2] * x - r[0] * z, r[0] * y - r[1] * x
        turn0, turn1, turn2 = r[4] * z - r[5] * y, r[5] * x - r[3] * z, r[3] * y - r[4] * x
        for j in range(i, n):
            linear = linear0 * J[0, j] + linear1 * J[1, j] + linear2 * J[2, j]
            angular = turn0 * J[3, j] + turn1 * J[4, j] + turn2 * J[5, j]
            S[i, j] = S[j, i] = -linear - 0.5 * angular
    return S
