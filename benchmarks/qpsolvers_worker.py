# SPDX-License-Identifier: Apache-2.0
"""The QPs of `bench_peers.py` by one backend of qpsolvers: runs in an interpreter of its own.

``python qpsolvers_worker.py INPUT.npz OUTPUT.npz BACKEND`` solves the given problems, writes the
solutions, NaN where there is none, and then times all of them for each line on standard input.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from qpsolvers import Problem, solve_problem


def main() -> None:
    """Solve, then time for as long as asked to."""
    source, target, backend = sys.argv[1:]
    with np.load(source) as content:
        given = dict(content)
    n = given["H"].shape[1]
    problems = [
        Problem(H, g, np.r_[C, -C], np.r_[upper[n:], -lower[n:]], lb=lower[:n], ub=upper[:n])
        for H, g, C, lower, upper in zip(
            *(given[name] for name in ("H", "g", "C", "lower", "upper")), strict=True
        )
    ]
    nothing = np.full(n, np.nan)
    x = [solve_problem(problem, solver=backend).x for problem in problems]
    np.savez(target, x=np.array([nothing if each is None else each for each in x]))
    print("ready", flush=True)
    for _ in sys.stdin:
        last, begin = None, time.thread_time()
        for problem in problems:
            last = solve_problem(problem, solver=backend, initvals=last).x
        print(1e6 * (time.thread_time() - begin) / len(problems), flush=True)


if __name__ == "__main__":
    main()
