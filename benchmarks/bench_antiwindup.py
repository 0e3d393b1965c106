# SPDX-License-Identifier: Apache-2.0
"""Anti-windup: the closed form of eq. (11) against ProxQP, and a step of the integral action.

Run ``python benchmarks/bench_antiwindup.py``. Problems of 9 joints whose clipped torque would not
dissipate enough, so that (11) is a QP in earnest. ProxQP is timed from scratch and started from
the last solution, each problem a little different from the one before, as in a control loop, and
its memory allocated beforehand. All are called through Python, in turns.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from proxsuite import proxqp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "src" / "torque_safety_controller"))

from torque_safety_controller.anti_windup import (
    project_to_limits,
    scale_factor,
    scale_to_limits,
)
from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralFeedback,
    IntegralSettings,
)

JOINTS = 9
PROBLEMS = 300
ROUNDS = 30
DRIFT = 1e-3  # relative change from one problem to the next
TOLERANCE = 1e-8
CACHE = 8_000_000  # numbers; more than the last-level cache holds


def problems(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a slowly changing u and s, shape (PROBLEMS, JOINTS) each, and limits."""
    u_max = rng.uniform(0.5, 4.0, JOINTS)
    while True:
        u = np.empty((PROBLEMS, JOINTS))
        s = np.empty((PROBLEMS, JOINTS))
        u[0], s[0] = 5.0 * rng.normal(size=JOINTS), rng.normal(size=JOINTS)
        for k in range(1, PROBLEMS):
            u[k] = u[k - 1] * (1.0 + DRIFT * rng.normal(size=JOINTS))
            s[k] = s[k - 1] * (1.0 + DRIFT * rng.normal(size=JOINTS))
        clipped = np.clip(u, -u_max, u_max)
        if all(
            y @ x < 0.9 * scale_factor(z, u_max) * (y @ z)
            for x, y, z in zip(clipped, s, u, strict=True)
        ):
            return u, s, u_max


class GeneralSolver:
    """Eq. (11) by ProxQP."""

    def __init__(self, u_max: np.ndarray, warm: bool) -> None:
        n = len(u_max)
        self._upper = np.r_[u_max, np.inf]
        self._lower = np.r_[-u_max, -1e6]
        self._C = np.vstack([np.eye(n), np.ones(n)])
        self._qp = proxqp.dense.QP(n, 0, n + 1)
        self._qp.settings.eps_abs = TOLERANCE
        self._qp.settings.eps_rel = 0.0
        self._qp.settings.initial_guess = (
            proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
            if warm
            else proxqp.InitialGuess.NO_INITIAL_GUESS
        )
        self._qp.init(np.eye(n), np.zeros(n), None, None, self._C, self._lower, self._upper)
        self._u_max = u_max

    def __call__(self, u: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the solution, shape (n,)."""
        self._C[-1] = s
        self._lower[-1] = scale_factor(u, self._u_max) * (s @ u)
        self._qp.update(None, -u, None, None, self._C, self._lower, self._upper, False)
        self._qp.solve()
        return self._qp.results.x


def integral_steps(rng: np.random.Generator, law: IntegralSettings) -> Callable[..., np.ndarray]:
    """Return a step of the integral action, of a joint velocity and an acceleration."""
    A = rng.normal(size=(JOINTS, JOINTS))
    M, C = A @ A.T + np.eye(JOINTS), rng.normal(size=(JOINTS, JOINTS))
    feedback = IntegralFeedback(law)
    no_task = np.zeros((0, JOINTS))
    return lambda v, a_ref: feedback.torque(ArmTerms(M, C, no_task, no_task, v), a_ref, 1e-3)


def measure(name: str, function, u, s, flush, off: float | None = None) -> None:
    """Time a function of two vectors, many calls on end and one with cold caches, and print."""
    times, alone = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for x, y in zip(u, s, strict=True):
            function(x, y)
        times.append((time.perf_counter() - start) / PROBLEMS)
        flush += 1.0
        start = time.perf_counter()
        function(u[0], s[0])
        alone.append(time.perf_counter() - start)
    print(
        f"{name:<40} {1e6 * statistics.median(times):6.1f} us per call "
        f"(best {1e6 * min(times):.1f}), {1e6 * statistics.median(alone):.1f} us with "
        f"cold caches" + ("" if off is None else f", off by {off:.0e}")
    )


def main() -> None:
    """Measure and print."""
    rng = np.random.default_rng(0)
    u, s, u_max = problems(rng)
    flush = np.zeros(CACHE)
    exact = [project_to_limits(x, y, u_max) for x, y in zip(u, s, strict=True)]
    for name, function in {
        "(11) in closed form": lambda x, y: project_to_limits(x, y, u_max),
        "(11) by ProxQP, from the last solution": GeneralSolver(u_max, warm=True),
        "(11) by ProxQP, from scratch": GeneralSolver(u_max, warm=False),
    }.items():
        results = [np.array(function(x, y)) for x, y in zip(u, s, strict=True)]
        measure(name, function, u, s, flush, np.abs(np.array(results) - exact).max())
    measure("(10)", lambda x, _: scale_to_limits(x, u_max), u, s, flush)
    measure("clip by NumPy", lambda x, _: np.clip(x, -u_max, u_max), u, s, flush)
    measure("nothing, for comparison", lambda x, _: x, u, s, flush)
    for name, law in {
        "integral step, not limited": IntegralSettings(np.full(JOINTS, 1e6)),
        "integral step, all joints limited": IntegralSettings(np.full(JOINTS, 1e-3)),
        "integral step, all limited, as the paper": IntegralSettings(
            np.full(JOINTS, 1e-3), anti_windup="paper"
        ),
    }.items():
        measure(name, integral_steps(rng, law), 1e-3 * u, 10.0 + s, flush)


if __name__ == "__main__":
    main()
