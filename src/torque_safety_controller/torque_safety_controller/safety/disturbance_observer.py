# SPDX-License-Identifier: Apache-2.0
"""What disturbs the joints' accelerations, seen one step later and kept out of the bounds.

The acceleration bounds hold for the accelerations that the arm has; the controller chooses those
that it asks for. What it does not know of lies between: friction, payloads, pushes, and integral
torque that is no longer needed. Of the step that has just passed the difference is known,

    e = (v - v_last) / dt - a_last,

and what lasts longer than a step acts in the next one too. So the bounds for what is asked are
shifted by e, but only ever inward: for e > 0 the upper one, for e < 0 the lower one, with the
other giving way if they cross. Friction, which opposes the motion, does not widen them.

With a filter of time constant T for the noise of the velocity, what is left is the change of the
disturbance within T: a step of it by d passes the bound by d exp(-t / T). `docs/disturbances.md`
measures it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


class DisturbanceObserver:
    """Watches the difference between accelerations asked for and had.

    Args:
        n: number of joints.
        time_constant: of the filter, s, >= 0; None to watch nothing.

    Attributes:
        time_constant: may be changed between steps.
        estimate: e, filtered, shape (n,), rad/s^2.
    """

    def __init__(self, n: int, time_constant: float | None) -> None:
        self.time_constant = time_constant
        self.estimate = np.zeros(n)
        self._v_last = np.zeros(n)
        self._begun = False
        ones = np.ones(n)  # compiled now, not in a control loop
        _observe(np.zeros(n), ones, ones, ones, 1.0, 1.0, ones, np.eye(n))
        _shift(ones, -ones, ones)

    def reset(self) -> None:
        """Forget the past."""
        self.estimate.fill(0.0)
        self._begun = False

    def observe(self, v: Array, a_last: Array, elapsed: float, tau_max: Array, M: Array) -> None:
        """Learn from the step that has just passed.

        Args:
            v: velocity now, shape (n,), rad/s.
            a_last: acceleration asked for in the step, shape (n,), rad/s^2.
            elapsed: duration of the step, s; 0 if it is not known, which starts anew.
            tau_max: torque limits, shape (n,), N m. More than a motor could counter is no force
                that lasts but an impact.
            M: mass matrix, shape (n, n), kg m^2.
        """
        if self.time_constant is None:
            return
        if not elapsed > 0.0:
            self.reset()
        elif self._begun:
            gain = -math.expm1(-elapsed / self.time_constant) if self.time_constant > 0.0 else 1.0
            _observe(self.estimate, v, self._v_last, a_last, elapsed, gain, tau_max, M)
        self._v_last[:] = v
        self._begun = True

    @property
    def known(self) -> Array | None:
        """The estimate; None while nothing is watched, or has been yet."""
        return None if self.time_constant is None or not self._begun else self.estimate

    def shift(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return bounds for the accelerations to ask for.

        Args:
            lower: bound of the accelerations to have, shape (n,), rad/s^2.
            upper: shape (n,), rad/s^2, not below `lower`.
        """
        known = self.known
        return (lower, upper) if known is None else _shift(known, lower, upper)


@compiled
def _observe(
    estimate: Array,
    v: Array,
    v_last: Array,
    a_last: Array,
    elapsed: float,
    gain: float,
    tau_max: Array,
    M: Array,
) -> None:
    """Let the estimate follow the error of the last step, at a rate `gain`; in place."""
    for j in range(v.size):
        e = (v[j] - v_last[j]) / elapsed - a_last[j]
        e = estimate[j] + gain * (e - estimate[j])
        largest = tau_max[j] / M[j, j]
        # A NaN is nothing to go by.
        estimate[j] = min(max(e, -largest), largest) if e == e and largest > 0.0 else 0.0


@compiled
def _shift(estimate: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the bounds tightened by the estimate: the upper one, or the lower one."""
    low, high = lower.copy(), upper.copy()
    for j in range(low.size):
        e = estimate[j]
        if e > 0.0:
            high[j] -= e
            low[j] = min(low[j], high[j])
        else:
            low[j] -= e
            high[j] = max(low[j], high[j])
    return low, high
