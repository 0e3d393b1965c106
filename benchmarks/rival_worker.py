# SPDX-License-Identifier: Apache-2.0
"""What TSID and placo answer: runs in an interpreter of its own, see `other_environment.py`.

``python rival_worker.py INPUT.npz OUTPUT.npz TASK NAME`` does one of the tasks below with what
the input gives, writes what it found, and times a block for each line on standard input.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
from rollout import drive

Arrays = dict[str, np.ndarray]
Times = tuple[float, ...]


class Tsid:
    """Tasks and limits in TSID: of positions, speeds, accelerations and torques.

    Args:
        model: of the arm.
        given: limits and gains; with ``frame`` a pose task besides the posture task.
    """

    def __init__(self, model: pin.Model, given: Arrays) -> None:
        from tsid import tsid_pywrap as tsid

        self._tsid, n = tsid, model.nv
        self._robot = tsid.RobotWrapper(model, tsid.RootJointType.FIXED_BASE_SYSTEM, False)
        self.problem = tsid.InverseDynamicsFormulationAccForce("problem", self._robot, False)
        self.problem.computeProblemData(0.0, pin.neutral(model), np.zeros(n))
        if "frame" in given:
            self._pose = tsid.TaskSE3Equality("pose", self._robot, str(given["frame"]))
            self._pose.setKp(np.full(6, given["pose_kp"]))
            self._pose.setKd(np.full(6, given["pose_kd"]))
            self._pose.useLocalFrame(True)
            self.problem.addMotionTask(self._pose, 1.0, 1, 0.0)
        self._posture = tsid.TaskJointPosture("posture", self._robot)
        self._posture.setKp(np.full(n, given["posture_kp"]))
        self._posture.setKd(np.full(n, given["posture_kd"]))
        self.problem.addMotionTask(self._posture, float(given["posture_weight"]), 1, 0.0)
        # The constructor doubles the step, which is the paper's way to avoid chatter.
        self.bounds = tsid.TaskJointPosVelAccBounds(
            "bounds", self._robot, float(given["dt"]), False
        )
        self.bounds.setPositionBounds(given["low"], given["high"])
        self.bounds.setVelocityBounds(np.full(n, given["v_max"]))
        self.bounds.setAccelerationBounds(np.full(n, given["a_max"]))
        self.problem.addMotionTask(self.bounds, 1.0, 0, 0.0)
        # The problem refers to its tasks without keeping them.
        self._torques = tsid.TaskActuationBounds("torques", self._robot)
        self._torques.setBounds(-given["tau_max"], given["tau_max"])
        self.problem.addActuationTask(self._torques, 1.0, 0, 0.0)
        self.solver = tsid.SolverHQuadProgFast("solver")
        self.solver.resize(self.problem.nVar, self.problem.nEq, self.problem.nIn)

    def set_goal(self, q_des: np.ndarray, pose: np.ndarray | None = None) -> None:
        """Set the posture to reach; and the pose: rotation and translation, shape (3, 4)."""
        goal = self._tsid.TrajectoryEuclidianConstant("goal", q_des)
        self._posture.setReference(goal.computeNext())
        if pose is not None and not np.isnan(pose).any():
            place = self._tsid.TrajectorySE3Constant("goal", pin.SE3(pose[:, :3], pose[:, 3]))
            self._pose.setReference(place.computeNext())

    def torque(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return the torque to apply, shape (n,), N m, or None without a solution."""
        solution = self.solver.solve(self.problem.computeProblemData(0.0, q, v))
        return self.problem.getActuatorForces(solution) if solution.status == 0 else None


class Placo:
    """Joints' task in placo, with its limits of positions, speeds and torques."""

    def __init__(self, urdf: Path, given: Arrays) -> None:
        import placo

        self._robot = placo.RobotWrapper(str(urdf))
        self._names = [str(name) for name in given["joints"]]
        for name, low, high in zip(self._names, given["low"], given["high"], strict=True):
            self._robot.set_joint_limits(name, float(low), float(high))
        self._robot.set_velocity_limits(float(given["v_max"]))
        self._solver = placo.DynamicsSolver(self._robot)
        self._solver.mask_fbase(True)
        self._solver.dt = float(given["dt"])
        self._task = self._solver.add_joints_task()
        self._task.configure("joints", "soft", 1.0)
        self._task.kp, self._task.kd = float(given["posture_kp"]), float(given["posture_kd"])
        for name, torque in zip(self._names, given["tau_max"], strict=True):
            self._solver.set_torque_limit(name, float(torque))
            self._solver.set_qdd_safe(name, float(given["a_max"]))
        self._solver.enable_joint_limits(True)
        self._solver.enable_velocity_limits(True)
        self._solver.enable_torque_limits(True)
        self._floating = len(self._robot.state.qd) - len(self._names)

    def set_goal(self, q_des: np.ndarray) -> None:
        """Set the posture to reach."""
        self._task.set_joints(dict(zip(self._names, q_des.tolist(), strict=True)))

    def torque(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return the torque to apply, shape (n,), N m, or None without a solution."""
        for name, position, speed in zip(self._names, q.tolist(), v.tolist(), strict=True):
            self._robot.set_joint(name, position)
            self._robot.set_joint_velocity(name, speed)
        self._robot.update_kinematics()
        try:
            result = self._solver.solve(False)
        except RuntimeError:
            return None
        return np.array(result.tau)[self._floating :] if result.success else None


def roll_out(given: Arrays, name: str, urdf: Path) -> tuple[Arrays, None]:
    """Drive an arm from goal to goal."""
    model = pin.buildModelFromUrdf(str(urdf))
    arm = Tsid(model, given) if name == "tsid" else Placo(urdf, given)
    return drive(arm, model, given), None


def answer(given: Arrays, _: str, urdf: Path) -> tuple[Arrays, Callable[[], Times]]:
    """Give accelerations, torques and bounds in the given states, NaN without a solution."""
    arm = Tsid(pin.buildModelFromUrdf(str(urdf)), given)
    q, v, every = list(given["q"]), list(given["v"]), int(given["steps_per_goal"])
    a, tau, lower, upper = np.full((4, *given["q"].shape), np.nan)
    for i in range(len(q)):
        if i % every == 0:
            arm.set_goal(given["posture"][i], given["pose"][i])
        solution = arm.solver.solve(arm.problem.computeProblemData(0.0, q[i], v[i]))
        if solution.status == 0:
            a[i] = arm.problem.getAccelerations(solution)
            tau[i] = arm.problem.getActuatorForces(solution)
        bounds = arm.bounds.getConstraint()
        lower[i], upper[i] = bounds.lowerBound, bounds.upperBound

    def timed() -> Times:
        """Return microseconds of problem, solution, results and all, medians of the steps."""
        times, clock = np.empty((len(q), 4)), time.perf_counter_ns
        for i in range(len(q)):
            if i % every == 0:
                arm.set_goal(given["posture"][i], given["pose"][i])
            first = clock()
            data = arm.problem.computeProblemData(0.0, q[i], v[i])
            second = clock()
            solution = arm.solver.solve(data)
            third = clock()
            arm.problem.getAccelerations(solution), arm.problem.getActuatorForces(solution)
            last = clock()
            times[i] = second - first, third - second, last - third, last - first
        return tuple(1e-3 * np.median(times, axis=0))

    return {"a": a, "tau": tau, "bounds": np.stack([lower, upper], axis=1)}, timed


def main() -> None:
    """Do the task, then time for as long as asked to."""
    source, target, task, name = sys.argv[1:]
    with np.load(source) as content:
        given = dict(content)
    with tempfile.TemporaryDirectory() as directory:
        urdf = Path(directory) / "arm.urdf"
        urdf.write_text(str(given["urdf"]))
        work = {"rollout": roll_out, "step": answer}[task]
        found, timed = work(given, name, urdf)
    np.savez(target, **found)
    print("ready", flush=True)
    for _ in sys.stdin:
        print(*timed(), flush=True)


if __name__ == "__main__":
    main()
