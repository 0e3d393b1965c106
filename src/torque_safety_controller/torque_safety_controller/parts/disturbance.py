# SPDX-License-Identifier: Apache-2.0
"""Disturbances: by how much the real accelerations differ from the commanded ones.

The acceleration bounds are for the real accelerations, the controller chooses the commanded ones.
Friction, payloads, external forces and integral torque that is no longer needed make them differ.
The difference of the last step is known,

    e = (v - v_last) / dt - a_last,

and disturbances that last longer than a step act in the next one too. The bounds for the commanded
acceleration are therefore shifted by e, but only inward, see `Step.commanded`: friction, which
opposes the motion, does not widen them.

With a filter of time constant T for the noise of the velocity, the error that remains is the
change of the disturbance within T: after a step by d the bound is exceeded by d exp(-t / T).
`docs/theory/bounds.md` measures it.
"""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Step

Array = NDArray[np.float64]


class Disturbance(Part):
    """Tells later parts and the QP what disturbs the arm.

    Args:
        n: number of joints.
        time_constant: of the filter, s, >= 0.

    Attributes:
        estimate: e, filtered, shape (n,), rad/s^2; not to be changed.
    """

    def __init__(self, n: int, time_constant: float) -> None:
        self._time_constant, self._zero = time_constant, np.zeros(n)
        self.reset()

    def reset(self, robot: RobotModel | None = None) -> None:
        """See `Part.reset`."""
        self.estimate = np.zeros_like(self._zero)
        self._v_last: Array | None = None

    def prepare(self, step: Step) -> None:
        """Estimate the disturbance by the step that has passed, and by what this one adds."""
        robot = step.robot
        if step.order.forget_disturbance:
            self.reset()
        known = step.elapsed if step.learns else 0.0
        self.observe(robot.v, step.a_last, known, step.tau_max, robot.M)
        self.expect(step.integral_change, step.tau_max, robot.M)
        step.disturbance = self.estimate

    def learn(self, step: Step) -> None:
        """Learn nothing from braking without a solution: motors may not give what it asks for."""
        if step.failure:
            self._v_last = None

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
        if elapsed > 0.0 and self._v_last is not None:
            time = self._time_constant
            gain = -math.expm1(-elapsed / time) if time > 0.0 else 1.0
            change = (v - self._v_last) / elapsed - a_last
            self.estimate = _updated(self.estimate, change, gain, tau_max, M)
        self._v_last = v.copy()

    def expect(self, torque: Array, tau_max: Array, M: Array) -> None:
        """Count a change of the additional torque before it can be seen.

        Args:
            torque: what the integral action adds in this step more than in the last one, shape
                (n,), N m; what is not finite does not count.
            tau_max: torque limits, shape (n,), N m.
            M: mass matrix, shape (n, n), kg m^2.
        """
        if torque.any() and math.isfinite(torque.dot(torque)):
            with suppress(ValueError):  # of NumPy's, where M is no mass matrix
                expected = self.estimate + np.linalg.solve(M, torque)
                self.estimate = _updated(expected, self._zero, 0.0, tau_max, M)


@njit(cache=True)
def _updated(old: Array, observed: Array, gain: float, tau_max: Array, M: Array) -> Array:
    """Return the estimate with what was observed, within motors' limits.

    Args:
        old: estimate, shape (n,), rad/s^2.
        observed: difference of accelerations, shape (n,), rad/s^2; a NaN resets the estimate.
        gain: share of it that the filter takes; 0 for nothing observed.
        tau_max: torque limits, shape (n,), N m.
        M: mass matrix, shape (n, n), kg m^2.
    """
    estimate = np.empty_like(old)
    for j in range(old.size):
        e, most = old[j] + gain * (observed[j] - old[j]), tau_max[j] / M[j, j]
        estimate[j] = min(max(e, -most), most) if e == e and most > 0.0 else 0.0
    return estimate
