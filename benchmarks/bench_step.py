# SPDX-License-Identifier: Apache-2.0
"""One controller step: by each solver, beside Pinocchio's terms; or by stages, beside TSID's step.

Panda follows poses and postures at random within its limits of position, speed, acceleration and
torque, so that limits are active. The same states are answered once more, by turns; times are of
the processor, medians of the blocks. With ``--stages`` TSID gets the same tasks, weights, limits
and states, once for poses and once for postures only; values are compared first. Each stage is
timed without those inside of it, in a turn of its own; what none of them has is Python between.
Times are then medians over the steps. TSID has an environment of its own, made when missing.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio as pin
from live_robot import load
from other_environment import TSID, Arrays, worker
from panda import A_MAX, FRAME, JOINTS, TAU_MAX, limits_of, make_controller, problem

from torque_safety_controller.limiter import TorqueLimiter
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import SOLVERS, AccelerationRange, InverseDynamicsQP
from torque_safety_controller.robot_model import FrameModel, RobotModel
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
        tasks: list[Task] = [PostureTask(self.q_des, *posture)]
        if self.pose_des is not None:
            pose = gains.pose_kp, gains.pose_kd, gains.pose_weight
            tasks.append(PoseTask(self.pose_des, *pose, separate=True))
        return tasks


class Ours:
    """This project's bounds and controller, without ROS.

    Args:
        solver: of the QP.
        as_tsid: with TSID's tasks, its weight of the accelerations, and torques of the instant
            rather than of the middle of the step.
        weight: greatest of the tasks, which that of the accelerations is relative to.
    """

    def __init__(
        self, solver: str = "daqp", *, as_tsid: bool = False, weight: float = 1.0
    ) -> None:
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
            self.controller._qp = InverseDynamicsQP(self.model.nv, REGULARISATION / weight)

    def set_goal(self, posture: np.ndarray, pose: np.ndarray) -> None:
        """Set goals: positions, shape (7,), rotation and translation, shape (3, 4), or NaN."""
        if not np.isnan(pose).any():
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

    def typical(self, given: Arrays) -> float:
        """Answer all states; return microseconds of a step, the median."""
        times = np.empty(len(given["q"]))
        for k, (q, v) in enumerate(zip(given["q"], given["v"], strict=True)):
            if k % STEPS_PER_GOAL == 0:
                self.set_goal(given["posture"][k], given["pose"][k])
            begin = time.perf_counter_ns()
            self.step(q, v)
            times[k] = time.perf_counter_ns() - begin
        return 1e-3 * float(np.median(times))


def record(steps: int, *, poses: bool = True) -> Arrays:
    """Move the arm; return states, goals, bounds, accelerations and torques."""
    weight = 1.0 if poses else GAINS["posture_weight"]
    ours, rng = Ours(as_tsid=True, weight=weight), np.random.default_rng(0)
    model, data = ours.model, ours.model.createData()
    q, v = 0.5 * (ours.low + ours.high), np.zeros(model.nv)
    names = ("q", "v", "pose", "posture", "bounds", "a", "tau")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for step in range(steps):
        if step % STEPS_PER_GOAL == 0:
            posture = rng.uniform(ours.low, ours.high)
            pin.framesForwardKinematics(model, data, posture)
            goal = data.oMf[model.getFrameId(FRAME)]
            pose = np.c_[goal.rotation, goal.translation] * (1.0 if poses else np.nan)
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


PINOCCHIO = (
    *("crba", "nonLinearEffects", "rnea", "forwardKinematics", "computeJointJacobians"),
    *("updateFramePlacement", "getFrameJacobian", "getFrameAcceleration", "SE3ToXYZQUAT"),
)
STAGES: dict[str, list[tuple[Any, str]]] = {
    "bounds": [(BoundsSolver, "bounds")],
    "Pinocchio": [(pin, name) for name in PINOCCHIO],
    "model": [(RobotModel, "update"), (FrameModel, "_read")],
    "tasks": [(PoseTask, "term"), (PostureTask, "term")],
    "QP": [(InverseDynamicsQP, "solve")],
    "torque": [(RobotModel, "torque"), (TorqueLimiter, "limited")],
    "parts": [(Goals, "prepare"), (JointBounds, "prepare")],
}
"""Functions by stage."""


class Staged(Ours):
    """A controller whose stages are timed."""

    def __init__(self) -> None:
        self._now, self._inside = dict.fromkeys(STAGES, 0), 0
        with self._watched():  # the controller keeps methods of its parts
            super().__init__()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Let all functions of all stages be timed for a while."""
        with ExitStack() as stack:
            for stage, functions in STAGES.items():
                for owner, name in functions:
                    timed = self._timed(stage, getattr(owner, name))
                    stack.enter_context(patch.object(owner, name, timed))
            yield

    def _timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that adds its time, without that of stages inside, to its stage."""

        def timed(*arguments: Any) -> Any:
            before, self._inside = self._inside, 0
            begin = time.perf_counter_ns()
            try:
                return function(*arguments)
            finally:
                whole = time.perf_counter_ns() - begin
                self._now[stage] += whole - self._inside
                self._inside = before + whole

        return timed

    def stages(self, given: Arrays) -> dict[str, float]:
        """Answer all states; return microseconds of a step by stage, medians."""
        times = np.empty((len(given["q"]), len(STAGES)))
        with self._watched():
            for k, (q, v) in enumerate(zip(given["q"], given["v"], strict=True)):
                if k % STEPS_PER_GOAL == 0:
                    self.set_goal(given["posture"][k], given["pose"][k])
                self._now = dict.fromkeys(STAGES, 0)
                self.step(q, v)
                times[k] = list(self._now.values())
        medians = 1e-3 * np.median(times, axis=0)
        return dict(zip(STAGES, medians.tolist(), strict=True))


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


def measure(given: Arrays, rounds: int) -> None:
    """Time each solver and Pinocchio's terms by turns, and print."""
    arms = {solver: Ours(solver) for solver in SOLVERS}
    model = arms["daqp"].model
    questions: dict[str, Callable[[], dict[str, float]]] = {
        f"step, {solver}": lambda arm=arm: {"whole": arm.block(given)}
        for solver, arm in arms.items()
    }
    questions["Pinocchio's terms"] = lambda: {"whole": model_terms(model, given)}
    found = by_turns(questions, rounds)
    for name, each in found.items():
        print(f"{name:20}{each['whole']:8.1f} us")
    ratio = found["step, daqp"]["whole"] / found["Pinocchio's terms"]["whole"]
    print(f"step / Pinocchio's terms: {ratio:.2f}")


def measure_stages(given: Arrays, rounds: int) -> dict[str, float]:
    """Compare values with TSID's; return microseconds by stage, ours and TSID's, by turns."""
    asked = given | problem(DT, **GAINS) | {"steps_per_goal": STEPS_PER_GOAL}
    if not np.isnan(given["pose"]).any():
        asked["frame"] = FRAME
    with worker(TSID, asked, "step", "tsid") as (answers, ask):
        compare_values(given, answers)
        plain, staged = Ours(), Staged()
        parts = ("TSID: problem, bounds", "TSID: QP solved", "TSID: results", "TSID")
        found = by_turns(
            {
                "step": lambda: {"step": plain.typical(given)},
                "stages": lambda: staged.stages(given),
                "TSID": lambda: dict(zip(parts, ask(), strict=True)),
            },
            rounds,
        )
    stages, step = found["stages"], found["step"]["step"]
    between = {"Python between": step - sum(stages.values()), "step": step}
    ratio = {"step / TSID": step / found["TSID"]["TSID"]}
    return stages | between | found["TSID"] | ratio


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000, help="in a block")
    parser.add_argument("--rounds", type=int, default=15, help="of blocks by turns")
    parser.add_argument("--stages", action="store_true", help="by stage, beside TSID 1.7.1")
    options = parser.parse_args()
    given = record(options.steps)
    limited = (A_MAX - np.abs(given["a"]) < 1e-6).any(axis=1).mean()
    print(f"{load()}; in {limited:.0%} of the steps a joint is at its acceleration limit")
    if not options.stages:
        measure(given, options.rounds)
        return
    pose = measure_stages(given, options.rounds)
    posture = measure_stages(record(options.steps, poses=False), options.rounds)
    print(f"\n| {'us':22} | pose | posture |\n|---|---|---|")
    for name, time_ in pose.items():
        print(f"| {name:22} | {time_:.1f} | {posture[name]:.1f} |")


if __name__ == "__main__":
    main()
