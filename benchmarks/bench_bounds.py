# SPDX-License-Identifier: Apache-2.0
"""Time the acceleration bounds of 7 joints: calls of a control loop, and batches.

Medians of blocks; where condition (11) holds and where it does not. With ``--tsid`` values and
times are compared with TSID's task, by the author of the paper; it has an environment of its own,
made when missing, because its wheels need an older Pinocchio than ours.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial

import numpy as np
from other_environment import TSID, worker

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver, acceleration_bounds

JOINTS = 7
BLOCKS, CALLS, BATCH = 60, 400, 100_000
CASES = {
    "1 kHz": (-2.0, 2.0, 2.0, 12.0, 0.001),
    "100 Hz": (-2.0, 2.0, 2.0, 12.0, 0.01),
    "Fig. 3": (-0.5, 0.5, 2.0, 10.0, 0.1),
    "too fast": (-0.5, 0.5, 0.6, 10.0, 0.1),
    "narrow": (-0.03, 0.03, 2.0, 10.0, 0.1),
}
"""q_min, q_max, v_max, a_max (TSID knows symmetric accelerations only), dt; (11) fails in two."""

Case = tuple[float, ...]


def limits_of(case: Case) -> JointLimits:
    """Return limits of equal joints."""
    q_min, q_max, v_max, a_max, _ = (np.full(JOINTS, value) for value in case)
    names = [f"joint_{j}" for j in range(JOINTS)]
    return JointLimits(names, q_min, q_max, v_max, -a_max, a_max)


def states_of(case: Case, count: int, reach: float, rng: np.random.Generator) -> np.ndarray:
    """Return positions and speeds up to `reach` times the limits, shape (2, count, n)."""
    q_min, q_max, v_max, _, dt = case
    half = 0.5 * (q_max - q_min)
    fastest = reach * min(v_max, 8.0 * half / dt)
    q = 0.5 * (q_min + q_max) + rng.uniform(-reach * half, reach * half, (count, JOINTS))
    return np.stack([q, rng.uniform(-fastest, fastest, q.shape)])


def microseconds(call, states: np.ndarray) -> float:
    """Return the processor time of a call, mean over the states."""
    pairs = list(zip(*states, strict=True))
    begin = time.thread_time()
    for q, v in pairs:
        call(q, v)
    return 1e6 * (time.thread_time() - begin) / len(pairs)


def measure(name: str, case: Case, rng: np.random.Generator) -> None:
    """Time calls and batches, and print."""
    limits, dt = limits_of(case), case[-1]
    begin = time.perf_counter()
    solver = BoundsSolver(limits, dt)
    construction = time.perf_counter() - begin
    # Small enough for (11) to hold, or not, as without.
    off = np.full(JOINTS, 1e-3)
    unsure = BoundsSolver(limits, dt, position_error=off, velocity_error=off)
    calls = {
        "a call": solver.bounds,
        "as a function, which looks the solver up": partial(
            acceleration_bounds, limits=limits, dt=dt
        ),
        "for states with errors": unsure.bounds,
    }
    states = states_of(case, CALLS, 1.0, rng)
    times = {
        what: statistics.median(microseconds(call, states) for _ in range(BLOCKS))
        for what, call in calls.items()
    }
    q, v = states_of(case, BATCH, 1.0, rng)
    begin = time.perf_counter()
    solver.bounds(q, v)
    rate = q.size / (time.perf_counter() - begin)
    print(f"{name}, (11) {'holds' if solver.exact.all() else 'fails'}:")
    for what, took in times.items():
        print(f"  {what:42}{took:8.1f} us")
    print(f"  batch {1e-6 * rate:.1f} M joint-states/s, construction {1e3 * construction:.1f} ms")


def compare_with_tsid(rng: np.random.Generator) -> None:
    """Compare values in states inside the limits and a little outside, then times; print."""
    given = {"names": np.array(list(CASES))}
    for name, case in CASES.items():
        given |= {
            f"limits:{name}": np.array(case),
            f"states:{name}": states_of(case, 3000, 1.1, rng),
        }
    with worker(TSID, given, "bounds", "tsid") as (found, ask):
        for name, case in CASES.items():
            solver, scale = BoundsSolver(limits_of(case), case[-1]), 2.0 * case[3]
            lower, upper, viable = solver.bounds(*given[f"states:{name}"])
            theirs = found[name]
            difference = np.maximum(np.abs(lower - theirs[0]), np.abs(upper - theirs[1])) / scale
            wider = np.maximum(lower - theirs[0], theirs[1] - upper) > 1e-6 * scale
            print(
                f"{name}, (11) {'holds' if solver.exact.all() else 'fails'}: {viable.sum():,} "
                f"viable states; largest difference {difference[viable].max():.1e} of the "
                f"acceleration range; TSID allows more in {wider[viable].mean():.0%}"
            )
        name = next(iter(CASES))
        solver, states = (
            BoundsSolver(limits_of(CASES[name]), CASES[name][-1]),
            given[f"states:{name}"],
        )
        times = [(ask()[0], microseconds(solver.bounds, states)) for _ in range(BLOCKS)]
    theirs_us, ours_us = (statistics.median(part) for part in zip(*times, strict=True))
    print(f"a call: TSID {theirs_us:.2f} us, ours {ours_us:.2f} us")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tsid", action="store_true", help="compare with TSID 1.7.1")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    for name in ("1 kHz", "too fast"):
        measure(name, CASES[name], rng)
    if options.tsid:
        compare_with_tsid(rng)


if __name__ == "__main__":
    main()
