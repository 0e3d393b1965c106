# SPDX-License-Identifier: Apache-2.0
"""Printed report of the estimated limits, and their parameter file for the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import ROUND_DOWN, ROUND_UP

import numpy as np

from viability_bounds_pkg.acceleration_limits import AccelerationLimits
from viability_bounds_pkg.cli.limits_file import (
    CONTROLLER,
    overlay,
    rounded,
)
from viability_bounds_pkg.estimation.discretisation_margin import ZeroOrderHoldError
from viability_bounds_pkg.estimation.state_space import Array
from viability_bounds_pkg.estimation.worst_case_search import WorstCases

HISTORY_COLUMNS = 9


def report_search(names: Sequence[str], worst: WorstCases) -> None:
    """Print the worst states of each joint and how the estimate came to be."""
    count = len(worst.history)
    picked = np.unique(np.linspace(0, count - 1, min(HISTORY_COLUMNS, count)).round().astype(int))
    history = [worst.history[i] for i in picked]
    for j, name in enumerate(names):
        print(f"{name}: torque leaves [{worst.a_min[j]:.4g}, {worst.a_max[j]:.4g}] rad/s^2")
        for side in ("a_min", "a_max"):
            q, v = getattr(worst, f"q_at_{side}")[j], getattr(worst, f"v_at_{side}")[j]
            print(f"  worst {side} at q = {_vector(q)}, v = {_vector(v)}")
        print("  after N " + "".join(f"{entry.evaluations:>10}" for entry in history))
        for side in ("a_min", "a_max"):
            row = "".join(f"{getattr(entry, side)[j]:>10.4g}" for entry in history)
            print(f"  {side}   {row}")
    print(f"{worst.evaluations} evaluations of the dynamics\n")


def report_limits(
    limits: AccelerationLimits, unavailable: Array, margin: ZeroOrderHoldError | None
) -> None:
    """Print the limits to use, where each comes from, and the zero-order hold error.

    Args:
        limits: what to use.
        unavailable: share of states in which torque does not allow them, shape (n,).
        margin: the zero-order hold error, if that was searched.
    """
    found = limits.worst
    for j, name in enumerate(limits.names):
        low, high = limits.a_min[j], limits.a_max[j]
        if name in limits.overridden:
            origin = "override"
            if found.a_min[j] > low or found.a_max[j] < high:
                origin += f", NOT available in {100.0 * unavailable[j]:.2g} % of random states"
        else:
            origin = "found" if (low, high) == (found.a_min[j], found.a_max[j]) else "capped"
        print(f"{name}: a in [{low:.4g}, {high:.4g}] rad/s^2 ({origin})")
    if margin is None:
        return
    print(f"\nwith the torque held for {margin.dt:g} s, at most:")
    for j, name in enumerate(limits.names):
        print(
            f"{name}: acceleration off by {margin.acceleration[j]:.3g} rad/s^2, "
            f"its mean by {margin.mean_acceleration[j]:.3g}, "
            f"position by {margin.position[j]:.2g} rad"
        )


def _vector(values: Array) -> str:
    return "[" + ", ".join(f"{value:.3f}" for value in values) + "]"


def overlay_text(
    limits: AccelerationLimits, margin: ZeroOrderHoldError | None, origin: Sequence[str]
) -> str:
    """Return the parameter file with the limits, rounded to the safe side.

    Args:
        limits: what to write.
        margin: gives ``acceleration_drift``, rad/s^3, if there is one.
        origin: lines of comment that say where the limits come from.
    """
    notes = [*origin, f"joints: {', '.join(limits.names)}; rad/s^2, drift in rad/s^3"]
    if limits.overridden:
        notes.append(f"set by hand: {', '.join(sorted(limits.overridden))}")
    found = {
        "acceleration_min": rounded(limits.a_min, ROUND_DOWN),
        "acceleration_max": rounded(limits.a_max, ROUND_DOWN),
    }
    drift = {}
    if margin is not None:
        notes.append(f"acceleration_drift with the torque held for {margin.dt:g} s")
        # The acceleration is right at the middle of the period: its error grows for half of it.
        jerk = np.maximum(margin.jerk, 2.0 * margin.acceleration / margin.dt)
        drift["acceleration_drift"] = rounded(jerk, ROUND_UP)
    # Not for all nodes at once: a file that names the node would win over that.
    return overlay(found | drift, notes) + "\n" + overlay(found, [], CONTROLLER)
