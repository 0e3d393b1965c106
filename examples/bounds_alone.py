# SPDX-License-Identifier: Apache-2.0
"""Seven joints driven at their limits: exact bounds keep them, naive bounds do not.

No robot model and no ROS: each joint is a plain integrator of the acceleration commanded. Every
joint rushes at one of its position limits, then at the other, as fast as the bounds allow.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.baselines import naive_bounds
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import AccelerationBounds, acceleration_bounds

DT = 0.01  # s
STEPS = 2000
N = 7


def worst_violation(bounds: Callable[..., AccelerationBounds], limits: JointLimits) -> float:
    """Return the largest violation of a position limit, rad, or speed limit, rad/s."""
    rng = np.random.default_rng(0)
    q: NDArray[np.float64] = np.zeros(N)
    v: NDArray[np.float64] = np.zeros(N)
    worst = 0.0
    for step in range(STEPS):
        if step % 250 == 0:
            upwards = rng.random(N) < 0.5
        interval = bounds(q, v, limits, DT)
        a = np.where(upwards, interval.upper, interval.lower)
        q, v = q + DT * v + 0.5 * DT**2 * a, v + DT * a
        position = np.maximum(q - limits.q_max, limits.q_min - q)
        worst = max(worst, position.max(), (np.abs(v) - limits.v_max).max())
    return worst


def main() -> int:
    """Print how far each method breaks the limits; return 1 if the exact one does."""
    ones = np.ones(N)
    names = [f"joint_{j}" for j in range(N)]
    limits = JointLimits(names, -2.0 * ones, 2.0 * ones, 2.0 * ones, -12.0 * ones, 8.0 * ones)
    exact = worst_violation(acceleration_bounds, limits)
    naive = worst_violation(naive_bounds, limits)
    print(f"largest violation, rad or rad/s: exact bounds {exact:.1e}, naive bounds {naive:.1e}")
    return 0 if exact < 1e-9 else 1


if __name__ == "__main__":
    sys.exit(main())
