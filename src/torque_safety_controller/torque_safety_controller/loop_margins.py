# SPDX-License-Identifier: Apache-2.0
"""The loop of one joint in discrete time: motor, delay, state estimation, gains.

    command -> delay -> motor lag -> joint -> estimation, prediction -> gains -> command

All of it is linear, and sampled once a control period. Each quantity is a row vector, what it is
made of: of the state of the loop and of the command that enters at the motor. One step of the
loop, written with such rows, gives its matrices. `docs/guides/tuning.md` derives it.

`ArmInertia` has what couples the loops of several joints.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors

Array = NDArray[np.float64]

_FREQUENCIES = 200
_SLOWEST = 1e-4  # of the Nyquist frequency
_ROUNDING = 1e-6  # of a pole: kp = 0 leaves one at 1
_POSTURES, _SEED = 200, 0  # of an arm


class Link(NamedTuple):
    """What lies between a command and the state that the controller knows.

    Attributes:
        dt: control period, s.
        delay: whole periods from the state that a command answers to its effect.
        lag: of the motor's torque, first order, s.
        observer: shares of an error of the position that correct position and velocity, 1 and
            1/s; None for a velocity that is measured.
        predicted: periods by which the state is predicted, and the motor lag with it; None for
            no prediction.
    """

    dt: float
    delay: int = 0
    lag: float = 0.0
    observer: tuple[float, float] | None = None
    predicted: int | None = None


class Feedback(NamedTuple):
    """Gains of a joint, on its acceleration.

    Attributes:
        kp: on the position, 1/s^2.
        kd: on the velocity, 1/s.
        integral: lambda of the integral action, times what the inertia makes of it, 1/s.
        leak: its rates theta_s and theta_f, 1/s, and the share mu of the fast one.
        disturbance_time: time constant of the disturbance observer whose estimate is taken off,
            s; 0 for none.
    """

    kp: float
    kd: float
    integral: float = 0.0
    leak: tuple[float, float, float] = (0.1, 100.0, 0.5)
    disturbance_time: float = 0.0


class OpenLoop(NamedTuple):
    """The loop, opened at the motor: x' = A x + b entering, returning = c x."""

    A: Array
    """Shape (n, n)."""
    b: Array
    """Shape (n,)."""
    c: Array
    """Shape (n,)."""

    def spectral_radius(self) -> float:
        """Return the largest magnitude of the closed loop's poles."""
        closed = self.A + np.outer(self.b, self.c)
        return float(np.abs(np.linalg.eigvals(closed)).max())

    def modulus_margin(self) -> float:
        """Return the least distance of the Nyquist curve from -1; 0 for an unstable loop."""
        if self.spectral_radius() > 1.0 + _ROUNDING:
            return 0.0
        angles = math.pi * np.geomspace(_SLOWEST, 1.0, _FREQUENCIES)
        z = np.exp(1j * angles)[:, None, None] * np.eye(len(self.b))
        states = np.linalg.solve(z - self.A, np.broadcast_to(self.b[:, None], (*z.shape[:2], 1)))
        return float(np.abs(1.0 - self.c @ states[..., 0].T).min())


def motion(dt: float, lag: float) -> tuple[Array, Array]:
    """Return A and b, so that (q, v, a) becomes A (q, v, a) + b command in a period, exactly.

    Args:
        dt: control period, in which the command is held, s.
        lag: of the motor, s.
    """
    left = math.exp(-dt / lag) if lag > 0.0 else 0.0
    moved = lag * (1.0 - left)
    way = lag * (dt - moved)
    A = np.array([[1.0, dt, way], [0.0, 1.0, moved], [0.0, 0.0, left]])
    return A, np.array([0.5 * dt**2 - way, dt - moved, 1.0 - left])


def filter_share(time_constant: float, dt: float) -> float:
    """Return the share of what is new that a low-pass takes in a period."""
    return -math.expm1(-dt / time_constant) if time_constant > 0.0 else 1.0


def open_loop(link: Link, gains: Feedback) -> OpenLoop:
    """Return the loop of a joint, opened at the motor.

    Args:
        link: delay, motor and state estimation; a prediction knows the true lag.
        gains: of the feedback.
    """
    dt, predicts = link.dt, link.predicted is not None
    assumed = link.predicted or 0
    names = ["q", "v", "a", *(f"late{i}" for i in range(link.delay))]
    names += ["q_seen", "v_seen", "a_seen", *(f"sent{i}" for i in range(assumed))]
    names += ["v_before", "a_ref_before", "fast", "slow", "disturbance"]
    rows = np.eye(len(names) + 1)
    x = dict(zip(names, rows, strict=False))
    entering = rows[-1]
    new: dict[str, Array] = {}

    # The state as it is known for its own instant; q_seen, v_seen were predicted from the last.
    seen = np.array([x["q"], x["v"], x["a_seen"]])
    if link.observer is not None:
        error = x["q"] - x["q_seen"]
        seen[0] = x["q_seen"] + link.observer[0] * error
        seen[1] = x["v_seen"] + link.observer[1] * error
    # As it is when the next command acts; with the lag it is where it would coast to.
    A, b = motion(dt, link.lag if predicts else 0.0)
    ahead = seen
    for i in reversed(range(assumed)):
        ahead = A @ ahead + np.outer(b, x[f"sent{i}"])
    if predicts:
        ahead = ahead + link.lag * np.array([ahead[1], ahead[2], 0.0 * entering])

    # Integral action and disturbance observer, then the command.
    theta_slow, theta_fast, mu = gains.leak
    increment = x["a_ref_before"] * dt - (ahead[1] - x["v_before"])
    for name, theta in (("fast", theta_fast), ("slow", theta_slow)):
        decay, share = leak_factors(theta, dt, False)
        new[name] = decay * x[name] + share * increment
    a_ref = -gains.kp * ahead[0] - gains.kd * ahead[1]
    new["disturbance"] = x["disturbance"]
    if gains.disturbance_time:
        share = filter_share(gains.disturbance_time, dt)
        new["disturbance"] = (1.0 - share) * x["disturbance"] - share * increment / dt
        a_ref = a_ref - new["disturbance"]
    command = a_ref + gains.integral * (mu * new["fast"] + (1.0 - mu) * new["slow"])
    new["v_before"], new["a_ref_before"] = ahead[1], a_ref

    # What the controller believes to act now, and what does.
    queue = [command, *(x[f"sent{i}"] for i in range(assumed))]
    new |= {f"sent{i}": row for i, row in enumerate(queue[:-1])}
    believed = A @ seen + np.outer(b, queue[-1])
    new |= dict(zip(("q_seen", "v_seen", "a_seen"), believed, strict=True))
    queue = [entering, *(x[f"late{i}"] for i in range(link.delay))]
    new |= {f"late{i}": row for i, row in enumerate(queue[:-1])}
    A, b = motion(dt, link.lag)
    moved = A @ np.array([x["q"], x["v"], x["a"]]) + np.outer(b, queue[-1])
    new |= dict(zip("qva", moved, strict=True))
    step = np.array([new[name] for name in names])
    return OpenLoop(step[:, :-1], step[:, -1], command[:-1])


def limit_gains(horizon: float, disturbance: Array, braking: Array) -> tuple[Array, Array]:
    """Return kp, 1/s^2, and kd, 1/s, of a joint that rests on its limit: slopes of its bound.

    The bound ends its step with w that T w / 2 + w^2 / (2 B) = x - T v / 2 allows, x from the
    limit. It is at rest where w = T W; there dw = (2 dx - T dv) / T / (1 + 2 W / B).

    Args:
        horizon: T of the bounds, s.
        disturbance: W, shape (n,), rad/s^2.
        braking: limits of acceleration, of which W is not available, shape (n,), rad/s^2.
    """
    flatter = 1.0 / (1.0 + 2.0 * disturbance / np.maximum(braking - disturbance, 1e-9))
    return 2.0 * flatter / horizon**2, (1.0 + flatter) / horizon


class ArmInertia:
    """Mass matrices of an arm at random postures within its position limits.

    With M = D^(1/2) Q S^-1 Q' D^(1/2), D = diag(M), the torque M a_ref + lambda D s falls apart
    into n loops of one joint each, which differ in the gain of the integral action only: lambda
    times a number of S. The numbers 1 / S are at least 0 and n in the mean over 1: coupled joints
    have some far above 1.

    Args:
        model: n joints with one coordinate each.
        q_min: lower position limits, shape (n,), rad; perhaps infinite.
        q_max: upper ones, shape (n,), rad.

    Attributes:
        matrices: M, shape (N, n, n), kg m^2.
        factors: smallest and largest number of S anywhere.
        diagonal: largest inertia of each joint, shape (n,), kg m^2.
    """

    def __init__(self, model: pin.Model, q_min: Array, q_max: Array) -> None:
        low, high = np.maximum(q_min, -math.pi), np.minimum(q_max, math.pi)
        data, random = model.createData(), np.random.default_rng(_SEED)
        self.matrices = np.array(
            [pin.crba(model, data, random.uniform(low, high)).copy() for _ in range(_POSTURES)]
        )
        diagonals = np.diagonal(self.matrices, axis1=1, axis2=2)
        self.diagonal: Array = diagonals.max(axis=0)
        scale = 1.0 / np.sqrt(diagonals)
        shares = np.linalg.eigvalsh(self.matrices * scale[:, :, None] * scale[:, None, :])
        self.factors = 1.0 / float(shares.max()), 1.0 / float(shares.min())
