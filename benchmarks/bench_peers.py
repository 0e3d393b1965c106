# SPDX-License-Identifier: Apache-2.0
"""Limits kept by this controller, TSID, placo and a plain clamp, on one arm with the same goals.

Panda goes from posture to posture; 6 of 10 joints of a goal are 0.2 rad beyond a position limit.
The robot is Pinocchio's forward dynamics, and holds each torque for a control period. All have the
same model, gains and limits; placo has no acceleration limits, and brakes by them. The clamp clips
accelerations and torques, and asks for nothing outwards at a limit. TSID and placo have
environments of their own, made when missing.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import pinocchio as pin
from live_robot import load
from other_environment import PLACO, TSID, worker
from panda import A_MAX, JOINTS, TAU_MAX, V_MAX, limits_of, make_controller, problem
from rollout import Arm, drive

from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.bounds.torque_margin import tightened, torque_margins
from viability_bounds_pkg.estimate.drift import acceleration_drift
from viability_bounds_pkg.estimate.worst_case import StateSpace
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import BoundsSolver

BEYOND = 0.2  # rad
KP, KD = 100.0, 20.0
TIME_PER_GOAL = 3.0  # s
RATES = (500.0, 100.0)  # Hz
RIVALS = {"TSID 1.7.1": ("tsid", TSID), "placo 0.10.2": ("placo", PLACO)}


class Ours:
    """This project's bounds and controller, without ROS."""

    def __init__(self, model: pin.Model, given: dict[str, Any]) -> None:
        dt, limits = given["dt"], limits_of(given)
        space = StateSpace.of(model, limits.q_min, limits.q_max, limits.v_max, TAU_MAX)
        drift = acceleration_drift(model, space, limits.a_min, limits.a_max, 5000)
        margins = torque_margins(1.1 * drift, dt)
        self._bounds = BoundsSolver(
            tightened(limits, margins), 2.0 * dt, margins.acceleration, period=dt
        )
        goals = Goals(model.nv, Gains(pose_kp=KP, posture_kp=KP, posture_kd=KD))
        self._controller = make_controller(model, goals, dt, given["start"])

    def set_goal(self, q_des: np.ndarray) -> None:
        """Set the posture to reach."""
        self._controller.goals.set_posture(q_des)

    def torque(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return the torque to apply; None where limits had to be relaxed."""
        lower, upper, _ = self._bounds.bounds(q, v)
        step = self._controller.step(State(q, v), AccelerationRange(lower, upper))
        return None if step.failure else step.tau


class Clamp:
    """What clips accelerations and torques, and stops asking for more at a limit."""

    def __init__(self, model: pin.Model, given: dict[str, Any]) -> None:
        self._model, self._data, self._given = model, model.createData(), given

    def set_goal(self, q_des: np.ndarray) -> None:
        """Set the posture to reach."""
        self._goal = q_des

    def torque(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the torque to apply."""
        a = np.clip(KP * (self._goal - q) - KD * v, -A_MAX, A_MAX)
        a = np.where((q >= self._given["high"]) | (v >= V_MAX), np.minimum(a, 0.0), a)
        a = np.where((q <= self._given["low"]) | (v <= -V_MAX), np.maximum(a, 0.0), a)
        tau = pin.rnea(self._model, self._data, q, v, a)
        return np.clip(tau, -TAU_MAX, TAU_MAX)


def rollout(dt: float, goals: int) -> dict[str, Any]:
    """Return arm, limits and goals."""
    given = problem(dt, posture_kp=KP, posture_kd=KD)
    low, high = given["low"], given["high"]
    rng = np.random.default_rng(0)
    postures, side = rng.uniform(low, high, (goals, 7)), rng.random((goals, 7))
    postures = np.where(side < 0.3, low - BEYOND, np.where(side < 0.6, high + BEYOND, postures))
    steps = round(TIME_PER_GOAL / dt)
    return given | {"start": 0.5 * (low + high), "goals": postures, "steps_per_goal": steps}


def main() -> None:
    """Print a table: by how much each passes the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--goals", type=int, default=20, help=f"of {TIME_PER_GOAL:g} s each")
    options = parser.parse_args()
    print(load())
    print("| controller | rate | position [rad] | speed [rad/s] | no solution | way left | step |")
    print("|---|---|---|---|---|---|---|")
    for rate in RATES:
        given = rollout(1.0 / rate, options.goals)
        model = build_model(given["urdf"], JOINTS)
        mine: dict[str, Arm] = {"this one": Ours(model, given), "clamp": Clamp(model, given)}
        for name, arm in mine.items():
            print_row(name, rate, drive(arm, model, given))
        for name, (word, environment) in RIVALS.items():
            with worker(environment, given, "rollout", word) as (found, _):
                print_row(name, rate, {key: float(value) for key, value in found.items()})


def print_row(name: str, rate: float, found: dict[str, float]) -> None:
    """Print what came of a controller."""
    passed = [f"{found[key]:.0e}" if found[key] > 0.0 else "0" for key in ("position", "speed")]
    print(
        f"| {name} | {rate:g} Hz | {' | '.join(passed)} | {found['unsolved']:.0%} | "
        f"{found['left']:.1%} | {found['microseconds']:.0f} us |",
        flush=True,
    )


if __name__ == "__main__":
    main()
