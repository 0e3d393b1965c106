"""Stiff in a task, free in its null space: [Benallegue2021], III-D.

The acceleration error ``s' = a_ref - v'`` is integrated into

    a = s - J^+ integral(J' s),   J a = integral(J s') = integral(e_T''),       (16), (25)

and the torque added to that of the reference is

    C a - M J^+ J' s - M (J^+)' integral(J' s)
        + (1 - mu) P^T K P a + mu K a_fast,   P = J^+ J,   K = lambda diag(M).  (21), (26)

The task's error is integrated, and its integral dies away; the null space is held by a memory of
some 10 ms only. `docs/nullspace_compliance.md` says where this leaves the paper, and proves that
nothing in it grows for ever.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.linalg.generalized_inverse import check_task_shape
from torque_safety_controller.nullspace import kernels
from torque_safety_controller.nullspace.law import Law
from torque_safety_controller.nullspace.settings import NullspaceSettings
from viability_bounds_pkg.exceptions import SettingError

__all__ = ["NullspaceCompliance", "NullspaceSettings"]

Array = NDArray[np.float64]


class NullspaceCompliance:
    """Additional torque of one arm that is stiff in a task of m < n rows, and compliant elsewhere.

    Another task is another object, `seed`-ed with the additional torque of the one before.

    Args:
        settings: may be replaced between steps: the torque does not jump.
        m: rows of the task's Jacobian.

    Attributes:
        additional_torque: what `torque` or `seed` returned last, shape (n,), N m.
        near_singular: whether J was so near to a singularity in the last step that some
            direction of the task was not fully served.
        limited: whether the budgets cut the memory in the last step.

    Raises:
        GeneralizedInverseError: `m` leaves n joints no null space.
    """

    def __init__(self, settings: NullspaceSettings, m: int) -> None:
        n = len(settings.budget)
        check_task_shape(m, n)
        self._shapes = (n, m)
        self._memory = kernels.Memory(
            *(np.zeros(size) for size in (n, m, n, n, n, n, n)), np.zeros((m, n)), np.eye(n)
        )
        self._next: NullspaceSettings | None = None
        self._adopt(settings)
        self.additional_torque = np.zeros(n)
        self.near_singular = self.limited = self._started = False
        # The first call compiles; let it be this one and not one in a control loop.
        zero, square = np.zeros(n), np.zeros((n, n))
        self.torque(np.eye(n), square, np.eye(m, n), np.zeros((m, n)), zero, zero, 0.0)
        self.skip(zero, np.eye(m, n), 0.0)
        _ = self.energy
        self._started = False

    @property
    def settings(self) -> NullspaceSettings:
        """Settings; new ones begin after the next step, with the torque that the old ones gave."""
        return self._settings if self._next is None else self._next

    @settings.setter
    def settings(self, settings: NullspaceSettings) -> None:
        n = self._shapes[0]
        if settings.budget.shape != (n,):
            raise SettingError("budget", settings.budget, f"one number for each of {n} joints")
        if self._started:
            self._next = settings
        else:
            self._adopt(settings)

    def start(self, v: ArrayLike, J: ArrayLike) -> None:
        """Forget everything.

        Args:
            v: velocity that increments of s count from, shape (n,), rad/s.
            J: Jacobian that increments of J count from, shape (m, n).

        Raises:
            ValueError: v or J is unusable.
        """
        v, J = self._vector("v", v), self._jacobian(J)
        for array in self._memory[:-3]:
            array[:] = 0.0
        self._memory.v[:] = v
        self._memory.J[:] = J
        self.additional_torque = np.zeros(self._shapes[0])
        self.near_singular = self.limited = False
        self._started = True
        if self._next is not None:
            self._adopt(self._next)

    def torque(
        self, M: Array, C: Array, J: Array, J_dot: Array, v: Array, a_ref_last: Array, dt: float
    ) -> Array:
        """Return the additional torque of a control step, shape (n,), N m.

        To be called once a step, before the QP. The first call is a `start`.

        Args:
            M: mass matrix, shape (n, n), kg m^2.
            C: Coriolis matrix with M' - 2 C skew-symmetric, as Pinocchio's, shape (n, n).
            J: Jacobian of the task, shape (m, n).
            J_dot: its time derivative, shape (m, n).
            v: velocity, shape (n,), rad/s.
            a_ref_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            dt: time since the last step, s.

        Raises:
            ValueError: wrong shapes, numbers that are not finite, M not positive definite, or
                dt < 0; nothing has changed then.
        """
        self._check(M, C, J, J_dot, v, a_ref_last)
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt must be a finite number >= 0, is {dt}")
        if not self._started:
            self.start(v, J)
        torque = np.empty(self._shapes[0])
        self._step(M, C, J, J_dot, v, a_ref_last, dt, False, torque)
        if self._next is not None:
            old, new = self._settings, self._next
            self._adopt(new)
            if not _same_torque(old, new):
                self._step(M, C, J, J_dot, v, a_ref_last, 0.0, True, torque)
        return torque

    def seed(
        self, additional_torque: ArrayLike, M: Array, C: Array, J: Array, J_dot: Array, v: Array
    ) -> Array:
        """Set the memory so that the additional torque is this one; return it.

        The slow memory takes what the task feels of it, and keeps it; the rest fades with
        `blend_time`. A budget that it exceeds is widened, only as far as it must, and returns to
        what it should be with `widening_time`. The returned torque is this step's; `torque` goes
        on from it in the next.

        Args:
            additional_torque: shape (n,), N m.
            M: mass matrix, shape (n, n), kg m^2.
            C: Coriolis matrix, shape (n, n).
            J: Jacobian of the task, shape (m, n).
            J_dot: its time derivative, shape (m, n).
            v: velocity that increments of s count from, shape (n,), rad/s.

        Raises:
            ValueError: unusable arguments; nothing has changed then.
        """
        torque = self._vector("additional_torque", additional_torque)
        self._check(M, C, J, J_dot, v, v)
        now, following = self._settings, self._next
        self._adopt(self.settings)
        try:
            self._step(M, C, J, J_dot, v, v, 0.0, True, torque)
        except ValueError:
            self._adopt(now)
            self._next = following
            raise
        self._started = True
        return torque

    def skip(self, v: ArrayLike, J: ArrayLike, dt: float) -> None:
        """Let a time pass of which nothing is known: the memory only leaks, and is not kicked.

        Args:
            v: velocity that increments count from now on, shape (n,), rad/s.
            J: Jacobian of the task now, shape (m, n).
            dt: how long it took, s; 0 if that is not known.

        Raises:
            ValueError: v, J or dt is unusable.
        """
        v, J = self._vector("v", v), self._jacobian(J)
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt must be a finite number >= 0, is {dt}")
        if not self._started:
            self.start(v, J)
        kernels.pause(self._memory, self._law, v, J, float(dt))

    @property
    def a(self) -> Array:
        """The error that dies away, eq. (16), shape (n,), rad/s."""
        return self._memory.a.copy()

    @property
    def a_fast(self) -> Array:
        """What its fast memory holds, shape (n,), rad/s."""
        return self._memory.a - self._memory.root / np.sqrt(np.diagonal(self._memory.M))

    @property
    def task_integral(self) -> Array:
        """J a: the integral of the task's acceleration error, eq. (25), shape (m,)."""
        return self._memory.J @ self._memory.a

    @property
    def energy(self) -> float:
        """What the memory stores, J: without a disturbance it only decreases."""
        return kernels.storage(self._memory, self._law)

    def _step(self, M, C, J, J_dot, v, a_ref, dt: float, entering: bool, torque: Array) -> None:
        outcome = kernels.step(
            self._memory,
            self._law,
            self._budget,
            # Arrays of another order in memory would have it compiled anew.
            np.ascontiguousarray(M),
            np.ascontiguousarray(C),
            np.ascontiguousarray(J),
            np.ascontiguousarray(J_dot),
            v,
            a_ref,
            float(dt),
            entering,
            torque,
        )
        if outcome == kernels.FAILED:
            raise ValueError("M must be positive definite, and all numbers finite")
        self.near_singular = bool(outcome & kernels.NEAR_SINGULAR)
        self.limited = bool(outcome & kernels.LIMITED)
        self.additional_torque = torque

    def _adopt(self, settings: NullspaceSettings) -> None:
        self._settings, self._next = settings, None
        self._budget = settings.budget.copy()
        self._law = _law(settings)

    def _check(self, M, C, J, J_dot, v, a) -> None:
        n, m = self._shapes
        if not (
            M.shape == C.shape == (n, n)
            and J.shape == J_dot.shape == (m, n)
            and v.shape == a.shape == (n,)
        ):
            raise ValueError(
                f"for {n} joints and a task of {m} rows: M {M.shape}, C {C.shape}, J {J.shape}, "
                f"J_dot {J_dot.shape}, {v.shape}, {a.shape}"
            )

    def _vector(self, name: str, x: ArrayLike) -> Array:
        x = np.array(x, dtype=np.float64)
        if x.shape != self._shapes[:1] or not np.isfinite(x).all():
            raise ValueError(f"{name} must be {self._shapes[0]} finite numbers, is {x}")
        return x

    def _jacobian(self, J: ArrayLike) -> Array:
        J = np.array(J, dtype=np.float64)
        n, m = self._shapes
        if J.shape != (m, n) or not np.isfinite(J).all():
            raise ValueError(f"J must be {m} by {n} finite numbers, is {J}")
        return J


def _law(settings: NullspaceSettings) -> Law:
    return Law(
        *(
            float(getattr(settings, name))
            for name in ("lambda_", "mu", "theta_slow", "theta_fast", "null_rate", "threshold")
        ),
        float(settings.blend_time),
        float(settings.widening_time),
        bool(settings.free_null_space),
        bool(settings.dynamically_consistent),
        bool(settings.keep_integral),
    )


def _same_torque(a: NullspaceSettings, b: NullspaceSettings) -> bool:
    """Return whether both give the same torque from the same memory."""
    names = (
        "lambda_",
        "mu",
        "free_null_space",
        "dynamically_consistent",
        "keep_integral",
        "threshold",
    )
    same = all(getattr(a, name) == getattr(b, name) for name in names)
    # The fast memory is empty where both rates are one.
    same = same and (a.theta_fast > a.theta_slow) == (b.theta_fast > b.theta_slow)
    return same and np.array_equal(a.budget, b.budget)
