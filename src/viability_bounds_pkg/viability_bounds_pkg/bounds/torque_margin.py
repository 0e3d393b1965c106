# SPDX-License-Identifier: Apache-2.0
"""Margins on joint limits for the zero-order hold error of a torque command.

The bounds assume constant acceleration within a step; a robot under a constant torque has
only nearly that. `docs/theory/bounds.md` derives the margins below and shows that they keep
the limits.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimits


class TorqueMargins(NamedTuple):
    """Margins that the bounds keep to the limits, each of shape (n,).

    Attributes:
        acceleration: off the braking and the bounds, rad/s^2.
        velocity: off the speed limits, rad/s.
        position: off the position limits, rad.
    """

    acceleration: NDArray[np.float64]
    velocity: NDArray[np.float64]
    position: NDArray[np.float64]

    def held(self, periods: int) -> TorqueMargins:
        """Return the margins where a torque is held for up to so many periods.

        The controller lets the mean acceleration over all of them obey the bounds, too. What is
        left of its error is at most as many times that of one period: J T / 36.
        """
        return self._replace(acceleration=0.5 * (1 + periods) * self.acceleration)

    @property
    def with_jerk(self) -> NDArray[np.float64]:
        """Margin of the acceleration where the jerk is limited, 7 J dt / 36, shape (n,), rad/s^2.

        J dt / 36 is for the mean. With J dt / 6 more, a step is as far on when it ends as one
        that is off by D: dt^2 / 2 times that is D.
        """
        return 3.5 * self.acceleration


def torque_margins(jerk: ArrayLike, dt: float) -> TorqueMargins:
    """Return the margins that make up for the change of acceleration within a step.

    The torque is right for the middle of the step, so that with jerk J the acceleration is
    off by J (t - dt/2): the velocity by at most J dt^2 / 8, the position by D = J dt^3 / 12.
    One half of the acceleration margin, J dt / 36, covers what is left of the error of the mean
    acceleration, which is of second order in dt; the other half is a reserve of braking that
    makes up for the position error D of each step as long as the joint is faster than the last
    three steps of braking. In these the error adds up to at most 5 D.

    Args:
        jerk: greatest rate of change of acceleration under held torque, shape (n,), rad/s^3.
        dt: control period, s.
    """
    J = np.asarray(jerk, dtype=float)
    return TorqueMargins(J * dt / 18.0, J * dt**2 / 8.0, 5.0 * (J * dt**3 / 12.0))


def tightened(limits: JointLimits, margins: TorqueMargins) -> JointLimits:
    """Return the limits with the margins of position and velocity taken off.

    The margin of acceleration is `viability.BoundsSolver`'s to take.
    """
    return replace(
        limits,
        q_min=limits.q_min + margins.position,
        q_max=limits.q_max - margins.position,
        v_max=limits.v_max - margins.velocity,
        velocity_offset=np.where(
            np.isfinite(limits.deceleration_limit), limits.velocity_offset + margins.velocity, 0.0
        ),
    )
