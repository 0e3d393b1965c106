# SPDX-License-Identifier: Apache-2.0
"""Records how close each joint came to its limits, and by how much it violated them.

Nothing that it finds affects the robot. It is updated at every physics step, so that violations
between two control steps are seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import speed_limits
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration

Array = NDArray[np.float64]

_TORQUE_ROUNDING = 1e-9
"""Share of a torque limit: motor torques are clipped at exactly the limits, but may be sums."""


class LimitMonitor:
    """Extremes of position, velocity and torque of n joints, against their limits.

    An update only keeps the extremes; all that is reported is derived from them on request. A
    value that is not a number counts as a violation.

    Args:
        q_min: lower position limits, shape (n,), rad; may be -inf.
        q_max: upper position limits, shape (n,), rad; may be inf.
        v_max: velocity limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
        velocity_offset: of speed limits that depend on position, as `JointLimits` has them, shape
            (n,), rad/s; zeros if not given.
        deceleration_limit: of the same, shape (n,), rad/s^2; none if not given.
    """

    def __init__(
        self,
        q_min: ArrayLike,
        q_max: ArrayLike,
        v_max: ArrayLike,
        tau_max: ArrayLike,
        velocity_offset: ArrayLike = 0.0,
        deceleration_limit: ArrayLike = np.inf,
    ) -> None:
        self._q_min, self._q_max, self._v_max, self._tau_max = np.array(
            (q_min, q_max, v_max, tau_max), dtype=float
        )
        self._curve = np.array(velocity_offset), np.array(deceleration_limit)
        self._depends_on_q = bool(np.isfinite(self._curve[1]).any())
        self._too_fast: Array = np.empty_like(self._v_max)
        # q, v, tau, and the same negated: one maximum serves the limits on both sides.
        self._sample = np.empty((2, 3, self._q_min.size))
        self._peak: Array = np.empty_like(self._sample)
        self.reset()

    @classmethod
    def of(cls, robot: LimitedRobotConfiguration) -> LimitMonitor:
        """Return the monitor of a robot's limits."""
        return cls(
            robot.position_min,
            robot.position_max,
            robot.velocity_max,
            robot.torque_max,
            robot.velocity_offset,
            robot.deceleration_limit,
        )

    def reset(self) -> None:
        """Forget all updates."""
        self._peak.fill(-np.inf)
        self._too_fast.fill(-np.inf)

    def update(self, q: Array, v: Array, tau: Array, lead: float = 0.0) -> None:
        """Take one physics step into account.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            tau: torques of the motors, shape (n,), N m.
            lead: time by which the positions are ahead of the velocities, s.
        """
        sample = self._sample
        values = sample[0]
        values[0] = q
        values[1] = v
        values[2] = tau
        np.negative(values, out=sample[1])
        np.maximum(self._peak, sample, out=self._peak)  # a NaN stays
        if self._depends_on_q:
            at = q - lead * v
            room = np.where(v > 0.0, self._q_max - at, at - self._q_min)
            excess = np.abs(v) - speed_limits(room, self._v_max, *self._curve)
            np.maximum(self._too_fast, excess, out=self._too_fast)

    @property
    def violated(self) -> bool:
        """Whether any limit was violated; a torque by more than rounding."""
        within = (
            (self.max_position_violation <= 0.0)
            & (self.max_velocity_violation <= 0.0)
            & (self.max_torque_ratio <= 1.0 + _TORQUE_ROUNDING)
        )
        return not bool(within.all())

    @property
    def closest_to_q_min(self) -> Array:
        """Least distance kept from the lower limits, shape (n,), rad; negative when violated."""
        distance: Array = -self._peak[1, 0] - self._q_min
        return distance

    @property
    def closest_to_q_max(self) -> Array:
        """Least distance kept from the upper limits, shape (n,), rad; negative when violated."""
        distance: Array = self._q_max - self._peak[0, 0]
        return distance

    @property
    def max_position_violation(self) -> Array:
        """Farthest beyond either position limit, shape (n,), rad; 0 where never violated."""
        return np.maximum(-np.minimum(self.closest_to_q_min, self.closest_to_q_max), 0.0)

    @property
    def max_speed(self) -> Array:
        """Greatest speed, shape (n,), rad/s."""
        speed: Array = self._peak[:, 1].max(axis=0)
        return speed

    @property
    def max_velocity_violation(self) -> Array:
        """Greatest excess of speed, shape (n,), rad/s; 0 where never violated."""
        excess: Array = np.maximum(np.maximum(self.max_speed - self._v_max, self._too_fast), 0.0)
        return excess

    @property
    def max_torque_ratio(self) -> Array:
        """Greatest absolute torque over its limit, shape (n,); above 1 where violated."""
        ratio: Array = np.maximum(self._peak[:, 2].max(axis=0), 0.0) / self._tau_max
        return ratio
