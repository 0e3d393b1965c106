"""Acceleration bounds of others, for comparison."""

from __future__ import annotations

import numpy as np

from viability_bounds_pkg.viability import AccelerationBounds


def naive_bounds(q, v, limits, dt):
    """Eq. (2) of [DelPrete2018]."""
    upper = np.minimum((limits.v_max - v) / dt, 2.0 / dt**2 * (limits.q_max - q - dt * v))
    lower = np.maximum((-limits.v_max - v) / dt, 2.0 / dt**2 * (limits.q_min - q - dt * v))
    upper = np.clip(upper, limits.a_min, limits.a_max)
    lower = np.clip(lower, limits.a_min, limits.a_max)
    return AccelerationBounds(np.minimum(lower, upper), np.maximum(lower, upper), lower <= upper)
