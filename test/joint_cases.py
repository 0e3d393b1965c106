"""Joints that the tests of the bounds share: where condition (11) holds, and where it fails."""

import numpy as np

from viability_bounds_pkg.joint_limits import JointLimits

# (q_min, q_max, v_max, a_min, a_max, dt)
HOLDING = {
    "figure 3": (-0.5, 0.5, 2.0, -10.0, 10.0, 0.1),
    "asymmetric": (-0.4, 0.8, 2.0, -6.0, 14.0, 0.1),
    "asymmetric, mirrored": (-0.8, 0.4, 2.0, -14.0, 6.0, 0.1),
    "condition (11) just holds": (-0.05, 0.05, 1.0, -10.0, 10.0, 0.1),
    "no lower limit": (-np.inf, 0.5, 2.0, -10.0, 7.0, 0.1),
    "continuous": (-np.inf, np.inf, 2.0, -10.0, 7.0, 0.5),
}
FAILING = {
    "too fast": (-0.5, 0.5, 0.6, -10.0, 6.0, 0.1),
    "too fast, one limit": (-np.inf, 0.5, 0.4, -10.0, 6.0, 0.1),
    "narrow": (-0.03, 0.03, 2.0, -10.0, 10.0, 0.1),
    "narrow and asymmetric": (-0.06, 0.06, 2.0, -10.0, 4.0, 0.1),
    "weak one way": (-0.2, 0.3, 3.0, -10.0, 1.0, 0.1),
    "narrow and too fast": (-0.02, 0.02, 0.6, -10.0, 10.0, 0.1),
    "far too narrow": (-0.002, 0.002, 2.0, -10.0, 8.0, 0.1),
    "hardly affected": (-0.028, 0.338, 3.7, -6.165, 2.874, 0.4385),
}
CASES = {**HOLDING, **FAILING}
FAST_LOOP = {"1 kHz": (-0.5, 0.5, 2.0, -12.0, 9.0, 0.001)}
"""Too many steps to a stop for a brute-force solution."""


def one_joint(q_min, q_max, v_max, a_min, a_max):
    return JointLimits(["joint"], [q_min], [q_max], [v_max], [a_min], [a_max])


def column(values):
    return np.asarray(values, dtype=float).reshape(-1, 1)


def states_of(case, count, seed):
    """Return random positions and velocities, some on the limits, many of them viable."""
    q_min, q_max, v_max, _, _, dt = case
    rng = np.random.default_rng(seed)
    low = q_min if np.isfinite(q_min) else -1.0
    high = q_max if np.isfinite(q_max) else 1.0
    # No speed that crosses the range within a quarter of a step is viable.
    fastest = min(v_max, 4.0 * (q_max - q_min) / dt)
    q, v = rng.uniform(low, high, count), rng.uniform(-fastest, fastest, count)
    kind = rng.integers(0, 20, count)
    q[kind == 0], q[kind == 1] = low, high
    v[kind == 2], v[kind == 3] = fastest, -fastest
    v[kind == 4] = 0.0
    return q, v
