# SPDX-License-Identifier: Apache-2.0
"""Our bounds beside those of TSID, the implementation of [DelPrete2018] by its author.

TSID's wheels need an older Pinocchio than ours, hence an environment of their own, `.venv-tsid`.
"""

from __future__ import annotations

import statistics
import time

import numpy as np
from other_environment import TSID, worker

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

JOINTS = 7
STATES = 20_000
STEPS = 400
BLOCKS = 60
CALLS = 400

# q_min, q_max, v_max, a_max (TSID knows symmetric accelerations only), dt
HOLDING = {
    "1 kHz": (-2.0, 2.0, 2.0, 12.0, 0.001),
    "100 Hz": (-2.0, 2.0, 2.0, 12.0, 0.01),
    "Fig. 3": (-0.5, 0.5, 2.0, 10.0, 0.1),
}
FAILING = {
    "too fast": (-0.5, 0.5, 0.6, 10.0, 0.1),
    "narrow": (-0.03, 0.03, 2.0, 10.0, 0.1),
}


def main() -> None:
    """Compare and print."""
    rng = np.random.default_rng(0)
    given: dict[str, np.ndarray] = {"steps": np.array(STEPS)}
    for name, (*limits, dt) in {**HOLDING, **FAILING, "timing": HOLDING["1 kHz"]}.items():
        given[f"limits:{name}"], given[f"dt:{name}"] = np.array(limits), np.array(dt)
        count = CALLS if name == "timing" else STATES // JOINTS
        given[f"states:{name}"] = _states(limits, dt, count, rng)
        if name in FAILING:
            given[f"starts:{name}"] = np.linspace(*limits[:2], JOINTS)
    with worker(TSID, "tsid_worker.py", given) as (found, ask):
        for name, case in HOLDING.items():
            _compare_where_it_holds(name, case, given[f"states:{name}"], found[f"states:{name}"])
        for name, case in FAILING.items():
            _compare_where_it_fails(name, case, given, found)
        _compare_times(given["states:timing"], ask)


def _solver(case: tuple[float, ...]) -> BoundsSolver:
    q_min, q_max, v_max, a_max, dt = case
    limits = JointLimits(
        [f"joint_{j}" for j in range(JOINTS)],
        *(np.full(JOINTS, value) for value in (q_min, q_max, v_max, -a_max, a_max)),
    )
    return BoundsSolver(limits, dt)


def _states(limits: list[float], dt: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return positions and velocities inside the limits and a little outside, (2, count, n)."""
    q_min, q_max, v_max, _ = limits
    reach, fastest = 0.55 * (q_max - q_min), 1.1 * min(v_max, 4.0 * (q_max - q_min) / dt)
    q = 0.5 * (q_min + q_max) + rng.uniform(-reach, reach, (count, JOINTS))
    return np.stack([q, rng.uniform(-fastest, fastest, q.shape)])


def _compare_where_it_holds(name, case, states, theirs) -> None:
    solver, a_max = _solver(case), case[3]
    assert solver.exact.all()
    lower, upper, viable = solver.bounds(*states)
    error = np.maximum(np.abs(lower - theirs[0]), np.abs(upper - theirs[1])) / (2.0 * a_max)
    outside = ~viable
    beyond = np.abs(theirs).max(axis=0)[outside] / a_max
    ours = np.maximum(np.abs(lower), np.abs(upper))[outside] / a_max
    print(
        f"{name}, (11) holds: {viable.sum():,} viable states, largest difference "
        f"{error[viable].max():.1e} of the acceleration range; {outside.sum():,} states outside "
        f"the kernel, beyond a_max in {100.0 * (beyond > 1.0 + 1e-9).mean():.0f} % of them by up "
        f"to {beyond.max():.3g} times a_max with TSID, {ours.max():.3g} with ours"
    )


def _compare_where_it_fails(name, case, given, found) -> None:
    solver = _solver(case)
    assert not solver.exact.any()
    states, theirs = given[f"states:{name}"], found[f"states:{name}"]
    lower, upper, viable = solver.bounds(*states)
    tolerance = 1e-6 * 2.0 * case[3]
    wider = (theirs[0] < lower - tolerance) | (theirs[1] > upper + tolerance)
    start = given[f"starts:{name}"]
    q, v = start.copy(), np.zeros(JOINTS)
    path = np.empty((3, STEPS, JOINTS))
    for i in range(STEPS):
        low, high, _ = solver.bounds(q, v)
        a = np.where(v >= 0.0, high, low)
        path[:, i] = q, v, a
        q, v = q + solver.steps[0] * v + 0.5 * solver.steps[0] ** 2 * a, v + solver.steps[0] * a
    print(
        f"{name}, (11) fails: TSID allows more than is safe in "
        f"{100.0 * wider[viable].mean():.0f} % of {viable.sum():,} viable states; from rest, "
        f"each joint going faster at each step, limits are broken by "
        f"{_broken(found[f'starts:{name}'], case)} with TSID, {_broken(path, case)} with ours"
    )


def _broken(path: np.ndarray, case: tuple[float, ...]) -> str:
    """Return by how much a path of q, v, a, shape (3, steps, n), breaks its limits on the way."""
    q_min, q_max, v_max, _, dt = case
    if not (np.abs(path) < 1e6).all():
        return "ever more (it diverges)"
    q, v, a = path
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.clip(np.where(a == 0.0, dt, -v / a), 0.0, dt)
        points = np.stack([q, q + turn * v + 0.5 * turn**2 * a, q + dt * v + 0.5 * dt * dt * a])
        position = max((points - q_max).max(), (q_min - points).max(), 0.0)
        speed = max((np.abs(v + dt * a) - v_max).max(), 0.0)
    return f"{position:.2g} rad, {speed:.2g} rad/s"


def _compare_times(states: np.ndarray, ask) -> None:
    """Time both in turns: a block there, a block here."""
    solver, pairs = _solver(HOLDING["1 kHz"]), list(zip(*states, strict=True))
    theirs, ours = [], []
    for _ in range(BLOCKS):
        theirs.append(ask())
        start = time.perf_counter()
        for q, v in pairs:
            solver.bounds(q, v)
        ours.append(1e6 * (time.perf_counter() - start) / len(pairs))
    bare, result, read = (statistics.median(part) for part in zip(*theirs, strict=True))
    mine = statistics.median(ours)
    start = time.perf_counter()
    solver.bounds(*states)
    computing = 1e6 * (time.perf_counter() - start) / len(pairs)
    print(
        f"a call for {JOINTS} joints, median of {BLOCKS} blocks in turns: TSID {bare:.2f} us "
        f"without a result, {result:.2f} us with one, {read:.2f} us with its bounds as arrays; "
        f"ours {mine:.2f} us with arrays, {mine / bare:.1f}, {mine / result:.1f} and "
        f"{mine / read:.1f} times as long, {computing:.2f} us of it computing (as in a batch)"
    )
