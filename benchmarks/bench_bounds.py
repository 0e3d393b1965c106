# SPDX-License-Identifier: Apache-2.0
"""Time the acceleration bounds of 7 joints: calls of a control loop, and batches.

Medians of blocks; where condition (11) holds and where it does not. If PyTorch is installed, the
table of batches is written into docs/start/without_ros.md.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial

import numpy as np
from figure import table, write_part

from viability_bounds_pkg import batch
from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver, acceleration_bounds

JOINTS = 7
BLOCKS, CALLS, BATCH = 60, 400, 100_000
ARMS, TURNS = 4096, 30
CASES = {"1 kHz": (-2.0, 2.0, 2.0, 12.0, 0.001), "too fast": (-0.5, 0.5, 0.6, 10.0, 0.1)}
"""q_min, q_max, v_max, a_max, dt; (11) fails in the second."""

Case = tuple[float, ...]


def limits_of(case: Case) -> JointLimits:
    """Return limits of equal joints."""
    q_min, q_max, v_max, a_max, _ = (np.full(JOINTS, value) for value in case)
    names = [f"joint_{j}" for j in range(JOINTS)]
    return JointLimits(names, q_min, q_max, v_max, -a_max, a_max)


def states_of(case: Case, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return positions and speeds within the limits, shape (2, count, n)."""
    q_min, q_max, v_max, *_ = case
    shape = (count, JOINTS)
    return np.stack([rng.uniform(q_min, q_max, shape), rng.uniform(-v_max, v_max, shape)])


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
    limited = JerkBoundsSolver(limits, limits.a_max / (10.0 * dt), dt)
    calls = {
        "a call": solver.bounds,
        "as a function, which looks the solver up": partial(
            acceleration_bounds, limits=limits, dt=dt
        ),
        "for states with errors": unsure.bounds,
        "with limited jerk": partial(limited.bounds, a=np.zeros(JOINTS)),
    }
    states = states_of(case, CALLS, rng)
    times = {
        what: statistics.median(microseconds(call, states) for _ in range(BLOCKS))
        for what, call in calls.items()
    }
    q, v = states_of(case, BATCH, rng)
    begin = time.perf_counter()
    solver.bounds(q, v)
    rate = q.size / (time.perf_counter() - begin)
    print(f"{name}, (11) {'holds' if solver.exact.all() else 'fails'}:")
    for what, took in times.items():
        print(f"  {what:42}{took:8.1f} us")
    print(f"  batch {1e-6 * rate:.1f} M joint-states/s, construction {1e3 * construction:.1f} ms")


def measure_batches(rng: np.random.Generator) -> None:
    """Time a batch of all arms on one core, by turns, and print and write the table."""
    case = CASES["1 kHz"]
    solver = BoundsSolver(limits_of(case), case[-1])
    q, v = states_of(case, ARMS, rng)
    calls = {
        "compiled: `BoundsSolver.bounds`": partial(solver.bounds, q, v),
        "NumPy: `batch.bounds`": partial(batch.bounds, solver, q, v),
    }
    try:
        import torch

        torch.set_num_threads(1)
        tensors = torch.asarray(q), torch.asarray(v)
        calls["PyTorch: `batch.bounds`"] = partial(batch.bounds, solver, *tensors)
    except ModuleNotFoundError:
        print("PyTorch is not installed: pip install torch")
    times = np.empty((TURNS, len(calls)))
    for turn in times:
        for k, call in enumerate(calls.values()):
            begin = time.thread_time()
            call()
            turn[k] = time.thread_time() - begin
    medians = np.median(times, axis=0)
    shares = np.median(times[:, :1] / times, axis=0)
    rows = [
        (name, f"{1e-6 * ARMS / median:.2g} million", f"{share:.2f}")
        for name, median, share in zip(calls, medians, shares, strict=True)
    ]
    text = table(rows, (f"batches of {ARMS:,} arms", "states per second", "of the compiled ones"))
    print(text)
    if len(calls) == 3:
        write_part("batches", text, "start/without_ros.md")


def main() -> None:
    """Measure and print."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    rng = np.random.default_rng(0)
    for name, case in CASES.items():
        measure(name, case, rng)
    measure_batches(rng)


if __name__ == "__main__":
    main()
