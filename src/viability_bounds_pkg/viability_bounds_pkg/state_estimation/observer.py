# SPDX-License-Identifier: Apache-2.0
"""Velocity from coarse positions and known accelerations: observers with guaranteed errors.

Each joint is a double integrator with an acceleration a that is known up to d, |d| <= W, and a
position that is measured up to n, |n| <= Delta. The observer predicts and corrects,

    q- = q^ + dt v^ + dt^2 a / 2,   v- = v^ + dt a,   r = q_measured - q-,
    q^ = q- + l1 r,                 v^ = v- + l2 r,

with both poles of its error at p: l1 = 1 - p^2, l2 = (1 - p)^2 / dt. The largest error that n and
d can cause is the sum over the impulse responses' magnitudes (their L1 norm): bang-bang
disturbances with the signs of the response reach it, and nothing within Delta and W exceeds it.

A lasting d, such as friction at rest, leaves a lasting error of the velocity. So an integrator of
r may learn a part c^, |c^| <= C, that is added to a. To the observer, d - c^ is the disturbance,
which W has to cover; W >= |d| + C covers it whatever is learned. `docs/theory/estimator.md`
compares the observer with others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

LEAST_ACCELERATION_ERROR = 0.1
"""Least error that gains are chosen for, rad/s^2: with none, an error at the start would stay."""

LEARNING = 0.2
"""Part of the gain that learns lasting disturbances: makes the slowest of three poles fastest."""

SLACK = 1.15
"""How many times the least the largest velocity error may be, for a slower observer: a step of
the encoder then changes the velocity by less than half as much."""

_POLES = np.concatenate(([0.0], np.exp(-np.geomspace(7.0, 5e-3, 300))))
"""Poles to choose from: 2.5 % between two in frequency: costs less than 1e-4 of the error."""


@dataclass(frozen=True, eq=False)
class ObserverDesign:
    """Gains of the observers of n joints, and what they guarantee; arrays of shape (n,).

    Attributes:
        position_gain: l1.
        velocity_gain: l2, 1/s.
        learning_gain: by which the innovation changes the disturbance that is learned, 1/s^2.
        position_error: largest error of the estimated position, rad.
        velocity_error: largest error of the estimated velocity, rad/s.
        innovation: largest difference between measured and predicted position, rad.
    """

    position_gain: Array
    velocity_gain: Array
    learning_gain: Array
    position_error: Array
    velocity_error: Array
    innovation: Array


def design_observer(
    dt: float, position_error: ArrayLike, acceleration_error: ArrayLike
) -> ObserverDesign:
    """Return the slowest observers whose largest velocity error is within `SLACK` of the least.

    Where positions are exact, the poles are at zero: the velocity is right after two periods.
    Gains are chosen for an error of the acceleration of at least `LEAST_ACCELERATION_ERROR`; the
    guarantees are for the errors given.

    Args:
        dt: control period, s.
        position_error: largest error of a measured position, shape (n,), rad.
        acceleration_error: largest error of the known acceleration, less what is learned of it,
            also within a period, shape (n,), rad/s^2.
    """
    delta, w = np.atleast_1d(*np.broadcast_arrays(position_error, acceleration_error))
    gains = _error_gains()
    # In units of the period: the choice depends on the ratio of both errors only.
    least = np.maximum(w, LEAST_ACCELERATION_ERROR) * dt**2
    error = np.outer(delta, gains[:, 1, 0]) + np.outer(least, gains[:, 1, 1])
    close = error <= SLACK * error.min(axis=1, keepdims=True)
    slowest = len(_POLES) - 1 - np.argmax(close[:, ::-1], axis=1)
    chosen = np.where(delta > 0.0, slowest, 0)

    worst = gains[chosen, :, 0].T * delta + gains[chosen, :, 1].T * w * dt**2
    p = _POLES[chosen]
    return ObserverDesign(
        position_gain=1.0 - p**2,
        velocity_gain=(1.0 - p) ** 2 / dt,
        learning_gain=LEARNING * (1.0 - p) ** 3 / dt**2,
        position_error=worst[0],
        velocity_error=worst[1] / dt,
        innovation=worst[2],
    )


class Observer:
    """Estimates positions and velocities of n joints from positions and accelerations.

    Args:
        design: gains.
        dt: control period, s.
        lasting: C, up to which a lasting disturbance is learned, shape (n,), rad/s^2.

    Attributes:
        state: the estimate.
        disturbance: c^, the learned part, shape (n,), rad/s^2.
    """

    def __init__(self, design: ObserverDesign, dt: float, lasting: Array) -> None:
        self._design, self._dt, self._lasting = design, dt, lasting
        self._learns = bool(lasting.any())
        self.start(State(np.zeros_like(lasting), np.zeros_like(lasting)))

    def start(self, state: State, disturbance: Array | None = None) -> None:
        """Restart from a state, with a known disturbance, shape (n,), rad/s^2, clipped to C."""
        self.state = state
        known = np.zeros_like(self._lasting) if disturbance is None else disturbance
        self.disturbance = self._clipped(known)

    def predict(self, a: Array) -> None:
        """Advance by a period with mean acceleration `a` of the model, shape (n,), rad/s^2."""
        self.state = self.state.after(a + self.disturbance, self._dt)

    def innovation(self, q: Array) -> Array:
        """Return how far measured positions `q` are from the estimate, shape (n,), rad."""
        difference: Array = q - self.state.q
        return difference

    def correct(self, innovation: Array) -> None:
        """Correct the estimate by what `innovation` returned."""
        (q, v), design = self.state, self._design
        self.state = State(
            q + design.position_gain * innovation, v + design.velocity_gain * innovation
        )
        if self._learns:
            learned = self.disturbance + design.learning_gain * innovation
            self.disturbance = self._clipped(learned)

    def _clipped(self, disturbance: Array) -> Array:
        return np.minimum(np.maximum(disturbance, -self._lasting), self._lasting)


@cache
def _error_gains() -> Array:
    """Return `_norms` of all poles, shape (poles, 3, 2)."""
    return np.array([_norms(p) for p in _POLES])


def _norms(p: float) -> Array:
    """Return the largest errors that one pole leaves, for the period 1, shape (3, 2).

    L1 norms of the responses of position, velocity and innovation to errors of the position and of
    the acceleration.

    The error e = (q - q^, v - v^) follows e+ = A e + B(s) d(s) - L n with A = (I - L C) F,
    B(s) = (I - L C) (1 - s, 1) for d at time s of the period. Powers of a 2 x 2 matrix with a
    double eigenvalue p are A^i = p^i I + i p^(i-1) (A - p I).
    """
    l1, l2 = 1.0 - p * p, (1.0 - p) ** 2
    corrected = np.array([[1.0 - l1, 0.0], [-l2, 1.0]])
    step = np.array([[1.0, 1.0], [0.0, 1.0]])
    i = np.arange(2 if p == 0.0 else 3 + int(35.0 / -np.log(p)))
    slope = i * p ** np.maximum(i - 1, 0)
    rest = corrected @ step - p * np.eye(2)
    powers = (p**i)[:, None, None] * np.eye(2) + slope[:, None, None] * rest
    from_noise = powers @ np.array([l1, l2])
    # The response to d(s) is linear in s: its values at both ends of the period.
    ends = powers @ corrected @ np.array([[1.0, 0.0], [1.0, 1.0]])
    before = step[0]  # position before the correction, of the error one period earlier
    return np.array(
        [
            [np.abs(from_noise[:, 0]).sum(), _integral(ends[:, 0])],
            [np.abs(from_noise[:, 1]).sum(), _integral(ends[:, 1])],
            [np.abs(from_noise @ before).sum() + 1.0, _integral(before @ ends) + 0.5],
        ]
    )


def _integral(ends: Array) -> float:
    """Return the sum of integrals of |f| over periods, f linear with values `ends`, (count, 2)."""
    first, last = ends.T
    total = np.abs(first) + np.abs(last)
    both = np.where(total > 0.0, total, 1.0)
    crosses = first * last < 0.0
    return float(np.sum(np.where(crosses, (first**2 + last**2) / (2.0 * both), 0.5 * total)))
