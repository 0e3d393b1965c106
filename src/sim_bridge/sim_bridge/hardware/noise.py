# SPDX-License-Identifier: Apache-2.0
"""Random numbers of the imperfect hardware, each kind of error with numbers of its own."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CLIP = 3.0
"""Standard deviations at which noise is clipped, so that there is a largest error."""


class Stream(IntEnum):
    """Kinds of error; one that is switched on does not change the numbers of the others."""

    POSITION = 0
    VELOCITY = 1
    REPORTED_CURRENT = 2
    MOTOR_CURRENT = 3
    MISSED_DEADLINES = 4
    OUTAGES = 5


def generator(seed: int, stream: Stream) -> np.random.Generator:
    """Return the random numbers of one kind of error."""
    return np.random.default_rng([seed, stream])


class ClippedNoise:
    """White normal noise, clipped at `CLIP` standard deviations.

    Args:
        deviation: standard deviations before clipping, shape (n,), not negative.
        seed, stream: of `generator`.
    """

    def __init__(self, deviation: Array, seed: int, stream: Stream) -> None:
        self._deviation, self._source = deviation, (seed, stream)
        self._on = bool(deviation.any())
        self.reset()

    def reset(self) -> None:
        """Begin the sequence anew."""
        self._random = generator(*self._source)

    def added_to(self, value: Array) -> Array:
        """Return `value` with new noise, shape (n,)."""
        if not self._on:
            return value
        draw = self._random.standard_normal(value.size)
        return value + self._deviation * np.clip(draw, -CLIP, CLIP)
