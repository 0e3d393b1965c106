# SPDX-License-Identifier: Apache-2.0
"""This controller beside others: the limits that they keep, the times of a step, the QP's solvers.

First the limits, of TSID, placo and a clamp, as in `peer_limits`. Then the times:
Panda follows poses and postures at random within its limits of position, speed, acceleration and
torque, so that limits are active. In the same states TSID gets the same tasks, weights and limits,
and each backend the same QPs. Values are compared first, with tasks written as TSID has them, then
times in turns, with our own: of the processor, whatever else it does. TSID and the backends have
environments of their own, made when missing.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import peer_limits
import pinocchio as pin
from live_robot import load
from other_environment import TSID, Arrays, worker

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import (
    AccelerationRange,
    DaqpSolver,
    InverseDynamicsQP,
    ProxqpSolver,
    QuadraticProgram,
    Solver,
    Status,
)
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.pose_task import PoseTask
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import Task
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model, read_urdf, resolve_uri
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import BoundsSolver

BACKENDS = ("daqp", "quadprog", "proxqp", "piqp")
"""Dense ones with wheels; sparse ones take tens of times as long for problems of 7 variables."""
QPSOLVERS = (".venv-qpsolvers", ("qpsolvers==4.13.0", "daqp", "proxsuite", "quadprog", "piqp"))
URDF = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
FRAME = "panda_hand"
JOINTS = [f"panda_joint{j}" for j in range(1, 8)]
DT = 0.002
V_MAX, A_MAX = 1.5, 5.0
TAU_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
KP, KD, POSTURE_KP, POSTURE_KD, POSTURE_WEIGHT = 30.0, 11.0, 10.0, 6.3, 1e-3
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
        as_tsid: with TSID's tasks, its weight of the accelerations, and torques of the instant
            rather than of the middle of the step.
    """

    def __init__(self, *, as_tsid: bool = False) -> None:
        self.model = build_model(read_urdf(URDF), JOINTS)
        n, ones = self.model.nv, np.ones(self.model.nv)
        self.low, self.high = self.model.lowerPositionLimit, self.model.upperPositionLimit
        limits = JointLimits(
            JOINTS, self.low, self.high, V_MAX * ones, -A_MAX * ones, A_MAX * ones
        )
        self.bounds = BoundsSolver(limits, 2.0 * DT)
        gains = Gains(
            pose_kp=KP,
            pose_kd=KD,
            posture_kp=POSTURE_KP,
            posture_kd=POSTURE_KD,
            posture_weight=POSTURE_WEIGHT,
        )
        robot = RobotModel(self.model, FRAME, 0.0 if as_tsid else DT)
        goals = (TsidGoals if as_tsid else Goals)(robot.n, gains)
        self.controller = Controller(robot, [goals, JointBounds()], TAU_MAX)
        if as_tsid:
            self.controller._qp = InverseDynamicsQP(n, REGULARISATION)
        self.qp = self.controller._qp
        self.controller.reset(0.5 * (self.low + self.high))

    def set_goal(self, pose: np.ndarray, posture: np.ndarray) -> None:
        """Set goals: rotation and translation, shape (3, 4), and positions, shape (7,)."""
        self.controller.goals.set_pose(pin.SE3(pose[:, :3], pose[:, 3]))
        self.controller.goals.set_posture(posture)

    def step(self, q: np.ndarray, v: np.ndarray) -> Any:
        """Return the output for a state, bounds included."""
        lower, upper, _ = self.bounds.bounds(q, v)
        return self.controller.step(State(q, v), AccelerationRange(lower, upper))


def record(steps: int) -> tuple[Arrays, list[QuadraticProgram]]:
    """Move the arm; return states, goals, bounds, accelerations and torques, and the QPs."""
    ours, rng = Ours(as_tsid=True), np.random.default_rng(0)
    model, data = ours.model, ours.model.createData()
    programs: list[QuadraticProgram] = []
    build = ours.qp.build

    def noted(*arguments: Any) -> QuadraticProgram:
        programs.append(build(*arguments))
        return programs[-1]

    ours.qp.build = noted
    q, v = 0.5 * (ours.low + ours.high), np.zeros(model.nv)
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("q", "v", "pose", "posture", "bounds", "a", "tau")
    }
    for step in range(steps):
        if step % STEPS_PER_GOAL == 0:
            posture = rng.uniform(ours.low, ours.high)
            pin.framesForwardKinematics(model, data, posture)
            goal = data.oMf[model.getFrameId(FRAME)]
            pose = np.c_[goal.rotation, goal.translation]
            ours.set_goal(pose, posture)
        output = ours.step(q, v)
        assert output.relaxation is None and not output.failure
        bounds = np.array(ours.bounds.bounds(q, v)[:2])
        values = q, v, pose, posture, bounds, output.a, output.tau
        for name, value in zip(rows, values, strict=True):
            rows[name].append(value)
        q, v = q + DT * v + 0.5 * DT * DT * output.a, v + DT * output.a
    found = {name: np.array(values) for name, values in rows.items()}
    return found, programs


def blocks(
    ask: Callable[[], tuple[float, ...]], mine: Callable[[], tuple[float, ...]], rounds: int
) -> tuple[list[float], list[float]]:
    """Time both by turns; return the medians of what each said."""
    theirs, ours = [], []
    for _ in range(rounds):
        theirs.append(ask())
        ours.append(mine())

    def medians(times: list[tuple[float, ...]]) -> list[float]:
        return [statistics.median(part) for part in zip(*times, strict=True)]

    return medians(theirs), medians(ours)


def step_beside_tsid(given: Arrays, rounds: int) -> None:
    """Compare and print: accelerations and torques, then times."""
    problem = {
        "limits": np.array([V_MAX, A_MAX, 2.0 * DT]),
        "tau_max": TAU_MAX,
        "gains": np.array([KP, KD, POSTURE_KP, POSTURE_KD, POSTURE_WEIGHT]),
        "steps_per_goal": np.array(STEPS_PER_GOAL),
    }
    ours = Ours()
    clocks = {"bounds": 0.0, "model": 0.0, "QP built": 0.0, "QP solved": 0.0, "torque": 0.0}
    staged = Ours()
    for stage, owner, function in (
        ("bounds", staged.bounds, "bounds"),
        ("model", staged.controller.robot, "update"),
        ("QP built", staged.qp, "build"),
        ("QP solved", staged.qp, "solve"),
        ("torque", staged.controller.robot, "torque"),
    ):
        _clock(clocks, stage, owner, function)
    count = len(given["q"])
    rest: list[float] = []  # with what the clocks take

    def run(arm: Ours) -> float:
        begin = time.thread_time()
        for step in range(count):
            if step % STEPS_PER_GOAL == 0:
                arm.set_goal(given["pose"][step], given["posture"][step])
            arm.step(given["q"][step], given["v"][step])
        return 1e6 * (time.thread_time() - begin) / count

    def block() -> tuple[float, ...]:
        whole = run(ours)
        clocks.update(dict.fromkeys(clocks, 0.0))
        rest.append(run(staged) - 1e6 * sum(clocks.values()) / count)
        return whole, *(1e6 * seconds / count for seconds in clocks.values())

    words = (resolve_uri(URDF), FRAME, *JOINTS)
    with worker(TSID, "tsid_step_worker.py", given | problem, *words) as (found, ask):
        solved = ~np.isnan(found["a"]).any(axis=1)
        same = (np.abs(found["bounds"] - given["bounds"]) < 1e-6 * A_MAX).all(axis=(1, 2))
        error = np.abs(found["a"] - given["a"])[solved & same].max()
        torque = (np.abs(found["tau"] - given["tau"])[solved & same] / TAU_MAX).max()
        limited = (A_MAX - np.abs(given["a"]) < 1e-6).any(axis=1).mean()
        print(
            f"{count} steps, in {limited:.0%} a joint at its acceleration limit. TSID solves "
            f"{solved.sum()}; bounds differ in {count - same.sum()}, where a joint is at its "
            f"position limit up to {_off_limits(given)[~same].max(initial=0.0):.0e} rad; largest "
            f"difference elsewhere {error:.1e} rad/s^2 and {torque:.1e} of the torque limits"
        )
        theirs, mine = blocks(ask, block, rounds)
    stages = {"problem, with bounds": theirs[1], "QP solved": theirs[2], "results": theirs[3]}
    print(f"TSID's step {theirs[0]:.1f} us: {_listed(stages)}")
    known = dict(zip(clocks, mine[1:], strict=True))
    known["tasks and all else"] = statistics.median(rest)
    print(f"our step {mine[0]:.1f} us with bounds: {_listed(known)}")
    print(f"ours / TSID's: {mine[0] / theirs[0]:.2f}")


def _off_limits(given: Arrays) -> np.ndarray:
    """Return how far the joint nearest to a position limit is from it, rad, in each state."""
    arm = Ours()
    return np.minimum(np.abs(given["q"] - arm.low), np.abs(arm.high - given["q"])).min(axis=1)


def _clock(clocks: dict[str, float], stage: str, owner: Any, function: str) -> None:
    """Add the time in a method of an object to a stage."""
    plain = getattr(owner, function)

    def timed(*arguments: Any) -> Any:
        begin = time.thread_time()
        result = plain(*arguments)
        clocks[stage] += time.thread_time() - begin
        return result

    setattr(owner, function, timed)


def _listed(stages: dict[str, float]) -> str:
    return ", ".join(f"{name} {time_us:.1f}" for name, time_us in stages.items())


def qps_by_backends(programs: list[QuadraticProgram], rounds: int) -> None:
    """Compare and print: solutions of the recorded QPs, then times."""
    given = {
        name: np.array([getattr(program, name) for program in programs])
        for name in QuadraticProgram._fields
    }
    reference = np.array([DaqpSolver().solve(program).x for program in programs])
    solvers: dict[str, Solver] = {"daqp": DaqpSolver(), "proxqp": ProxqpSolver()}
    for name, solver in solvers.items():
        times = []
        for _ in range(rounds):
            begin = time.thread_time()
            results = [solver.solve(program) for program in programs]
            times.append(1e6 * (time.thread_time() - begin) / len(programs))
        x = np.array([r.x if r.status is Status.SOLVED else np.nan * r.x for r in results])
        _print_solver(f"ours: {name}", x - reference, times)
    for backend in BACKENDS:
        with worker(QPSOLVERS, "qpsolvers_worker.py", given, backend) as (found, ask):
            times = [ask()[0] for _ in range(rounds)]
            _print_solver(f"qpsolvers: {backend}", found["x"] - reference, times)


def _print_solver(name: str, difference: np.ndarray, times: list[float]) -> None:
    failed = np.isnan(difference[:, 0])
    print(
        f"{name:24}{statistics.median(times):8.1f} us{np.abs(difference[~failed]).max():12.1e} "
        f"rad/s^2{failed.sum():8}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=15, help="of blocks by turns")
    parser.add_argument("--goals", type=int, default=20, help="of the comparison of limits")
    options = parser.parse_args()
    print(load())
    peer_limits.compare(options.goals)
    print()
    given, programs = record(options.steps)
    step_beside_tsid(given, options.rounds)
    print(f"\n{len(programs)} QPs, a call{'':12}median, largest difference, failed")
    qps_by_backends(programs, options.rounds)


if __name__ == "__main__":
    main()
