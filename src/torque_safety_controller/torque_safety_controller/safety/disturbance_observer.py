# SPDX-License-Identifier: Apache-2.0
"""Disturbance observer: estimates acceleration errors and tightens the bounds by them.

The acceleration bounds are for the real accelerations, the controller chooses the commanded ones.
Friction, payloads, external forces and integral torque that is no longer needed make them differ.
The difference of the last step is known,

    e = (v - v_last) / dt - a_last,

and disturbances that last longer than a step act in the next one too. The bounds for the commanded
acceleration are therefore shifted by e, but only inward: for e > 0 the upper one, for e < 0 the
lower one; if they cross, the other one follows. Friction, which opposes the motion, does not widen
them.

With a filter of time constant T for the noise of the velocity, the error that remains is the
change of the disturbance within T: after a step by d the bound is exceeded by d exp(-t / T).
`docs/disturbances.md` measures it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


class DisturbanceObserver:
    """Filtered difference between measured and commanded accelerations.

    Args:
        n: number of joints.
        time_constant: of the filter, s, >= 0; None switches the observer off.

    Attributes:
        time_constant: may be changed between steps.
        estimate: e, filtered, shape (n,), rad/s^2; not to be changed.
    """

    def __init__(self, n: int, time_constant: float | None) -> None:
        self.time_constant = time_constant
        self._n = n
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.estimate = np.zeros(self._n)
        self.pause()

    def pause(self) -> None:
        """Keep the estimate, and learn nothing from the time until the next step."""
        self._v_last: Array | None = None

    def observe(self, v: Array, a_last: Array, elapsed: float, tau_max: Array, M: Array) -> None:
        """Update the estimate with the step that has just passed.

        Args:
            v: velocity now, shape (n,), rad/s.
            a_last: acceleration commanded for the step, shape (n,), rad/s^2.
            elapsed: duration of the step, s; 0 if it is not known: then nothing is learnt. What
                disturbed before is the best guess: the integral action goes on from its last
                torque, too, which is to balance it.
            tau_max: torque limits, shape (n,), N m. The estimate is limited to what the motors
                could compensate: more than that is an impact, which does not last.
            M: mass matrix, shape (n, n), kg m^2.
        """
        if self.time_constant is None:
            return
        if elapsed > 0.0 and self._v_last is not None:
            gain = -math.expm1(-elapsed / self.time_constant) if self.time_constant > 0.0 else 1.0
            self.estimate = _observe(
                self.estimate, v, self._v_last, a_last, elapsed, gain, tau_max, M
            )
        self._v_last = v.copy()

    def expect(self, torque: Array, tau_max: Array, M: Array) -> None:
        """Count a change of the additional torque before it can be seen.

        Args:
            torque: what the integral action adds in this step more than in the last one, shape
                (n,), N m; what is not finite does not count.
            tau_max: torque limits, shape (n,), N m.
            M: mass matrix, shape (n, n), kg m^2.
        """
        if self.time_constant is None or not torque.any():
            return
        try:
            change = np.linalg.solve(M, torque)
        except np.linalg.LinAlgError:
            return
        if np.isfinite(change).all():
            largest = tau_max / np.diagonal(M)
            self.estimate = np.clip(self.estimate + change, -largest, largest)

    @property
    def known(self) -> Array | None:
        """The estimate; None when switched off."""
        return None if self.time_constant is None else self.estimate

    def shift(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return the bounds of the commanded accelerations.

        Args:
            lower: bound of the real accelerations, shape (n,), rad/s^2.
            upper: shape (n,), rad/s^2, not below `lower`.
        """
        if self.time_constant is None:
            return lower, upper
        return _shift(self.estimate, lower, upper)


@njit(cache=True)
def _observe(
    old: Array,
    v: Array,
    v_last: Array,
    a_last: Array,
    elapsed: float,
    gain: float,
    tau_max: Array,
    M: Array,
) -> Array:
    """Return the estimate filtered with `gain`, within what motors can give."""
    estimate = old.copy()
    for j in range(v.size):
        e = (v[j] - v_last[j]) / elapsed - a_last[j]
        e = estimate[j] + gain * (e - estimate[j])
        largest = tau_max[j] / M[j, j]
        # A NaN resets the estimate.
        estimate[j] = min(max(e, -largest), largest) if e == e and largest > 0.0 else 0.0
    return estimate


@njit(cache=True)
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
