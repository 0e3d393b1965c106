# SPDX-License-Identifier: Apache-2.0
"""The state of an arm: joint positions and velocities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class State(NamedTuple):
    """Positions and velocities of n joints at one time.

    Attributes:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]
