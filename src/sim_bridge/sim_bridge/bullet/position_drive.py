# SPDX-License-Identifier: Apache-2.0
"""Position control by the drive of each joint: a cascade of position and velocity loops.

    v_ref = v_des + kappa (q_des - q), at most the speed limit,
    tau   = k (v_ref - v) + z,    z' = (k / T) (v_ref - v),
    k     = max(omega_v diag(M), tau_max / (kappa e_full)),

a proportional loop for position around a proportional-integral one for velocity, fast enough for
the inertia and stiff enough for the friction, which grows with tau_max. The torque is clipped to
the motor's limit, and z does not wind up meanwhile. Within a small window around the goal z is
held, as in real drives; otherwise stiction would cause a limit cycle.

Real drives close their loops ten times faster than a physics step. Stiff loops sampled at the
physics rate are unstable when the joints' inertias are coupled; this one therefore uses the state
predicted for the end of the step ([Tan2011]), v + h a and q + h v + h^2 a / 2. With the error e,

    e = v_des + kappa (q_des - q - h v) - v,    tau = k e + z - P a,    P = h k (1 + kappa h / 2),

as long as the speed limit is not active (then P = h k), and with M a + b = tau, b the bias forces,

    (M + P) a = k e + z - b.

The transfer to the drive is bumpless: z is initialised so that, with zero error, tau is the torque
applied before, z = tau + P a with M a = tau - b.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.robot.description import build_model

Array = NDArray[np.float64]

POSITION_GAIN = 30.0
"""kappa, 1/s."""

VELOCITY_BANDWIDTH = 200.0
"""omega_v, 1/s."""

INTEGRAL_TIME = 4.0 / VELOCITY_BANDWIDTH
"""T, s: both poles of the velocity loop at omega_v / 2."""

FULL_TORQUE_ERROR = 0.01
"""e_full, at which the drive reaches its torque limit, rad."""

WINDOW = 2e-4
"""Distance from a goal at rest within which the integral is held, rad."""


class PositionDrive:
    """The drives of n joints; all arrays are of shape (n,).

    A model of the robot with its rotors gives the gains, and the prediction that replaces the
    faster loops of a real drive.

    Args:
        urdf: the robot.
        joints: base to tip.
        locked_positions: where other joints are locked, rad or m.
        rotor_inertia: of the joints, shape (n,), kg m^2.
        dt: time between two calls of `torque`, s.

    Raises:
        RobotDescriptionError: as `build_model` does.
    """

    def __init__(
        self,
        urdf: str,
        joints: Sequence[str],
        locked_positions: Mapping[str, float],
        rotor_inertia: Array,
        dt: float,
    ) -> None:
        self._model = build_model(urdf, joints, locked_positions, rotor_inertia)
        self._data, self._dt = self._model.createData(), dt
        self._z = np.zeros(len(joints))

    def reset(self, q: Array, v: Array, tau_max: Array, tau: Array | None) -> None:
        """Initialise the integral for a bumpless transfer.

        Args:
            q: position, rad.
            v: velocity, rad/s.
            tau_max: torque limits, N m.
            tau: the torque of the motors until now, N m; None for the bias forces.
        """
        M, bias, k = self._dynamics(q, v, tau_max)
        tau = bias if tau is None else tau
        P = self._dt * k * (1.0 + 0.5 * POSITION_GAIN * self._dt)
        self._z = tau + P * np.linalg.solve(M, tau - bias)

    def torque(
        self, q: Array, v: Array, q_des: Array, v_des: Array, v_max: Array, tau_max: Array
    ) -> Array:
        """Return the torque of the motors for one physics step, N m.

        Args:
            q: position, rad.
            v: velocity, rad/s.
            q_des: position at the end of the step, rad.
            v_des: velocity there, rad/s.
            v_max: limit of the reference velocity, rad/s.
            tau_max: torque limits, N m.
        """
        h = self._dt
        M, bias, k = self._dynamics(q, v, tau_max)
        wanted = v_des + POSITION_GAIN * (q_des - q - h * v)
        v_ref = np.clip(wanted, -v_max, v_max)
        P = h * k * np.where(v_ref == wanted, 1.0 + 0.5 * POSITION_GAIN * h, 1.0)
        error = v_ref - v
        u = k * error + self._z
        tau = u - P * np.linalg.solve(M + np.diag(P), u - bias)
        clipped = np.clip(tau, -tau_max, tau_max)
        arrived = (np.abs(q_des - q) < WINDOW) & (v_des == 0.0)
        winding_up = (tau - clipped) * error > 0.0
        self._z += np.where(arrived | winding_up, 0.0, (h / INTEGRAL_TIME) * k * error)
        return clipped

    def _dynamics(self, q: Array, v: Array, tau_max: Array) -> tuple[Array, Array, Array]:
        """Return M, the bias forces b and the velocity gains k."""
        M = pin.crba(self._model, self._data, q)
        bias = pin.nonLinearEffects(self._model, self._data, q, v)
        stiff = tau_max / (POSITION_GAIN * FULL_TORQUE_ERROR)
        return M, bias, np.maximum(VELOCITY_BANDWIDTH * M.diagonal(), stiff)
