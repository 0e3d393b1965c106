# SPDX-License-Identifier: Apache-2.0
"""Our bounds beside those of TSID, the implementation of [DelPrete2018] by its author.

TSID's wheels need an older Pinocchio than ours, hence an environment of their own, `.venv-tsid`,
which is made when it is missing. Data goes there and back in npz files.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver, discrete_time_condition

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = ROOT / ".venv-tsid"
REQUIREMENTS = ("tsid==1.7.1", "pin==3.4.*", "cmeel-urdfdom==4.*", "cmeel-tinyxml2==10.*")
"""What works together: the wheels do not say which URDF and XML libraries they were built for."""

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
    with _worker(given) as (found, ask):
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
    assert discrete_time_condition(solver.limits, solver.dt).all()
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
    assert not discrete_time_condition(solver.limits, solver.dt).any()
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
        q, v = q + solver.dt * v + 0.5 * solver.dt**2 * a, v + solver.dt * a
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


Arrays = dict[str, np.ndarray]
Ask = Callable[[], tuple[float, ...]]


@contextmanager
def _worker(given: Arrays) -> Iterator[tuple[Arrays, Ask]]:
    """Run TSID on `given`; yield what it found, and a function that lets it time a block."""
    python = _environment()
    with tempfile.TemporaryDirectory() as directory:
        source, target = (str(Path(directory) / name) for name in ("in.npz", "out.npz"))
        np.savez(source, **given)
        # Not our packages, nor a Pinocchio that ROS may have brought.
        clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "LD_LIBRARY_PATH")}
        process = subprocess.Popen(
            [python, str(ROOT / "benchmarks" / "tsid_worker.py"), source, target],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=clean,
        )

        def ask() -> tuple[float, ...]:
            process.stdin.write("\n")
            process.stdin.flush()
            return tuple(float(word) for word in process.stdout.readline().split())

        try:
            if process.stdout.readline() != "ready\n":
                sys.exit(f"tsid_worker.py failed; remove {ENVIRONMENT} to have it made again")
            with np.load(target) as found:
                yield dict(found), ask
        finally:
            process.stdin.close()
            process.wait()


def _environment() -> str:
    """Return the interpreter that has TSID, after installing it if need be."""
    python, stamp = ENVIRONMENT / "bin" / "python", ENVIRONMENT / ".installed"
    wanted = "\n".join((*REQUIREMENTS, sys.version))
    if not stamp.exists() or stamp.read_text() != wanted:
        print(f"installing TSID into {ENVIRONMENT.name}", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(ENVIRONMENT)], check=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        if subprocess.run([*pip, *REQUIREMENTS], check=False).returncode != 0:
            sys.exit("TSID cannot be installed here: there are wheels for x86-64 Linux only")
        stamp.write_text(wanted)
    return str(python)
