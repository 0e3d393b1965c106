# SPDX-License-Identifier: Apache-2.0
"""The torque of motors at rest, averaged until it is known well enough.

Reported torques carry the noise of the current sensors. Of N samples with standard deviation s the
mean is off by at most t s / sqrt(N), t of Student's distribution, which makes up for s being an
estimate itself: two samples that differ say nothing. The torque of an arm that is pushed meanwhile
drifts: then the end of a straight line through the samples is known better than their mean.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Array = NDArray[np.float64]

CONFIDENCE = 0.9973
"""Probability that a joint's mean is within what is stated: that of three standard deviations."""


_SHORTEST = 16
"""Samples of the shortest part of a record that is judged by itself."""


class AverageTorque(NamedTuple):
    """A torque that was averaged.

    Attributes:
        mean: torque now, shape (n,), N m.
        error: how far it may be off at most, shape (n,), of the torque limits.
        samples: how many say so.
    """

    mean: Array
    error: Array
    samples: int


class TorqueAverage:
    """Mean of the last samples of a torque, and how far it may be off.

    Args:
        tau_max: torque limits, shape (n,), N m.
        samples: how many are kept; the older half of more is forgotten.
    """

    def __init__(self, tau_max: Array, samples: int) -> None:
        self._tau_max = tau_max
        self._samples = np.zeros((max(samples, _SHORTEST), len(tau_max)))
        self._count = 0

    def clear(self) -> None:
        """Forget all samples."""
        self._count = 0

    def add(self, tau: Array) -> None:
        """Take another sample, shape (n,), N m."""
        if self._count == len(self._samples):
            self._count //= 2
            self._samples[: self._count] = self._samples[-self._count :]
        self._samples[self._count] = tau
        self._count += 1

    def best(self) -> AverageTorque:
        """Return the torque now, of all samples or of the last ones, as it is known best.

        The error is infinite for less than two samples.
        """
        counts = [self._count]
        while counts[-1] >= 2 * _SHORTEST:
            counts.append(counts[-1] // 2)
        kinds = (_steady, _drifting) if self._count >= _SHORTEST else (_steady,)
        found = [
            kind(self._samples[self._count - count : self._count], self._tau_max)
            for count in counts
            for kind in kinds
        ]
        return min(found, key=lambda average: float(average.error.max()))


def _steady(seen: Array, tau_max: Array) -> AverageTorque:
    """Return the mean; what the newer half differs from the older one by is an error, too."""
    count = len(seen)
    if count < 2:
        return AverageTorque(seen.sum(axis=0), np.full(len(tau_max), math.inf), count)
    drift = np.abs(seen[-(count // 2) :].mean(axis=0) - seen[: count // 2].mean(axis=0))
    error = drift + _student(count - 1) * seen.std(axis=0, ddof=1) / math.sqrt(count)
    return AverageTorque(seen.mean(axis=0), error / tau_max, count)


def _drifting(seen: Array, tau_max: Array) -> AverageTorque:
    """Return the end of the straight line through the samples.

    Its variance is (4 N - 2) / (N (N + 1)) of a sample's. A parabola, whose mean is off by
    c / 16 in the last quarter, is off by c / 6 at the end.
    """
    count = len(seen)
    time = np.arange(count) - 0.5 * (count - 1)
    mean = seen.mean(axis=0)
    slope = time @ seen / (time @ time)
    residual = seen - mean - np.outer(time, slope)
    spread = np.sqrt((residual**2).sum(axis=0) / (count - 2))
    leverage = math.sqrt((4 * count - 2) / (count * (count + 1)))
    bent = 16.0 / 6.0 * np.abs(residual[-(count // 4) :].mean(axis=0))
    error = bent + _student(count - 2) * leverage * spread
    return AverageTorque(mean + time[-1] * slope, error / tau_max, count)


@cache
def _student(freedom: int) -> float:
    """Return how many estimated standard deviations are exceeded with 1 - `CONFIDENCE` only."""
    return float(stdtrit(freedom, 0.5 * (1.0 + CONFIDENCE)))
