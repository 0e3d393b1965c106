# SPDX-License-Identifier: Apache-2.0
"""Time the acceleration bounds: one arm at a time, as a control loop asks, and in batches.

Run ``bash scripts/bench.sh bounds``. Prints, for 7 joints, microseconds per call (median and best
of the blocks, because other programs share the machine) and joint-states per second of a batch;
where condition (11) holds and where it does not. With ``--tsid``, compares with TSID's task too.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver, acceleration_bounds

JOINTS = 7
BLOCKS = 60
CALLS = 400
BATCH = 100_000


def seven_joints() -> JointLimits:
    """Return limits like those of a collaborative arm, asymmetric."""
    ones = np.ones(JOINTS)
    names = [f"joint_{j}" for j in range(JOINTS)]
    return JointLimits(names, -2.0 * ones, 2.0 * ones, 2.0 * ones, -12.0 * ones, 10.0 * ones)


def time_calls(call: Callable, q: np.ndarray, v: np.ndarray) -> list[float]:
    """Return the mean time of one call in each block, s."""
    times = []
    for block in range(BLOCKS):
        states = [(q[i], v[i]) for i in range(block * CALLS, (block + 1) * CALLS)]
        start = time.perf_counter()
        for x, speed in states:
            call(x, speed)
        times.append((time.perf_counter() - start) / CALLS)
    return times


def time_batches(solver: BoundsSolver, q: np.ndarray, v: np.ndarray) -> list[float]:
    """Return joint-states per second, for a few repetitions."""
    rates = []
    for _ in range(8):
        start = time.perf_counter()
        solver.bounds(q, v)
        rates.append(q.size / (time.perf_counter() - start))
    return rates


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--tsid",
        action="store_true",
        help="compare values and time with TSID 1.7.1, installed into .venv-tsid when missing",
    )
    options = parser.parse_args()
    limits = seven_joints()
    rng = np.random.default_rng(0)
    q = rng.uniform(limits.q_min, limits.q_max, (BATCH, JOINTS))
    v = rng.uniform(-limits.v_max, limits.v_max, (BATCH, JOINTS))
    for dt, what in ((0.001, "(11) holds"), (0.3, "(11) fails")):
        start = time.perf_counter()
        solver = BoundsSolver(limits, dt)
        construction = time.perf_counter() - start
        calls = [1e6 * t for t in time_calls(solver.bounds, q, v)]
        function = partial(acceleration_bounds, limits=limits, dt=dt)
        lookups = [1e6 * t for t in time_calls(function, q, v)]
        # Small enough for (11) to hold, or not, as without.
        off, error = np.full(JOINTS, 1e-3), np.full(JOINTS, 1e-3)
        unsure = BoundsSolver(limits, dt, position_error=off, velocity_error=error)
        with_errors = [1e6 * t for t in time_calls(unsure.bounds, q, v)]
        rates = [r / 1e6 for r in time_batches(solver, q, v)]
        print(
            f"dt {dt:g} s, {what}: {statistics.median(calls):.1f} us per call of {JOINTS} joints "
            f"(best block {min(calls):.1f}), {statistics.median(lookups):.1f} us as the function "
            f"acceleration_bounds, which looks the solver up; "
            f"{statistics.median(with_errors) / statistics.median(calls):.2f} times as long for "
            f"states with errors; "
            f"{statistics.median(rates):.1f} M joint-states/s in a batch "
            f"(best {max(rates):.1f}); construction {1e3 * construction:.1f} ms"
        )
    if options.tsid:
        import tsid_comparison

        tsid_comparison.main()


if __name__ == "__main__":
    main()
