# SPDX-License-Identifier: Apache-2.0
"""TSID's side of `bench_peers.py`: runs in an interpreter of its own.

``python tsid_step_worker.py INPUT.npz OUTPUT.npz URDF FRAME JOINT...`` solves the given states,
writes accelerations and torques, NaN where there is no solution, and then times all of them for
each line on standard input.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import pinocchio as pin
from tsid import tsid_pywrap as tsid


class Tsid:
    """Pose, posture and limits in TSID, all others joints locked."""

    def __init__(self, given, urdf: str, frame: str, joints: list[str]) -> None:
        whole = pin.buildModelFromUrdf(urdf)
        locked = [i for i, name in enumerate(whole.names) if i and name not in joints]
        model = pin.buildReducedModel(whole, locked, pin.neutral(whole))
        n = model.nv
        v_max, a_max, dt = given["limits"]
        kp, kd, posture_kp, posture_kd, posture_weight = given["gains"]
        self.robot = tsid.RobotWrapper(model, tsid.RootJointType.FIXED_BASE_SYSTEM, False)
        self.problem = tsid.InverseDynamicsFormulationAccForce("problem", self.robot, False)
        self.problem.computeProblemData(0.0, pin.neutral(model), np.zeros(n))
        self.pose = tsid.TaskSE3Equality("pose", self.robot, frame)
        self.pose.setKp(np.full(6, kp))
        self.pose.setKd(np.full(6, kd))
        self.pose.useLocalFrame(True)
        self.posture = tsid.TaskJointPosture("posture", self.robot)
        self.posture.setKp(np.full(n, posture_kp))
        self.posture.setKd(np.full(n, posture_kd))
        # The constructor doubles the step that it is given.
        self.bounds = tsid.TaskJointPosVelAccBounds("bounds", self.robot, 0.5 * dt, False)
        self.bounds.setPositionBounds(model.lowerPositionLimit, model.upperPositionLimit)
        self.bounds.setVelocityBounds(np.full(n, v_max))
        self.bounds.setAccelerationBounds(np.full(n, a_max))
        self.torques = tsid.TaskActuationBounds("torques", self.robot)
        self.torques.setBounds(-given["tau_max"], given["tau_max"])
        self.problem.addMotionTask(self.pose, 1.0, 1, 0.0)
        self.problem.addMotionTask(self.posture, float(posture_weight), 1, 0.0)
        self.problem.addMotionTask(self.bounds, 1.0, 0, 0.0)
        self.problem.addActuationTask(self.torques, 1.0, 0, 0.0)
        self.solver = tsid.SolverHQuadProgFast("solver")
        self.solver.resize(self.problem.nVar, self.problem.nEq, self.problem.nIn)

    def set_goal(self, pose: np.ndarray, posture: np.ndarray) -> None:
        """Set goals: rotation and translation, shape (3, 4), and positions."""
        goal = tsid.TrajectorySE3Constant("goal", pin.SE3(pose[:, :3], pose[:, 3]))
        self.pose.setReference(goal.computeNext())
        self.posture.setReference(tsid.TrajectoryEuclidianConstant("goal", posture).computeNext())

    def step(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return accelerations and torques, or None."""
        solution = self.solver.solve(self.problem.computeProblemData(0.0, q, v))
        if solution.status != 0:
            return None
        return self.problem.getAccelerations(solution), self.problem.getActuatorForces(solution)


def time_all(arm: Tsid, given: dict[str, np.ndarray], every: int) -> tuple[float, ...]:
    """Return microseconds of the processor of a step, and of its parts, in a second go."""
    q, v, clock = list(given["q"]), list(given["v"]), time.thread_time
    begin = clock()
    for i in range(len(q)):
        if i % every == 0:
            arm.set_goal(given["pose"][i], given["posture"][i])
        arm.step(q[i], v[i])
    whole, parts = clock() - begin, np.zeros(3)
    for i in range(len(q)):
        if i % every == 0:
            arm.set_goal(given["pose"][i], given["posture"][i])
        first = clock()
        data = arm.problem.computeProblemData(0.0, q[i], v[i])
        second = clock()
        solution = arm.solver.solve(data)
        third = clock()
        arm.problem.getAccelerations(solution), arm.problem.getActuatorForces(solution)
        parts += second - first, third - second, clock() - third
    return tuple(1e6 * seconds / len(q) for seconds in (whole, *parts))


def main() -> None:
    """Solve, then time for as long as asked to."""
    source, target, urdf, frame, *joints = sys.argv[1:]
    with np.load(source) as content:
        given = dict(content)
    arm, every = Tsid(given, urdf, frame, joints), int(given["steps_per_goal"])
    a, tau, lower, upper = np.full((4, *given["q"].shape), np.nan)
    for i, (q, v) in enumerate(zip(given["q"], given["v"], strict=True)):
        if i % every == 0:
            arm.set_goal(given["pose"][i], given["posture"][i])
        if (found := arm.step(q, v)) is not None:
            a[i], tau[i] = found
        bounds = arm.bounds.getConstraint()
        lower[i], upper[i] = bounds.lowerBound, bounds.upperBound
    np.savez(target, a=a, tau=tau, bounds=np.stack([lower, upper], axis=1))
    print("ready", flush=True)
    for _ in sys.stdin:
        print(*time_all(arm, given, every), flush=True)


if __name__ == "__main__":
    main()
