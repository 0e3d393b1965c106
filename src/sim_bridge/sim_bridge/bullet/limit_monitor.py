"""The judge of a run: how close each joint came to its limits, and by how much it broke them.

It only looks: nothing it finds feeds back into the robot. It is fed at every physics step, so
that nothing hides between two control steps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


class LimitMonitor:
    """Extremes of position, velocity and torque of n joints, against their limits.

    An update keeps the extremes and no more, which makes it cheap; all that is reported is
    derived from them when asked. A value that is not a number counts as a violation.

    Args:
        q_min: lower position limits, shape (n,), rad; may be -inf.
        q_max: upper position limits, shape (n,), rad; may be inf.
        v_max: velocity limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
        position_tolerance: how far, in rad, a position may be over before
            `first_violation_step` takes note; what is reported is always the whole violation.
        velocity_tolerance: the same for velocities, rad/s.
        torque_tolerance: the same for torques, N m.

    Raises:
        ValueError: shapes differ, an interval is empty or a limit not positive.
    """

    def __init__(
        self,
        q_min: ArrayLike,
        q_max: ArrayLike,
        v_max: ArrayLike,
        tau_max: ArrayLike,
        *,
        position_tolerance: float = 0.0,
        velocity_tolerance: float = 0.0,
        torque_tolerance: float = 0.0,
    ) -> None:
        limits = [np.array(x, dtype=float) for x in (q_min, q_max, v_max, tau_max)]
        if limits[0].ndim != 1 or any(x.shape != limits[0].shape for x in limits):
            shapes = ", ".join(str(x.shape) for x in limits)
            raise ValueError(f"limits must all have one shape (n,), not {shapes}")
        self._q_min, self._q_max, self._v_max, self._tau_max = limits
        if not np.all(self._q_min < self._q_max):
            raise ValueError(f"q_min must be below q_max: {self._q_min} and {self._q_max}")
        if not (np.all(self._v_max > 0.0) and np.all(self._tau_max > 0.0)):
            raise ValueError("v_max and tau_max must be positive")
        # Row by row q, v, tau, and the same negated: every limit is then an upper one, and one
        # maximum and one comparison serve all six.
        n = self._q_min.size
        self._sample = np.empty((2, 3, n))
        self._peak = np.empty((2, 3, n))
        self._over = np.empty((2, 3, n), dtype=bool)
        q, v, tau = position_tolerance, velocity_tolerance, torque_tolerance
        self._bound = np.array(
            [
                [self._q_max + q, self._v_max + v, self._tau_max + tau],
                [q - self._q_min, self._v_max + v, self._tau_max + tau],
            ]
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything seen so far."""
        self._peak.fill(-np.inf)
        self._steps = 0
        self._first: int | None = None

    def update(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
        """Take one physics step into account.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            tau: torques of the motors, shape (n,), N m.
        """
        sample = self._sample
        values = sample[0]
        values[0] = q
        values[1] = v
        values[2] = tau
        np.negative(values, out=sample[1])
        np.maximum(self._peak, sample, out=self._peak)  # a NaN stays
        if self._first is None:
            np.less_equal(self._peak, self._bound, out=self._over)
            if not self._over.all():
                self._first = self._steps
        self._steps += 1

    @property
    def steps(self) -> int:
        """Number of updates since the last reset."""
        return self._steps

    @property
    def first_violation_step(self) -> int | None:
        """Index, from 0, of the update that first went over a limit plus its tolerance."""
        return self._first

    @property
    def closest_to_q_min(self) -> np.ndarray:
        """Least distance kept from the lower limits, shape (n,), rad; negative when broken."""
        return -self._peak[1, 0] - self._q_min

    @property
    def closest_to_q_max(self) -> np.ndarray:
        """Least distance kept from the upper limits, shape (n,), rad; negative when broken."""
        return self._q_max - self._peak[0, 0]

    @property
    def max_position_violation(self) -> np.ndarray:
        """Farthest beyond either position limit, shape (n,), rad; 0 where never broken."""
        return np.maximum(-np.minimum(self.closest_to_q_min, self.closest_to_q_max), 0.0)

    @property
    def max_velocity_violation(self) -> np.ndarray:
        """Greatest excess of speed, shape (n,), rad/s; 0 where never broken."""
        return np.maximum(self._peak[:, 1].max(axis=0) - self._v_max, 0.0)

    @property
    def max_torque_ratio(self) -> np.ndarray:
        """Greatest absolute torque over its limit, shape (n,); above 1 where broken."""
        return np.maximum(self._peak[:, 2].max(axis=0), 0.0) / self._tau_max
