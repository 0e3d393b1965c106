# SPDX-License-Identifier: Apache-2.0
"""Speed limits of FR3 that depend on position: random states, adversaries, and places of rest."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from figure import Figure
from numpy.typing import NDArray

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver, viable_velocity_range

Array = NDArray[np.float64]

JOINTS = 7
# franka_description, robots/fr3/joint_limits.yaml; accelerations of libfranka's rate_limiting.h.
FR3 = JointLimits(
    tuple(f"fr3_joint{j + 1}" for j in range(JOINTS)),
    np.array([-2.9007, -1.8361, -2.9007, -3.0770, -2.8763, 0.4398, -3.0508]),
    np.array([2.9007, 1.8361, 2.9007, -0.1169, 2.8763, 4.6216, 3.0508]),
    np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26]),
    np.full(JOINTS, -10.0),
    np.full(JOINTS, 10.0),
    np.array([0.652, 0.25, 0.2005, 0.3542, 0.5738, 0.4885, 0.4592]),
    np.array([6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0]),
)
DT, HORIZON = 1e-3, 2e-3  # s
STATES, STEPS = 143_000, 60
"""States of each joint, a million in all, and steps from each."""
REST_TIME = 8.0
"""In which joints come to rest at their limits, s."""
HEADS = (
    "joint",
    "c, rad/s",
    "d, rad/s²",
    "beyond v(q) in a million motions, rad/s",
    "at rest before the limit, rad",
    "c² / (2 d), rad",
    "beyond v(q) with constant limits, rad/s",
    "",
)


def too_fast(limits: JointLimits, q: Array, v: Array) -> Array:
    """Return by how much speeds exceed v(q), shape (n,), rad/s."""
    lowest, highest = limits.velocities(q)
    return np.max(np.maximum(v - highest, lowest - v), axis=0)


def after(q: Array, v: Array, a: Array, t: float) -> tuple[Array, Array]:
    """Return the state after a time."""
    return q + t * v + 0.5 * t * t * a, v + t * a


def worst_of_random_motions() -> tuple[Array, int]:
    """Return the largest excess of each joint, and how often a state was outside its kernel.

    Most motions do their worst within the bounds; steps end at any time up to the horizon.
    """
    rng, solver = np.random.default_rng(0), BoundsSolver(FR3, HORIZON, period=DT)
    q = rng.uniform(FR3.q_min, FR3.q_max, (STATES, JOINTS))
    slowest, fastest = solver.velocity_range(q)
    share = np.clip(rng.uniform(-0.3, 1.3, q.shape), 0.0, 1.0)  # a third on the edge
    v = slowest + share * (fastest - slowest)
    out = np.sign(v)
    worst, lost = np.full(JOINTS, -np.inf), 0
    for _ in range(STEPS):
        bounds = solver.bounds(q, v)
        lost += int((~bounds.viable).sum())
        out = np.where(rng.random(q.shape) < 0.02, -out, out)
        greedy = np.where(out > 0.0, bounds.upper, bounds.lower)
        anything = bounds.lower + rng.random(q.shape) * (bounds.upper - bounds.lower)
        a = np.where(rng.random(q.shape) < 0.8, greedy, anything)
        q, v = after(q, v, a, HORIZON * rng.choice([0.3, 0.5, 0.5, 0.8, 1.0]))
        worst = np.maximum(worst, too_fast(FR3, q, v))
    return np.maximum(worst, 0.0), lost


def driven_to_the_limits(solver: BoundsSolver) -> tuple[Array, Array, list[tuple[Array, Array]]]:
    """Return the largest excess, where joints are in the end, and the motions.

    Joints start in the middle, half of them towards their upper limits.
    """
    q = np.tile(0.5 * (FR3.q_min + FR3.q_max), (2, 1))
    v, worst, motion = np.zeros_like(q), np.full(JOINTS, -np.inf), []
    for _ in range(round(REST_TIME / DT)):
        bounds = solver.bounds(q, v)
        q, v = after(q, v, np.stack([bounds.upper[0], bounds.lower[1]]), DT)
        worst = np.maximum(worst, too_fast(FR3, q, v))
        motion.append((q, v))
    return np.maximum(worst, 0.0), q, motion


def speed_limits() -> Figure:
    """FR3 by its speed limits, and by constant ones with the deceleration of these."""
    figure = Figure("theory-speed-limits", "theory-speed-limits", HEADS, "theory/bounds.md")
    beyond, lost = worst_of_random_motions()
    exact, rest, motion = driven_to_the_limits(BoundsSolver(FR3, HORIZON, period=DT))
    none = {"velocity_offset": np.zeros(0), "deceleration_limit": np.zeros(0)}
    braking = np.minimum(FR3.a_max, FR3.deceleration_limit)
    constant = replace(FR3, a_min=-braking, a_max=braking, **none)
    usual, _, other = driven_to_the_limits(BoundsSolver(constant, HORIZON, period=DT))
    left = np.minimum(FR3.q_max - rest, rest - FR3.q_min).min(axis=0)
    meant = FR3.rest_distance
    beyond = np.maximum(beyond, exact)
    for j, name in enumerate(FR3.names):
        figure.add(
            name,
            f"{FR3.velocity_offset[j]:g}",
            f"{FR3.deceleration_limit[j]:g}",
            f"{beyond[j]:.1g}",
            f"{left[j]:.5f}",
            f"{meant[j]:.5f}",
            f"{usual[j]:.2f}",
            holds=bool(beyond[j] <= 1e-9 and abs(left[j] / meant[j] - 1.0) < 0.2 and lost == 0),
            so="kept",
        )
    figure.metrics = {
        "states": float(STATES * JOINTS),
        "steps": float(STATES * JOINTS * STEPS),
        "outside_kernel": float(lost),
        "beyond_rad_s": float(beyond.max()),
        "rest_ratio_max": float((left / meant).max()),
        "rest_ratio_min": float((left / meant).min()),
    }
    figure.save(_picture(motion, other), "speed_limits")
    return figure


def _picture(exact: list[tuple[Array, Array]], usual: list[tuple[Array, Array]]) -> plt.Figure:
    """Draw the last part of the way of a joint that can brake as d, and of one that cannot."""
    picture, axes = plt.subplots(1, 2, figsize=(10, 3.7), layout="constrained")
    for axis, j, way in ((axes[0], 1, 0.9), (axes[1], 4, 1.0)):
        q = np.linspace(FR3.q_max[j] - way, FR3.q_max[j], 400)
        every = np.tile(q[:, None], JOINTS)
        axis.fill_between(
            q, viable_velocity_range(every, FR3)[1][:, j], color="tab:green", alpha=0.15, lw=0
        )
        axis.plot(q, FR3.velocities(every)[1][:, j], "k--", lw=1, label="v(q)")
        for motion, colour, label in (
            (usual, "tab:red", "constant limits"),
            (exact, "tab:green", "limits by position"),
        ):
            states = np.array([(place[0, j], speed[0, j]) for place, speed in motion])
            axis.plot(*states.T, color=colour, label=label)
        axis.set(
            xlim=(q[0], q[-1]),
            ylim=(0.0, 1.05 * FR3.v_max[j]),
            xlabel="position, rad",
            ylabel="speed, rad/s",
            title=FR3.names[j],
        )
        axis.grid(alpha=0.3)
    axes[0].legend(loc="lower left", fontsize=9)
    return picture
