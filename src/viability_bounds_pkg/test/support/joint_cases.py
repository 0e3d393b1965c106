# SPDX-License-Identifier: Apache-2.0
"""Joints that the tests of the bounds share: where condition (11) holds, and where it fails."""

from dataclasses import replace

import numpy as np

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

# q_min, q_max, v_max, a_min, a_max, dt
HOLDING = {
    "figure 3": (-0.5, 0.5, 2.0, -10.0, 10.0, 0.1),
    "asymmetric": (-0.4, 0.8, 2.0, -6.0, 14.0, 0.1),
    "condition (11) just holds": (-0.05, 0.05, 1.0, -10.0, 10.0, 0.1),
    "no lower limit": (-np.inf, 0.5, 2.0, -10.0, 7.0, 0.1),
    "continuous": (-np.inf, np.inf, 2.0, -10.0, 7.0, 0.5),
}
FAILING = {
    "too fast": (-np.inf, 0.5, 0.4, -10.0, 6.0, 0.1),
    "narrow": (-0.06, 0.06, 2.0, -10.0, 4.0, 0.1),
    "weak one way": (-0.2, 0.3, 3.0, -10.0, 1.0, 0.1),
    "narrow and too fast": (-0.02, 0.02, 0.6, -10.0, 10.0, 0.1),
    "far too narrow": (-0.002, 0.002, 2.0, -10.0, 8.0, 0.1),
    "hardly affected": (-0.028, 0.338, 3.7, -6.165, 2.874, 0.4385),
}
CASES = {**HOLDING, **FAILING}

ODD_STEPS = {
    "1 kHz": (-0.5, 0.5, 2.0, -12.0, 9.0, 0.001),
    "tiny step": (-0.5, 0.5, 2.0, -12.0, 9.0, 1e-5),
    "huge step": (-0.5, 0.5, 2.0, -12.0, 9.0, 10.0),
}


def one_joint(q_min, q_max, v_max, a_min, a_max):
    return JointLimits(["joint"], [q_min], [q_max], [v_max], [a_min], [a_max])


def solver_of(case, margin=0.0, period=1.0, **errors):
    """Return the bounds of a joint.

    Args:
        case: limits and step.
        margin: share of the weaker acceleration limit.
        period: share of the step.
        errors: of position and velocity, as `BoundsSolver` takes them.
    """
    *limits, dt = case
    w = margin * min(-case[3], case[4])
    return BoundsSolver(one_joint(*limits), dt, [w], period * dt, **errors)


def condition_holds(limits, dt, margin=None, **errors):
    """Return whether condition (11) holds for a joint with all of its braking."""
    try:
        return bool(BoundsSolver(limits, dt, margin, **errors).exact.all())
    except JointLimitsError:
        return False


def column(values):
    return np.asarray(values, dtype=float).reshape(-1, 1)


def random_joint(rng, holds):
    """Return limits and step of a random joint for which condition (11) holds, or fails.

    Speed, braking and range are such that it stops within some dozen steps.
    """
    while True:
        dt = 10.0 ** rng.uniform(-3.0, 0.0)
        a_min, a_max = -rng.uniform(2.0, 20.0), rng.uniform(2.0, 20.0)
        unit = max(-a_min, a_max) * dt
        length = unit * dt * 10.0 ** rng.uniform(-1.5, 1.5)
        q_min = rng.uniform(-1.0, 1.0) * length
        case = (q_min, q_min + length, unit * rng.uniform(0.3, 3.0), a_min, a_max, dt)
        if condition_holds(one_joint(*case[:5]), dt) == holds:
            return case


def position_window(case):
    """Return the positions worth looking at: the range, or what lies before its only limit."""
    q_min, q_max, v_max, a_min, a_max, dt = case
    reach = v_max * v_max / min(-a_min, a_max) + 2.0 * v_max * dt
    if not np.isfinite(q_min):
        q_min = (q_max if np.isfinite(q_max) else 0.5 * reach) - reach
    return q_min, q_max if np.isfinite(q_max) else q_min + reach


def states_of(case, count, seed):
    """Return columns of random positions and velocities, some on the limits, many viable."""
    _, _, v_max, _, _, dt = case
    rng = np.random.default_rng(seed)
    low, high = position_window(case)
    # No speed that crosses the range within a quarter of a step is viable.
    fastest = min(v_max, 4.0 * (case[1] - case[0]) / dt)
    q, v = rng.uniform(low, high, count), rng.uniform(-fastest, fastest, count)
    kind = rng.integers(0, 20, count)
    q[kind == 0], q[kind == 1] = low, high
    v[kind == 2], v[kind == 3], v[kind == 4] = fastest, -fastest, 0.0
    return column(q), column(v)


def with_curves(limits, rng):
    """Return limits with random speed limits near those of positions; some have no offset."""
    braking, length = np.minimum(-limits.a_min, limits.a_max), limits.q_max - limits.q_min
    d = braking * rng.uniform(0.3, 3.0, len(limits))
    c = np.sqrt(d * length) * rng.choice([0.0, 0.1, 0.3, 0.6], len(limits))
    return replace(limits, velocity_offset=c, deceleration_limit=d)
