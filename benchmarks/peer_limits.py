# SPDX-License-Identifier: Apache-2.0
"""Limits kept by this controller, TSID, placo and a plain clamp, on one arm with the same goals.

Panda goes from posture to posture; 6 of 10 joints of a goal are 0.2 rad beyond a position limit.
The robot is Pinocchio's forward dynamics, and holds each torque for a control period. All have the
same model, gains and limits; placo has no acceleration limits, and brakes by them. The clamp clips
accelerations and torques, and asks for nothing outwards at a limit.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pinocchio as pin
from other_environment import TSID, worker
from peer_rollout import Arm, drive

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.bounds.torque_margin import tightened, torque_margins
from viability_bounds_pkg.estimate.drift import acceleration_drift
from viability_bounds_pkg.estimate.worst_case import StateSpace
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import BoundsSolver

PLACO = (".venv-placo", ("placo==0.10.2",))
URDF = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
JOINTS = [f"panda_joint{j}" for j in range(1, 8)]
V_MAX, A_MAX, BEYOND = 1.5, 5.0, 0.2
TAU_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
KP, KD = 100.0, 20.0
TIME_PER_GOAL = 3.0  # s


class Ours:
    """This project's bounds and controller, without ROS."""

    def __init__(self, model: pin.Model, given: dict[str, Any]) -> None:
        ones, dt = np.ones(model.nv), given["dt"]
        low, high = given["low"], given["high"]
        limits = JointLimits(JOINTS, low, high, V_MAX * ones, -A_MAX * ones, A_MAX * ones)
        space = StateSpace.of(model, low, high, limits.v_max, TAU_MAX)
        drift = acceleration_drift(model, space, limits.a_min, limits.a_max, 5000)
        margins = torque_margins(1.1 * drift, dt)
        self._bounds = BoundsSolver(
            tightened(limits, margins), 2.0 * dt, margins.acceleration, period=dt
        )
        goals = Goals(model.nv, Gains(pose_kp=KP, posture_kp=KP, posture_kd=KD))
        robot = RobotModel(model, "panda_hand", dt)
        self._controller = Controller(robot, [goals, JointBounds()], TAU_MAX)
        self._controller.warm_up()
        self._controller.reset(given["start"])

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


def bare_urdf() -> str:
    """Return the arm's URDF without fingers that move, and without shapes."""
    robot = ET.fromstring(read_urdf(URDF))
    for link in robot.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    for joint in robot.findall("joint"):
        if joint.get("name") not in JOINTS:
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    return ET.tostring(robot, encoding="unicode")


def problem(dt: float, goals: int) -> dict[str, Any]:
    """Return arm, limits and goals."""
    urdf = bare_urdf()
    model = build_model(urdf, JOINTS)
    low, high = model.lowerPositionLimit, model.upperPositionLimit
    rng = np.random.default_rng(0)
    postures, side = rng.uniform(low, high, (goals, 7)), rng.random((goals, 7))
    postures = np.where(side < 0.3, low - BEYOND, np.where(side < 0.6, high + BEYOND, postures))
    return {
        "urdf": urdf,
        "joints": np.array(JOINTS),
        "low": low,
        "high": high,
        "v_max": V_MAX,
        "a_max": A_MAX,
        "tau_max": TAU_MAX,
        "kp": KP,
        "kd": KD,
        "dt": dt,
        "start": 0.5 * (low + high),
        "goals": postures,
        "steps_per_goal": round(TIME_PER_GOAL / dt),
    }


def compare(goals: int, rates: tuple[float, ...] = (500.0, 100.0)) -> None:
    """Print a table: by how much each passes the limits."""
    print(
        f"{goals} goals of {TIME_PER_GOAL:g} s, Panda, 6 of 10 joints {BEYOND} rad beyond limits"
    )
    print("| controller | rate | position [rad] | speed [rad/s] | no solution | way left | step |")
    print("|---|---|---|---|---|---|---|")
    for rate in rates:
        given = problem(1.0 / rate, goals)
        model = build_model(given["urdf"], JOINTS)
        mine: dict[str, Arm] = {"this one": Ours(model, given), "clamp": Clamp(model, given)}
        for name, arm in mine.items():
            _print_row(name, rate, drive(arm, model, given))
        for name, environment in (("TSID 1.7.1", TSID), ("placo 0.10.2", PLACO)):
            word = name.split()[0].lower()
            with worker(environment, "peer_rollout_worker.py", given, word) as (found, _):
                _print_row(name, rate, {key: float(value) for key, value in found.items()})


def _print_row(name: str, rate: float, found: dict[str, float]) -> None:
    passed = [f"{found[key]:.0e}" if found[key] > 0.0 else "0" for key in ("position", "speed")]
    print(
        f"| {name} | {rate:g} Hz | {' | '.join(passed)} | {found['unsolved']:.0%} | "
        f"{found['left']:.1%} | {found['microseconds']:.0f} us |",
        flush=True,
    )
