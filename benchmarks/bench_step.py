# SPDX-License-Identifier: Apache-2.0
"""One controller step: its parts, by each solver, and beside Pinocchio's terms or TSID's step.

Panda follows poses and postures at random within its limits of position, speed, acceleration and
torque, so that limits are active. The same states are answered once more, by turns; times are of
the processor, medians of the blocks. With ``--tsid`` TSID gets the same tasks, weights, limits and
states; values are compared first. It has an environment of its own, made when missing.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from live_robot import load
from other_environment import TSID, Arrays, worker
from panda import A_MAX, FRAME, JOINTS, TAU_MAX, limits_of, make_controller, problem

from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.qp import SOLVERS, AccelerationRange, InverseDynamicsQP
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.pose_task import PoseTask
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import Task
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import BoundsSolver

DT = 0.002  # s
GAINS = {
    "pose_kp": 30.0,
    "pose_kd": 11.0,
    "posture_kp": 10.0,
    "posture_kd": 6.3,
    "posture_weight": 1e-3,
}
STEPS_PER_GOAL = 500
REGULARISATION = 1e-8
"""What TSID adds to its Hessian; ours otherwise has 1e-6, relative to the largest weight."""


class TsidGoals(Goals):
    """Goals whose tasks are those that TSID has."""

    def tasks(self, stiffness: np.ndarray | None) -> list[Task]:
        """Return the pose task and the posture task."""
        gains = self.gains
        posture = gains.posture_kp, gains.posture_kd, gains.posture_weight
        return [
            PoseTask(
                self.pose_des, gains.pose_kp, gains.pose_kd, gains.pose_weight, separate=True
            ),
            PostureTask(self.q_des, *posture),
        ]


class Ours:
    """This project's bounds and controller, without ROS.

    Args:
        solver: of the QP.
        as_tsid: with TSID's tasks, its weight of the accelerations, and torques of the instant
            rather than of the middle of the step.
    """

    def __init__(self, solver: str = "daqp", *, as_tsid: bool = False) -> None:
        given = problem(DT)
        self.model = build_model(given["urdf"], JOINTS)
        self.low, self.high = given["low"], given["high"]
        self.bounds = BoundsSolver(limits_of(given), 2.0 * DT)
        goals = (TsidGoals if as_tsid else Goals)(self.model.nv, Gains(**GAINS))
        middle = 0.5 * (self.low + self.high)
        self.controller = make_controller(
            self.model, goals, 0.0 if as_tsid else DT, middle, solver
        )
        if as_tsid:
            self.controller._qp = InverseDynamicsQP(self.model.nv, REGULARISATION)

    def set_goal(self, posture: np.ndarray, pose: np.ndarray) -> None:
        """Set goals: positions, shape (7,), rotation and translation, shape (3, 4)."""
        self.controller.goals.set_pose(pin.SE3(pose[:, :3], pose[:, 3]))
        self.controller.goals.set_posture(posture)

    def step(self, q: np.ndarray, v: np.ndarray) -> Any:
        """Return the output for a state, bounds included."""
        lower, upper, _ = self.bounds.bounds(q, v)
        return self.controller.step(State(q, v), AccelerationRange(lower, upper))

    def block(self, given: Arrays) -> float:
        """Answer all states; return microseconds of a step."""
        begin = time.thread_time()
        for k, (q, v) in enumerate(zip(given["q"], given["v"], strict=True)):
            if k % STEPS_PER_GOAL == 0:
                self.set_goal(given["posture"][k], given["pose"][k])
            self.step(q, v)
        return 1e6 * (time.thread_time() - begin) / len(given["q"])


def record(steps: int) -> Arrays:
    """Move the arm; return states, goals, bounds, accelerations and torques."""
    ours, rng = Ours(as_tsid=True), np.random.default_rng(0)
    model, data = ours.model, ours.model.createData()
    q, v = 0.5 * (ours.low + ours.high), np.zeros(model.nv)
    names = ("q", "v", "pose", "posture", "bounds", "a", "tau")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for step in range(steps):
        if step % STEPS_PER_GOAL == 0:
            posture = rng.uniform(ours.low, ours.high)
            pin.framesForwardKinematics(model, data, posture)
            goal = data.oMf[model.getFrameId(FRAME)]
            pose = np.c_[goal.rotation, goal.translation]
            ours.set_goal(posture, pose)
        output = ours.step(q, v)
        assert output.relaxation is None and not output.failure
        bounds = np.array(ours.bounds.bounds(q, v)[:2])
        values = q, v, pose, posture, bounds, output.a, output.tau
        for name, value in zip(names, values, strict=True):
            rows[name].append(value)
        q, v = q + DT * v + 0.5 * DT * DT * output.a, v + DT * output.a
    return {name: np.array(values) for name, values in rows.items()}


def model_terms(model: pin.Model, given: Arrays) -> float:
    """Compute with Pinocchio the terms that a step needs; return microseconds of a step."""
    data, zero = model.createData(), np.zeros(model.nv)
    frame, axes = model.getFrameId(FRAME), pin.ReferenceFrame.LOCAL
    begin = time.thread_time()
    for q, v in zip(given["q"], given["v"], strict=True):
        pin.crba(model, data, q)
        pin.nonLinearEffects(model, data, q, v)
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, zero)
        pin.updateFramePlacement(model, data, frame)
        pin.getFrameJacobian(model, data, frame, axes)
        pin.getFrameAcceleration(model, data, frame, axes)
        pin.rnea(model, data, q, v, zero)
    return 1e6 * (time.thread_time() - begin) / len(given["q"])


class Staged(Ours):
    """A controller whose stages are timed."""

    def __init__(self) -> None:
        super().__init__()
        self._seconds: dict[str, float] = {}
        for stage, owner, function in (
            ("bounds", self.bounds, "bounds"),
            ("model", self.controller.robot, "update"),
            ("QP built", self.controller._qp, "build"),
            ("QP solved", self.controller._qp, "solve"),
            ("torque", self.controller.robot, "torque"),
        ):
            self._watch(stage, owner, function)

    def _watch(self, stage: str, owner: Any, function: str) -> None:
        """Add the time in a method of an object to a stage."""
        plain = getattr(owner, function)

        def timed(*arguments: Any) -> Any:
            begin = time.thread_time()
            result = plain(*arguments)
            self._seconds[stage] += time.thread_time() - begin
            return result

        setattr(owner, function, timed)
        self._seconds[stage] = 0.0

    def stages(self, given: Arrays) -> dict[str, float]:
        """Return microseconds of a step by stage; all else with what the clocks take."""
        self._seconds = dict.fromkeys(self._seconds, 0.0)
        whole = self.block(given)
        found = {name: 1e6 * each / len(given["q"]) for name, each in self._seconds.items()}
        return found | {"tasks and all else": whole - sum(found.values())}


def by_turns(
    questions: dict[str, Callable[[], dict[str, float]]], rounds: int
) -> dict[str, dict[str, float]]:
    """Time all by turns; return the medians of each."""
    answers: dict[str, list[dict[str, float]]] = {name: [] for name in questions}
    for _ in range(rounds):
        for name, ask in questions.items():
            answers[name].append(ask())
    return {
        name: {key: statistics.median(each[key] for each in found) for key in found[0]}
        for name, found in answers.items()
    }


def compare_values(given: Arrays, found: Arrays) -> None:
    """Print how TSID's solutions differ from ours."""
    solved = ~np.isnan(found["a"]).any(axis=1)
    same = (np.abs(found["bounds"] - given["bounds"]) < 1e-6 * A_MAX).all(axis=(1, 2))
    error = np.abs(found["a"] - given["a"])[solved & same].max()
    torque = (np.abs(found["tau"] - given["tau"])[solved & same] / TAU_MAX).max()
    print(
        f"TSID solves {solved.sum()}; bounds differ in {np.count_nonzero(~same)}; largest "
        f"difference elsewhere {error:.1e} rad/s^2 and {torque:.1e} of the torque limits"
    )


def measure(given: Arrays, rounds: int, ask_tsid: Any = None) -> None:
    """Time by turns, and print."""
    arms = {solver: Ours(solver) for solver in SOLVERS}
    model = arms["daqp"].model
    questions: dict[str, Callable[[], dict[str, float]]] = {
        f"step, {solver}": lambda arm=arm: {"whole": arm.block(given)}
        for solver, arm in arms.items()
    }
    timed = Staged()
    questions["stages"] = lambda: timed.stages(given)
    questions["Pinocchio's terms"] = lambda: {"whole": model_terms(model, given)}
    if ask_tsid is not None:
        parts = ("problem, with bounds", "QP solved", "results")
        questions["TSID's step"] = lambda: dict(zip(parts, ask_tsid(), strict=True))
    found = by_turns(questions, rounds)
    sums = {name: sum(each.values()) for name, each in found.items()}
    for name, stages in found.items():
        listed = "" if len(stages) == 1 else ", ".join(f"{k} {t:.1f}" for k, t in stages.items())
        print(f"{name:20}{sum(stages.values()):8.1f} us   {listed}")
    step = sums["step, daqp"]
    for name in ("Pinocchio's terms", "TSID's step"):
        if name in sums:
            print(f"step / {name}: {step / sums[name]:.2f}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000, help="in a block")
    parser.add_argument("--rounds", type=int, default=15, help="of blocks by turns")
    parser.add_argument("--tsid", action="store_true", help="beside TSID 1.7.1")
    options = parser.parse_args()
    given = record(options.steps)
    limited = (A_MAX - np.abs(given["a"]) < 1e-6).any(axis=1).mean()
    print(f"{load()}; in {limited:.0%} of the steps a joint is at its acceleration limit")
    if not options.tsid:
        measure(given, options.rounds)
        return
    asked = given | problem(DT, **GAINS) | {"frame": FRAME, "steps_per_goal": STEPS_PER_GOAL}
    with worker(TSID, asked, "step", "tsid") as (found, ask):
        compare_values(given, found)
        measure(given, options.rounds, ask)


if __name__ == "__main__":
    main()
