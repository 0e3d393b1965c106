# SPDX-License-Identifier: Apache-2.0
"""The box of robot states in which worst cases are searched.

Shared by `acceleration_limits` (Algorithm 4 of [DelPrete2018]) and `discretisation_margin`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]


class LimitEstimateError(ArmSafetyError, ValueError):
    """Limits cannot be estimated from what was given."""


@dataclass(frozen=True)
class StateSpace:
    """The box of states that limits allow, with the torque available in it.

    Attributes:
        q_min: lower positions, shape (n,), rad; finite.
        q_max: upper positions, shape (n,), rad; finite.
        v_max: velocity limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
    """

    q_min: Array
    q_max: Array
    v_max: Array
    tau_max: Array

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.q_min)

    @classmethod
    def of(
        cls,
        model: pin.Model,
        q_min: ArrayLike,
        q_max: ArrayLike,
        v_max: ArrayLike,
        tau_max: ArrayLike,
    ) -> StateSpace:
        """Return the checked box; a joint without position limits is given one turn, -pi to pi.

        Args:
            model: the robot, each joint with one degree of freedom, n of them.
            q_min: lower position limits, shape (n,), rad; infinite for continuous joints.
            q_max: upper position limits, shape (n,), rad.
            v_max: velocity limits, shape (n,), rad/s.
            tau_max: torque limits, shape (n,), N m.

        Raises:
            LimitEstimateError: a wrong shape, order or sign, or a value that is not finite; the
                message names the joint.
        """
        if model.nq != model.nv:
            raise LimitEstimateError("every joint of the model must have one coordinate")
        names = list(model.names)[1:]
        arrays = {}
        for key, value in (
            ("q_min", q_min),
            ("q_max", q_max),
            ("v_max", v_max),
            ("tau_max", tau_max),
        ):
            array = np.array(value, dtype=float)
            if array.shape != (model.nv,):
                raise LimitEstimateError(
                    f"{key} must have {model.nv} values, one a joint; its shape is {array.shape}"
                )
            arrays[key] = array
        for j, name in enumerate(names):
            low, high = arrays["q_min"][j], arrays["q_max"][j]
            if math.isinf(low) and math.isinf(high) and low < 0 < high:
                arrays["q_min"][j], arrays["q_max"][j] = -math.pi, math.pi
            elif not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise LimitEstimateError(
                    f"joint {name}: position limits must be finite and in order, or both "
                    f"infinite; they are {low:g} and {high:g} rad"
                )
            for key, unit in (("v_max", "rad/s"), ("tau_max", "N m")):
                if not (math.isfinite(arrays[key][j]) and arrays[key][j] > 0):
                    raise LimitEstimateError(
                        f"joint {name}: {key} must be positive and finite, "
                        f"is {arrays[key][j]:g} {unit}"
                    )
        return cls(**arrays)

    def states(self, unit: Array) -> tuple[Array, Array]:
        """Map points of the unit cube, shape (batch, 2 n), to positions and velocities.

        Returns:
            q and v, each of shape (batch, n).
        """
        q = self.q_min + unit[:, : self.n] * (self.q_max - self.q_min)
        np.minimum(q, self.q_max, out=q)  # 1.0 must not end up a rounding error outside
        v = (2.0 * unit[:, self.n :] - 1.0) * self.v_max
        return q, v
