# SPDX-License-Identifier: Apache-2.0
"""A rival's side of `peer_limits.py`: runs in an interpreter of its own.

``python peer_rollout_worker.py INPUT.npz OUTPUT.npz NAME`` drives an arm from goal to goal by the
torques of `NAME`, ``tsid`` or ``placo``, and writes what came of it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin
from peer_rollout import drive


class Tsid:
    """Posture task in TSID, with its bounds of positions, speeds, accelerations and torques."""

    def __init__(self, urdf: str, given: dict[str, np.ndarray]) -> None:
        from tsid import tsid_pywrap as tsid

        self._tsid, model, n = tsid, pin.buildModelFromUrdf(urdf), len(given["start"])
        self._robot = tsid.RobotWrapper(model, tsid.RootJointType.FIXED_BASE_SYSTEM, False)
        self._problem = tsid.InverseDynamicsFormulationAccForce("problem", self._robot, False)
        self._problem.computeProblemData(0.0, pin.neutral(model), np.zeros(n))
        self._posture = tsid.TaskJointPosture("posture", self._robot)
        self._posture.setKp(np.full(n, given["kp"]))
        self._posture.setKd(np.full(n, given["kd"]))
        # The constructor doubles the step, which is the paper's way to avoid chatter.
        bounds = tsid.TaskJointPosVelAccBounds("bounds", self._robot, float(given["dt"]), False)
        bounds.setPositionBounds(given["low"], given["high"])
        bounds.setVelocityBounds(np.full(n, given["v_max"]))
        bounds.setAccelerationBounds(np.full(n, given["a_max"]))
        torques = tsid.TaskActuationBounds("torques", self._robot)
        torques.setBounds(-given["tau_max"], given["tau_max"])
        self._kept = bounds, torques  # the problem refers to them without keeping them
        self._problem.addMotionTask(self._posture, 1.0, 1, 0.0)
        self._problem.addMotionTask(bounds, 1.0, 0, 0.0)
        self._problem.addActuationTask(torques, 1.0, 0, 0.0)
        self._solver = tsid.SolverHQuadProgFast("solver")
        self._solver.resize(self._problem.nVar, self._problem.nEq, self._problem.nIn)

    def set_goal(self, q_des: np.ndarray) -> None:
        """Set the posture to reach."""
        goal = self._tsid.TrajectoryEuclidianConstant("goal", q_des)
        self._posture.setReference(goal.computeNext())

    def torque(self, q: np.ndarray, v: np.ndarray) -> np.ndarray | None:
        """Return the torque to apply, shape (n,), N m, or None without a solution."""
        solution = self._solver.solve(self._problem.computeProblemData(0.0, q, v))
        return self._problem.getActuatorForces(solution) if solution.status == 0 else None


class Placo:
    """Joints' task in placo, with its limits of positions, speeds and torques."""

    def __init__(self, urdf: str, given: dict[str, np.ndarray]) -> None:
        import placo

        self._robot = placo.RobotWrapper(urdf)
        self._names = [str(name) for name in given["joints"]]
        for name, low, high in zip(self._names, given["low"], given["high"], strict=True):
            self._robot.set_joint_limits(name, float(low), float(high))
        self._robot.set_velocity_limits(float(given["v_max"]))
        self._solver = placo.DynamicsSolver(self._robot)
        self._solver.mask_fbase(True)
        self._solver.dt = float(given["dt"])
        self._task = self._solver.add_joints_task()
        self._task.configure("joints", "soft", 1.0)
        self._task.kp, self._task.kd = float(given["kp"]), float(given["kd"])
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


def main() -> None:
    """Drive the arm and write what came of it."""
    source, target, name = sys.argv[1:]
    with np.load(source) as content:
        given = dict(content)
    with tempfile.TemporaryDirectory() as directory:
        urdf = Path(directory) / "arm.urdf"
        urdf.write_text(str(given["urdf"]))
        arm = {"tsid": Tsid, "placo": Placo}[name](str(urdf), given)
        model = pin.buildModelFromUrdf(str(urdf))
    np.savez(target, **drive(arm, model, given))
    print("ready", flush=True)


if __name__ == "__main__":
    main()
