# SPDX-License-Identifier: Apache-2.0
"""Acceleration bounds from the torque that is available now, safe along the braking path.

The limits a_min and a_max of [DelPrete2018] are what the motors can do in the worst state; the
paper calls them conservative and leaves the rest to future work. They play two parts. As *input
limits* they are not needed: any acceleration that leads into a viable state is safe, and the
controller keeps its torque limits anyway. As the *braking* that the viability kernel counts on
they can be exceeded. Both are done as long as a braking path is known on which torque suffices,
from every state to which the step may lead; see `certificate`. Where none can be shown,
the bounds are those of the worst case. `docs/state_dependent_limits.md` has the derivation.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError, joint_array
from viability_bounds_pkg.kernel.bounds_kernel import AccelerationBounds, solve
from viability_bounds_pkg.kernel.one_sided_limit import set_braking
from viability_bounds_pkg.state_dependent.certificate import BrakingCertificate, Reach
from viability_bounds_pkg.state_dependent.reach import (
    available,
    most_braking,
    needed_braking,
    reach_of_step,
)
from viability_bounds_pkg.viability import BoundsSolver

Array = NDArray[np.float64]

TORQUE_RESERVE = 0.03
"""Share of the torque limits kept back for what a certificate of first order leaves out."""

_SHARE_STEP = 0.05
"""By how much more of the braking available now is tried than was shown to be safe last time."""


class StateDependentBounds:
    """Acceleration bounds of one arm with limits that depend on its state.

    It remembers the braking path of the last step, so that it belongs to one control loop.

    Args:
        model: the arm, n joints with one coordinate each, in the order of `limits`.
        limits: position and velocity limits, and the acceleration limits of the worst case.
        tau_max: torque limits, shape (n,), N m.
        peak: acceleration that is never exceeded either way, shape (n,), rad/s^2.
        dt: as for `viability.BoundsSolver`, s.
        margin: as for `viability.BoundsSolver`.
        period: control period, s, at most `dt`; None means `dt`.
        tolerance: how far outside the kernel the margins allow a joint to be, shape (n,) or a
            number, rad; nearer than this to the kernel of the worst case counts as inside.

    Attributes:
        outcomes: how many steps were answered with bounds of each kind: "certified", "worst
            case", "braking", when only the braking path of the last step is safe, and "outside".

    Raises:
        JointLimitsError: an argument is unusable.
    """

    def __init__(
        self,
        model: pin.Model,
        limits: JointLimits,
        tau_max: ArrayLike,
        peak: ArrayLike,
        dt: float,
        margin: ArrayLike | None = None,
        period: float | None = None,
        tolerance: ArrayLike = 0.0,
    ):
        n = len(limits)
        self._limits = limits
        self._tau_max = joint_array("tau_max", tau_max, limits.names)
        self._peak = _checked_peak(peak, limits)
        worst = BoundsSolver(limits, dt, margin, period)
        self._model, self._data = model, model.createData()
        self._margin = np.zeros(n) if margin is None else np.array(margin, dtype=float)
        self._tolerance = np.full(n, tolerance, dtype=float)
        self._dt, self._period = worst.dt, worst.dt if period is None else float(period)
        self._table = worst.table
        self._least = 0.5 * worst.table.limits["twice_braking"]  # braking of the worst case
        curved = worst.table.limits["points"] > 0
        self._most = most_braking(limits, self._peak, self._margin, self._least, curved, self._dt)
        self._certificate = BrakingCertificate(model, (1.0 - TORQUE_RESERVE) * self._tau_max)
        self._path: Array | None = None
        self._share = 1.0
        self.outcomes: Counter[str] = Counter()
        self._warm_up()

    def reset(self) -> None:
        """Forget the braking path of the last step: the robot was moved, or time has passed."""
        self._path, self._share = None, 1.0

    def bounds(self, q: ArrayLike, v: ArrayLike) -> AccelerationBounds:
        """Return the acceleration bounds for the next control step.

        Where they were shown to be safe, or follow a path that was, every acceleration in them
        that the torque limits allow leads to a state from which position and velocity limits can
        still be kept within the torque limits. Otherwise they are those of the worst case.

        Args:
            q: shape (n,), rad.
            v: shape (n,), rad/s.
        """
        q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
        limits = self._limits
        low, high, braking = available(
            pin.crba(self._model, self._data, q),
            pin.nonLinearEffects(self._model, self._data, q, v),
            self._tau_max,
            limits.a_min,
            limits.a_max,
            self._peak,
        )
        needed = needed_braking(q, v, self._table.limits, self._least, self._tolerance)
        urgent = bool((needed > self._least).any())
        if urgent and (needed > self._most).any():
            return self._worst_case(q, v, low, high)
        braking = np.minimum(braking - self._margin[:, None], self._most)
        worst = limits.a_min, limits.a_max
        wide = low, high
        known = self._share
        for share, inputs in (
            (min(known + _SHARE_STEP, 1.0), wide),
            (known, wide),
            (0.5 * known, wide),
            (0.0, wide),
            (0.0, worst),
        ):
            used = np.maximum(needed, share * braking)
            bounds = self._solve(q, v, used, *inputs)
            reach = self._reach(q, v, bounds, used)
            if self._certificate.holds(reach):
                self._path, self._share = reach.braking, share
                return self._counted("certified", bounds)
        self._share = 0.0
        if self._path is None or not urgent:
            return self._worst_case(q, v, *worst)
        # The acceleration along the known braking path, stopping within the step at most.
        rate = -np.sign(v) * np.minimum(self._path, np.abs(v) / self._period)
        a = np.clip(rate, bounds.lower, bounds.upper)
        return self._counted("braking", AccelerationBounds(a, a.copy(), bounds.viable))

    def _worst_case(self, q: Array, v: Array, low: Array, high: Array) -> AccelerationBounds:
        self._path = None
        bounds = self._solve(q, v, self._least, low, high)
        return self._counted("worst case" if bounds.viable.all() else "outside", bounds)

    def _solve(
        self, q: Array, v: Array, braking: Array, low: Array, high: Array
    ) -> AccelerationBounds:
        """Return the bounds with other braking, shape (n, 2), and input limits, shape (n,)."""
        away, towards = np.stack([low, -high], axis=1), np.stack([high, -low], axis=1)
        set_braking(self._table.limits, braking, away, towards)
        return solve(q, v, self._table)

    def _reach(self, q: Array, v: Array, bounds: AccelerationBounds, braking: Array) -> Reach:
        lower, upper = bounds.lower, bounds.upper
        return Reach(*reach_of_step(q, v, lower, upper, self._period, self._margin, braking))

    def _counted(self, outcome: str, bounds: AccelerationBounds) -> AccelerationBounds:
        self.outcomes[outcome] += 1
        return bounds

    def _warm_up(self) -> None:
        """Compile everything now and not in a control loop."""
        rest = np.zeros(len(self._limits))
        bounds = self.bounds(rest, rest)
        self._certificate.holds(self._reach(rest, rest, bounds, self._least))
        self._worst_case(rest, rest, self._limits.a_min, self._limits.a_max)
        self.reset()
        self.outcomes.clear()


def _checked_peak(peak: ArrayLike, limits: JointLimits) -> Array:
    """Return `peak` as an array, or raise `JointLimitsError`."""
    array = joint_array("peak", peak, limits.names)
    worst = np.maximum(-limits.a_min, limits.a_max)
    for name, most, least in zip(limits.names, array.tolist(), worst.tolist(), strict=True):
        if not (np.isfinite(most) and most >= least):
            allowed = f"must be finite and at least that of the worst case, {least:g}"
            raise JointLimitsError("peak", name, most, allowed)
    return array
