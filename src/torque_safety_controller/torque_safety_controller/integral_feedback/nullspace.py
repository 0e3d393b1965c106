# SPDX-License-Identifier: Apache-2.0
"""Stiff in a task, free in its null space: [Benallegue2021], III-D.

The acceleration error ``s' = a_ref - v'`` is integrated into

    a = s - J^+ integral(J' s),   J a = integral(J s') = integral(e_T''),       (16), (25)

and the torque added to that of the reference is

    C a - M J^+ J' s - M (J^+)' integral(J' s)
        + (1 - mu) P^T K P a + mu K a_fast,   P = J^+ J,   K = lambda diag(M).  (21), (26)

The task's error is integrated, and its integral dies away; the null space is held by a memory of
some 10 ms only. The torque is linear in the memory (a, x), where x = a - a_fast is what the fast
memory has forgotten, and the stored energy is quadratic. `docs/theory/nullspace.md` derives
it, says where it leaves the paper, and proves that nothing in it grows for ever.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from torque_safety_controller.anti_windup import clip, scale_factor
from torque_safety_controller.integral_feedback.law import ArmTerms, IntegralLaw
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.integral_feedback.task_inverse import TaskInverse, task_inverse
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_SINGULAR = 1e-12  # relative size of singular values that are rounding
_AT_LIMIT = 1.0 - 1e-9


class TaskShapeError(ArmSafetyError, ValueError):
    """A task that leaves an arm no null space."""


class Memory(NamedTuple):
    """What lasts from one step to the next.

    Attributes:
        a: the error that dies away, eq. (16), shape (n,), rad/s.
        s: its part in the null space, (1 - J^+ J) a, shape (n,), rad/s.
        integral: integral(J' s), which is - J a, shape (m,).
        root: ``sqrt(diag M) x``, shape (n,): its square is the fast memory's energy whatever M
            does.
        v: velocity, shape (n,), rad/s.
        J: Jacobian of the task, shape (m, n).
    """

    a: Array
    s: Array
    integral: Array
    root: Array
    v: Array
    J: Array


class TaskLaw(IntegralLaw):
    """Integral action that is stiff in a task of m < n rows.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Attributes:
        MEMORY: type of the named tuple; its `integral` gets m numbers, `J` shape (m, n), all
            others n numbers.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    MEMORY: ClassVar[Any]

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        n = len(settings.budget)
        if not 0 < m < n:
            raise TaskShapeError(
                f"a task of {m} rows for {n} joints; null-space compliance needs 1 to {n - 1} rows"
            )
        shapes = {"integral": (m,), "J": (m, n)}
        arrays = (np.zeros(shapes.get(name, n)) for name in self.MEMORY._fields)
        super().__init__(settings, self.MEMORY(*arrays))

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralLaw`."""
        super().reset(arm)
        self.memory.J[:] = arm.J

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralLaw`."""
        super().skip(arm, dt)
        self.memory = self.memory._replace(J=arm.J.copy())

    def check(self, arm: ArmTerms, vector: Array) -> None:
        """Raise `ValueError` unless all is finite, and M can be a mass matrix."""
        M, C, J, J_dot, v = arm
        total = M.sum() + C.sum() + J.sum() + J_dot.sum() + v.sum() + vector.sum()
        if not (math.isfinite(total) and (np.diagonal(M) > 0.0).all()):
            raise ValueError("M must be positive definite, and all numbers finite")

    def felt_by_task(self, arm: ArmTerms, torque: Array) -> tuple[Array, Array]:
        """Return the a whose slow memory gives what the task feels of `torque`, and J^+.

        The task feels the force F = J^+^T torque. Where J a = y the slow torque is
        J^T ((1 - mu) J^+^T K J^+ y), which is J^T F for this y.

        Raises:
            ValueError: see `check`.
        """
        self.check(arm, torque)
        M, C, J, J_dot, _ = arm
        X, Y_inv, _ = task_inverse(J, J_dot, M, C + C.T)
        J_plus = X @ Y_inv
        K = self.settings.gain * np.diagonal(M)
        B = (1.0 - self.settings.mu) * (J_plus.T * K) @ J_plus
        return J_plus @ (np.linalg.pinv(B, _SINGULAR) @ (J_plus.T @ torque)), J_plus


class NullspaceCompliance(TaskLaw):
    """Additional torque that is stiff in a task of m < n rows."""

    MEMORY = Memory
    memory: Memory

    @property
    def leak_rates(self) -> dict[str, float]:
        """See `IntegralLaw`."""
        return dict.fromkeys(("a", "s", "integral", "root"), self.settings.slow_leak_rate)

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralLaw`."""
        settings, memory = self.settings, self.memory
        M, C, J, J_dot, v = arm
        slow, slow_gain = leak_factors(settings.slow_leak_rate, dt, False)
        fast, fast_gain = leak_factors(settings.fast_leak_rate, dt, False)
        inverse, weights = task_inverse(J, J_dot, M, C + C.T), M.diagonal()
        J_plus = inverse.X.dot(inverse.Y_inv)
        left = slow * memory.s
        s = left + slow_gain * (a_last * dt - (v - memory.v))
        # With the middle of s the product rule is exact: J a grows by the middle of J times the
        # increment of s.
        a = s - J_plus.dot(slow * memory.integral + (J - memory.J).dot(0.5 * (left + s)))
        # The fast memory takes fast_gain of what a gained, of which slow_gain is seen.
        ratio, root = fast_gain / slow_gain, np.sqrt(weights)
        x = (1.0 - ratio) * a + (ratio * slow - fast) * memory.a + fast * memory.root / root
        if slow > 0.0:
            a = a - (1.0 - fast / slow) * (a - J_plus.dot(J.dot(a)))
        H = _torque_matrix(arm, inverse, settings)
        torque = H.dot(a) - settings.mu * settings.gain * weights * x
        limited = not (np.abs(torque) <= settings.budget).all()
        if limited:
            a, x, torque = _limited(M, H, settings.budget, a, x, torque, fast_weight(settings))
        integral = -J.dot(a)
        s, root = a + J_plus.dot(integral), root * x
        if not math.isfinite(sum(torque.tolist()) + sum(s.tolist()) + sum(root.tolist())):
            raise ValueError("all numbers must be finite")
        self.memory = Memory(a, s, integral, root, v.copy(), J.copy())
        self.saturated = limited & (np.abs(torque) >= _AT_LIMIT * settings.budget)
        return torque

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralLaw`; the slow memory takes what the task feels of it."""
        a, J_plus = self.felt_by_task(arm, torque)
        zero, integral = np.zeros_like(a), -(arm.J @ a)
        forgets = self.settings.fast_leak_rate > self.settings.slow_leak_rate
        root = np.sqrt(np.diagonal(arm.M)) * a if forgets else zero
        null = a + J_plus @ integral
        self.memory = Memory(a, null, integral, root, arm.v.copy(), arm.J.copy())
        return self.torque(arm, zero, 0.0)


def fast_weight(settings: IntegralSettings) -> float:
    """Return the weight w of the fast memory in the energy (a'M a + w x' diag(M) x) / 2."""
    if settings.fast_leak_rate > settings.slow_leak_rate:
        return settings.mu * settings.gain / (settings.fast_leak_rate - settings.slow_leak_rate)
    return 0.0


def _torque_matrix(arm: ArmTerms, inverse: TaskInverse, settings: IntegralSettings) -> Array:
    """Return H of the torque H a - mu K x of eq. (21) with (26), shape (n, n).

    With J^+ J' s + (J^+)' integral, where s = (1 - P) a and integral = - J a, and with W = Y^-1 J
    and B = M X' W = J'^T W - M' P, all of (21) and (26) but the fast memory is

        H = C + B - W^T (J' + X^T (B - (1 - mu) K P) + (c D)' W) + mu K.
    """
    _, C, J, J_dot, _ = arm
    X, Y_inv, damping_rate = inverse
    K, mu = settings.gain * arm.M.diagonal(), settings.mu
    # dot takes half as long as @ for matrices of this size.
    W = Y_inv.dot(J)
    P = X.dot(W)
    B = J_dot.T.dot(W) - (C + C.T).dot(P)
    inner = J_dot + X.T.dot(B - ((1.0 - mu) * K)[:, None] * P) + damping_rate.dot(W)
    H: Array = C + B - W.T.dot(inner)
    H.ravel("K")[:: len(H) + 1] += mu * K
    return H


def _limited(
    M: Array, H: Array, limit: Array, a: Array, x: Array, torque: Array, weight: float
) -> tuple[Array, Array, Array]:
    """Return a memory and its torque with |torque| <= limit that stores no more energy.

    Scaling all of the memory by (10) does both, but weakens every joint for the sake of one.
    So a is changed such that only the torques beyond their limits change, to the limits. If
    that stores more energy than before, it is done in part: the memory is the furthest point
    on the way from the scaled one that does not. Both ends are within the limits, and with
    them the way.

    Args:
        M: mass matrix, shape (n, n).
        H: of `_torque_matrix`.
        limit: shape (n,), >= 0, may be infinite.
        a: shape (n,).
        x: shape (n,).
        torque: that they give, shape (n,).
        weight: of the fast memory in the energy, see `fast_weight`.

    Returns:
        a, x and their torque, shape (n,) each.
    """
    scale, cut = scale_factor(torque, limit), clip(torque, limit) - torque
    regular = H.copy()
    regular.ravel()[:: len(H) + 1] += _SINGULAR * (np.abs(H).max() + 1e-300)
    shift, way = lapack.dgesv(regular, cut)[2], 0.0
    if np.abs(H.dot(shift) - cut).max() <= 1e-6 * np.abs(cut).max():
        # How far from (scale a, scale x) to (a + shift, x) the energy is that of (a, x).
        da, dx = (1.0 - scale) * a + shift, (1.0 - scale) * x
        Ma, wx = M.dot(a), weight * M.diagonal() * x
        energy = a.dot(Ma) + x.dot(wx)  # twice, as the next two
        spare = (1.0 - scale * scale) * energy
        linear = scale * (da.dot(Ma) + dx.dot(wx))
        square = da.dot(M.dot(da)) + (1.0 - scale) * dx.dot(wx)
        if square + 2.0 * linear <= spare:
            way = 1.0
        else:
            root = math.sqrt(linear * linear + square * spare)
            way = spare / (linear + root) if linear > 0.0 else (root - linear) / square
    else:
        shift = np.zeros_like(a)
    keep = scale + way * (1.0 - scale)
    return keep * a + way * shift, keep * x, clip(keep * torque + way * cut, limit)
