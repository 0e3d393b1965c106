# SPDX-License-Identifier: Apache-2.0
"""TSID's side of the comparison: runs in an interpreter of its own, see `tsid_comparison.py`.

``python tsid_worker.py INPUT.npz OUTPUT.npz`` computes bounds in given states and follows rollouts
given as starts, writes them, and then times a block of calls for each line on standard input.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import pinocchio as pin
from tsid import tsid_pywrap as tsid


def make_task(joints: int, limits: np.ndarray, dt: float):
    """Return TSID's task for equal joints, and the data its `compute` wants.

    Args:
        joints: their number.
        limits: q_min, q_max, v_max, a_max.
        dt: step, s. The constructor doubles what it is given, which is the paper's way to avoid
            chatter; `setTimeStep` would leave dt squared as it was.
    """
    model, parent = pin.Model(), 0
    for j in range(joints):
        name = f"joint_{j}"
        parent = model.addJoint(parent, pin.JointModelRZ(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Identity())
    robot = tsid.RobotWrapper(model, tsid.RootJointType.FIXED_BASE_SYSTEM, False)
    task = tsid.TaskJointPosVelAccBounds("bounds", robot, 0.5 * dt, False)
    lower, upper, v_max, a_max = (np.full(joints, value) for value in limits)
    task.setPositionBounds(lower, upper)
    task.setVelocityBounds(v_max)
    task.setAccelerationBounds(a_max)
    # Tasks refer to the robot without keeping it.
    return task, robot.data(), robot


def bounds_in(states: np.ndarray, limits: np.ndarray, dt: float) -> np.ndarray:
    """Return lower and upper bounds, shape (2, m, n), in states q and v, shape (2, m, n)."""
    task, data, _robot = make_task(states.shape[2], limits, dt)
    found = np.empty_like(states)
    for i, (q, v) in enumerate(zip(*states, strict=True)):
        constraint = task.compute(0.0, q, v, data)
        found[0, i], found[1, i] = constraint.lowerBound, constraint.upperBound
    return found


def roll_out(start: np.ndarray, limits: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """Return q, v and a of joints that start at rest, shape (3, steps, n)."""
    task, data, _robot = make_task(start.size, limits, dt)
    q, v = start.copy(), np.zeros_like(start)
    path = np.zeros((3, steps, start.size))
    for i in range(steps):
        # Faster, whichever way it goes.
        constraint = task.compute(0.0, q, v, data)
        a = np.where(v >= 0.0, constraint.upperBound, constraint.lowerBound)
        path[:, i] = q, v, a
        if np.abs(q).max() > 1e9:
            break
        q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
    return path


def time_block(task, data, pairs) -> tuple[float, float, float]:
    """Return microseconds of a bare computation, of one with a result, and with it read."""
    start = time.perf_counter()
    for q, v in pairs:
        task.computeAccLimits(q, v, False)
    middle = time.perf_counter()
    for q, v in pairs:
        task.compute(0.0, q, v, data)
    later = time.perf_counter()
    for q, v in pairs:
        constraint = task.compute(0.0, q, v, data)
        constraint.lowerBound, constraint.upperBound  # noqa: B018
    end = time.perf_counter()
    return tuple(1e6 * t / len(pairs) for t in (middle - start, later - middle, end - later))


def main() -> None:
    """Answer the questions in the input, then time for as long as asked to."""
    given = np.load(sys.argv[1])
    found = {}
    for key in given.files:
        kind, _, name = key.partition(":")
        if kind not in ("states", "starts"):
            continue
        limits, dt = given[f"limits:{name}"], float(given[f"dt:{name}"])
        if kind == "states":
            found[key] = bounds_in(given[key], limits, dt)
        else:
            found[key] = roll_out(given[key], limits, dt, int(given["steps"]))
    np.savez(sys.argv[2], **found)
    states = given["states:timing"]
    task, data, _robot = make_task(states.shape[2], given["limits:timing"], given["dt:timing"])
    pairs = list(zip(*states, strict=True))
    print("ready", flush=True)
    for _ in sys.stdin:
        print(*time_block(task, data, pairs), flush=True)


if __name__ == "__main__":
    main()
