# SPDX-License-Identifier: Apache-2.0
"""How exact the acceleration bounds are: against brute force, and against adversaries in motion.

bash scripts/reproduce.sh exactness [--states 100000] [--joint-steps 10000000]

Prints tables, writes results/exactness/metrics.json, and exits with 1 where a claim fails.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

# One solver on each core; set before NumPy starts threads of its own.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from tqdm import tqdm

sys.path.insert(0, f"{Path(__file__).resolve().parents[2]}/src/viability_bounds_pkg/test/support")

from adversary import (
    POLICIES,
    VIOLATION,
    Kept,
    bring_back,
    drive,
    states_in_kernel,
    states_outside,
)
from against_brute_force import EXACT, Comparison, compare, merged
from discrete_kernel import exact_bounds
from joint_cases import (
    CASES,
    FAST_LOOP,
    ODD_STEPS,
    Case,
    condition_holds,
    one_joint,
    random_joint,
    states_of,
)

from viability_bounds_pkg.viability import BoundsSolver

ROOT = Path(__file__).resolve().parents[2]

STATES_OF_A_CASE = 480
STATES_OF_A_JOINT = 120
FAILING_JOINTS = 200
"""Random joints for which the exact kernel of discrete time is compared."""

JOINTS_IN_MOTION = 60
"""Random joints that move, for each of (11) holding and failing."""

COMPARED = ["states", "viable", "misjudged", "unsafe", "undecided", "difference", "excess"]
"""Columns of `Comparison`."""

STEPS = 100
"""Length of a motion within the kernel."""

MOST_STEPS = 10**6
"""Of a motion back into the kernel: none takes nearly as many."""

MOTIONS_OUTSIDE = 300
"""For each joint and policy."""


class Joint(NamedTuple):
    """A joint to examine; its own seed makes the order of work irrelevant."""

    name: str
    case: Case
    holds: bool
    seed: int


def named_joints(cases: dict[str, Case], seed: int) -> list[Joint]:
    """Return the cases as joints."""
    return [
        Joint(name, case, condition_holds(case), seed + i)
        for i, (name, case) in enumerate(cases.items())
    ]


def random_joints(holds: bool, count: int, rng: np.random.Generator) -> list[Joint]:
    """Return random joints, all of them with condition (11) holding, or failing."""
    return [
        Joint("random joints", random_joint(rng, holds), holds, int(rng.integers(2**31)))
        for _ in range(count)
    ]


def against_brute_force(count: int, joint: Joint) -> Comparison:
    """Compare bounds and viability in random states of a joint."""
    return compare(joint.case, *states_of(joint.case, count, joint.seed))


def discrete_kernel(count: int, joint: Joint) -> Comparison:
    """Compare those of the exact kernel of discrete time."""
    return compare(joint.case, *states_of(joint.case, count, joint.seed), bounds=exact_bounds)


def in_motion(motions: int, joint: Joint) -> Kept:
    """Drive a joint from within its kernel, with every policy."""
    solver = BoundsSolver(one_joint(*joint.case[:5]), joint.case[5])
    rng = np.random.default_rng(joint.seed)
    return merged(
        drive(solver, *states_in_kernel(solver, joint.case, motions, rng), policy, STEPS, rng)
        for policy in POLICIES
    )


class Outside(NamedTuple):
    """How motions from outside the kernel went; counts, then worst cases.

    Attributes:
        motions: their number.
        joint_steps: of all of them.
        stray: joints that did not get back.
        again: largest violation of a limit by a joint that had been back, rad and rad/s.
        speed: the most that one was faster than at the start or than its limit, rad/s.
        beyond: the furthest that one went beyond where braking at its limit takes it, rad.
    """

    motions: int
    joint_steps: int
    stray: int
    again: float
    speed: float
    beyond: float


def from_outside(joint: Joint) -> Outside:
    """Bring a joint back, with every policy; see how far it goes."""
    case = joint.case
    solver = BoundsSolver(one_joint(*case[:5]), case[5])
    rng = np.random.default_rng(joint.seed)
    q, v = states_outside(solver, case, MOTIONS_OUTSIDE, rng)
    runs = [bring_back(solver, q, v, policy, MOST_STEPS, rng) for policy in POLICIES]
    return merged(
        Outside(q.size, run.joint_steps, run.stray, run.again, run.speed, run.position)
        for run in runs
    )


Work = Callable[[Joint], tuple]


def examine(pool, what: str, work: Work, joints: list[Joint]) -> Iterator[tuple[Joint, tuple]]:
    """Yield joints and what came of them, on all cores."""
    yield from zip(joints, tqdm(pool.imap(work, joints), what, len(joints)), strict=True)


def rows_of(results: list[tuple[Joint, tuple]]) -> dict[tuple[str, bool], tuple]:
    """Return the merged outcome of all joints of the same name and kind."""
    rows: dict[tuple[str, bool], list[tuple]] = {}
    for joint, outcome in results:
        rows.setdefault((joint.name, joint.holds), []).append(outcome)
    return {key: merged(outcomes) for key, outcomes in rows.items()}


def compare_all(pool, wanted: int, seed: int) -> list[tuple[Joint, Comparison]]:
    """Compare the named cases, and `wanted` viable states of random joints, half of each kind."""
    work = partial(against_brute_force, STATES_OF_A_CASE)
    results = list(examine(pool, "named joints", work, named_joints(CASES, seed)))
    work = partial(against_brute_force, STATES_OF_A_JOINT)
    rng = np.random.default_rng(seed)
    with tqdm(desc="random joints", total=wanted, unit=" viable states") as bar:
        for holds in (True, False):
            missing = (wanted + 1) // 2
            while missing > 0:
                # Rarely more than are needed, rarely twice.
                joints = random_joints(holds, -(-missing // STATES_OF_A_JOINT) + 1, rng)
                for joint, outcome in zip(joints, pool.imap(work, joints), strict=True):
                    results.append((joint, outcome))
                    missing -= outcome.compared
                    bar.update(outcome.compared)
    return results


def table(title: str, columns: list[str], rows: dict[tuple[str, bool], Outside]) -> None:
    """Print rows of outcomes, and what they come to for either kind."""
    print(f"\n{title}\n{'':<28}{'(11)':<8}" + "".join(f"{c:>16}" for c in columns))
    for holds in (True, False):
        kind = [(name, outcome) for (name, h), outcome in rows.items() if h == holds]
        for name, outcome in [*kind, ("all", merged(outcome for _, outcome in kind))]:
            cells = "".join(
                f"{x:>16,}" if isinstance(x, int) else f"{_text(x):>16}" for x in outcome
            )
            print(f"{name:<28}{'holds' if holds else 'fails':<8}{cells}")


def _text(x: float) -> str:
    return "-" if x == -np.inf else f"{x:.1e}"


def as_metrics(rows: dict[tuple[str, bool], Outside]) -> dict[str, dict]:
    """Return outcomes by kind and name, infinities as null."""
    found: dict[str, dict] = {"condition_11_holds": {}, "condition_11_fails": {}}
    for (name, holds), outcome in rows.items():
        part = found["condition_11_holds" if holds else "condition_11_fails"]
        part[name] = {k: x if np.isfinite(x) else None for k, x in outcome._asdict().items()}
    return found


def failures(compared, kernel, moved, outside) -> list[str]:
    """Return which claims did not come true."""
    wrong = []
    for rows, exact in ((compared, False), (kernel, True)):
        for (name, holds), c in rows.items():
            off = c.excess > EXACT or c.unsafe
            if holds or exact:
                off = c.difference > EXACT or c.misjudged
            if off or c.undecided > 1e-3 * c.states:
                wrong.append(f"{name}: {c}")
    for (name, _), k in moved.items():
        if max(k.position, k.speed) > VIOLATION or k.lost:
            wrong.append(f"{name}: {k}")
    for (name, holds), o in outside.items():
        # Where (11) fails, braking at the limit would throw a joint against the other limit.
        if o.stray or max(o.again, o.speed, o.beyond if holds else 0.0) > VIOLATION:
            wrong.append(f"{name}: {o}")
    return wrong


def main() -> None:
    """Examine, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", type=int, default=100_000, help="viable states to compare")
    parser.add_argument("--joint-steps", type=int, default=10_000_000, help="steps in motion")
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    start = time.monotonic()
    rng = np.random.default_rng(options.seed)
    movers = named_joints(CASES | FAST_LOOP | ODD_STEPS, options.seed)
    movers += [j for holds in (True, False) for j in random_joints(holds, JOINTS_IN_MOTION, rng)]
    motions = -(-options.joint_steps // (len(movers) * len(POLICIES) * STEPS))
    # Not forked: numba and the solver may have threads.
    with multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0))) as pool:
        moved = rows_of(list(examine(pool, "in motion", partial(in_motion, motions), movers)))
        outside = rows_of(list(examine(pool, "from outside", from_outside, movers)))
        compared = rows_of(compare_all(pool, options.states, options.seed))
        failing = [j for j in named_joints(CASES, options.seed) if not j.holds]
        failing += random_joints(False, FAILING_JOINTS, rng)
        work = partial(discrete_kernel, STATES_OF_A_JOINT)
        kernel = rows_of(list(examine(pool, "discrete kernel", work, failing)))
    table(
        "Against brute force: difference of a bound as a part of the acceleration range",
        COMPARED,
        compared,
    )
    table("The same for the exact kernel of discrete time", COMPARED, kernel)
    table(
        "In motion from within the kernel: violations in continuous time",
        ["joint-steps", "lost", "position rad", "speed rad/s"],
        moved,
    )
    table(
        "From outside: beyond the speed at the start, and beyond where full braking would end",
        ["motions", "joint-steps", "stray", "out again", "speed rad/s", "position rad"],
        outside,
    )
    wrong = failures(compared, kernel, moved, outside)
    print(f"\n{(time.monotonic() - start) / 60:.1f} min", *wrong, sep="\n")
    directory = ROOT / "results" / "exactness"
    directory.mkdir(parents=True, exist_ok=True)
    metrics = {
        "seed": options.seed,
        "against_brute_force": as_metrics(compared),
        "discrete_kernel_against_brute_force": as_metrics(kernel),
        "in_motion": as_metrics(moved),
        "from_outside": as_metrics(outside),
        "claims_hold": not wrong,
    }
    (directory / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
