"""The admittance task: the hand moves until it feels the wrench that it should.

[Benallegue2021], III-E (b), in the end effector's axes, with F what the environment does to the
arm:

    g_ob = -Kp (F_ref - F) - Kv (F_ref' - F').                                         (27)
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from torque_safety_controller.tasks import TaskTerm


@dataclass(frozen=True)
class AdmittanceGains:
    """Gains of (27); the defaults are those of Table I.

    Attributes:
        force_kp: m/s^2 per N.
        force_kd: m/s^2 per N/s.
        moment_kp: rad/s^2 per N m.
        moment_kd: rad/s^2 per N m/s.
    """

    force_kp: float = 5e-3
    force_kd: float = 1e-7
    moment_kp: float = 5e-3
    moment_kd: float = 1e-7

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the diagonals of Kp and Kv, shape (6,) each."""
        force_kp, force_kd, moment_kp, moment_kd = (getattr(self, f.name) for f in fields(self))
        return (
            np.array([force_kp] * 3 + [moment_kp] * 3),
            np.array([force_kd] * 3 + [moment_kd] * 3),
        )


def admittance_task(
    J: np.ndarray,
    drift: np.ndarray,
    error: np.ndarray,
    error_rate: np.ndarray,
    gains: AdmittanceGains,
    weight: float,
    rows: np.ndarray | None = None,
) -> TaskTerm:
    """Return (27) as a task on the accelerations.

    It shares the Jacobian of the pose task. With the weight of that, each is served by half, as
    in the paper: along a direction of both the hand accelerates by their mean.

    Args:
        J: Jacobian of the end effector in its own axes, shape (6, n).
        drift: its acceleration at zero joint acceleration, shape (6,).
        error: F_ref - F, shape (6,), N and N m.
        error_rate: its time derivative, shape (6,).
        gains: Kp and Kv.
        weight: of the squared error of acceleration.
        rows: directions in which it acts, shape (m,), indices; None for all.
    """
    kp, kd = gains.rows()
    b = -kp * error - kd * error_rate - drift
    if rows is None:
        return TaskTerm(J, b, weight)
    return TaskTerm(np.ascontiguousarray(J[rows]), b[rows], weight)
