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
            error = (v - self._v_last) / elapsed - a_last
            self._set(self.estimate + gain * (error - self.estimate), tau_max, M)
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
            self._set(self.estimate + change, tau_max, M)

    def _set(self, estimate: Array, tau_max: Array, M: Array) -> None:
        """Set the estimate, within what motors can give; joints with a NaN begin anew."""
        largest = tau_max / np.diagonal(M)
        usable = (estimate == estimate) & (largest > 0.0)
        self.estimate = np.where(usable, np.clip(estimate, -largest, largest), 0.0)

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
        pushed_up = self.estimate > 0.0
        low, high = lower - np.minimum(self.estimate, 0.0), upper - np.maximum(self.estimate, 0.0)
        return (
            np.where(pushed_up, np.minimum(low, high), low),
            np.where(pushed_up, high, np.maximum(low, high)),
        )
