# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance: what a step costs, and with --motion what its forms do.

The arm is that of ``config/talos_left_arm.yaml``: 9 joints, a hand of 6 rows. With cold caches
means that other data has been read since the last call, as in a control loop.

With --motion the hand draws a circle of 20 cm in 2 s while the elbow is pushed for 10 s, against
viscous friction that the controller does not know of, and without joint limits, so that the arm
passes close to singularities.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import yaml

from torque_safety_controller.integral_feedback import ArmTerms, IntegralSettings
from torque_safety_controller.linalg.generalized_inverse import (
    THRESHOLD,
    dynamically_consistent_inverse,
)
from torque_safety_controller.nullspace.compliance import NullspaceCompliance
from viability_bounds_pkg.robot_description import build_model, read_urdf

ROOT = Path(__file__).resolve().parent.parent
STEPS = 300
ROUNDS = 30
DT = 1e-3
CACHE = 8_000_000  # numbers; more than the last-level cache holds


class NullspaceArm:
    """Torso and arm of TALOS."""

    def __init__(self) -> None:
        content = yaml.safe_load((ROOT / "config" / "talos_left_arm.yaml").read_text())
        values = {k: v for part in content.values() for k, v in part["ros__parameters"].items()}
        self.model = build_model(read_urdf(values["robot_description"]), values["joints"])
        self.model.armature = np.array(values["rotor_inertia"])
        self.n = self.model.nv
        self.q = np.array(values["start_positions"])
        self.data = self.model.createData()
        self.hand = self.model.getFrameId(values["end_effector_frame"])
        self.elbow = self.model.getJointId("arm_left_4_joint")

    def terms(self, q: np.ndarray, v: np.ndarray) -> ArmTerms:
        """Return M, C, J, J' and v."""
        M = pin.crba(self.model, self.data, q).copy()
        C = pin.computeCoriolisMatrix(self.model, self.data, q, v).copy()
        pin.computeJointJacobiansTimeVariation(self.model, self.data, q, v)
        pin.updateFramePlacement(self.model, self.data, self.hand)
        J = pin.getFrameJacobian(self.model, self.data, self.hand, pin.LOCAL)
        J_dot = pin.getFrameJacobianTimeVariation(self.model, self.data, self.hand, pin.LOCAL)
        return ArmTerms(*(np.ascontiguousarray(x) for x in (M, C, J, J_dot, v)))


def measure(name: str, function, arguments, flush: np.ndarray) -> None:
    """Time a function over many arguments on end and once with cold caches, and print."""
    times, alone = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for each in arguments:
            function(*each)
        times.append((time.perf_counter() - start) / len(arguments))
        flush += 1.0
        start = time.perf_counter()
        function(*arguments[0])
        alone.append(time.perf_counter() - start)
    print(
        f"{name:<42} {1e6 * statistics.median(times):6.1f} us per call "
        f"(best {1e6 * min(times):.1f}), {1e6 * statistics.median(alone):.1f} us with cold caches"
    )


def cost() -> None:
    """Measure steps along a motion."""
    arm, flush = NullspaceArm(), np.zeros(CACHE)
    arguments = []
    for k in range(STEPS):
        wave = 0.3 * np.sin(2.0 * k * DT + np.arange(arm.n))
        v = 0.6 * np.cos(2.0 * k * DT + np.arange(arm.n))
        arguments.append((arm.terms(arm.q + wave, v), v + 0.3, DT))
    inverses = [(x.J, x.J_dot, x.M, x.C + x.C.T, THRESHOLD) for x, *_ in arguments]
    measure("consistent inverse and derivative", dynamically_consistent_inverse, inverses, flush)
    wide, tight = np.full(arm.n, np.inf), np.full(arm.n, 1e-3)
    for name, rows, budget in (
        ("step, 6 rows", 6, wide),
        ("step, 3 rows", 3, wide),
        ("step, 6 rows, torque limited", 6, tight),
    ):
        compliance = NullspaceCompliance(IntegralSettings(budget), rows)
        cut = [
            (x._replace(J=x.J[:rows].copy(), J_dot=x.J_dot[:rows].copy()), *rest)
            for x, *rest in arguments
        ]
        measure(name, compliance.torque, cut, flush)


def motion(force: float, budget: float) -> np.ndarray:
    """Return error of the hand, m, largest torque, N m, and size of the memory of each step."""
    arm = NullspaceArm()
    model, data, n = arm.model, arm.data, arm.n
    compliance = NullspaceCompliance(IntegralSettings(np.full(n, budget)), 6)
    q, v, a_ref = np.array([0, 0.1, 0.4, 0.5, -0.3, -1.5, 0.2, 0.1, 0.1]), np.zeros(n), np.zeros(n)
    pin.framesForwardKinematics(model, data, q)
    start, rate = data.oMf[arm.hand].copy(), np.pi
    rows = []
    for t in np.arange(0.0, 15.0, DT):
        terms = arm.terms(q, v)
        J, J_dot = terms.J, terms.J_dot
        added = compliance.torque(terms, a_ref, DT)
        place, radius, phase = start.copy(), 0.1 * min(t, 1.0), rate * t
        place.translation += radius * np.array([0.0, np.sin(phase), 1.0 - np.cos(phase)])
        pin.framesForwardKinematics(model, data, q)
        hand = data.oMf[arm.hand]
        error = pin.log6(hand.actInv(place)).vector
        v_hand, a_hand = np.zeros(6), np.zeros(6)
        along = np.array([0.0, np.cos(phase), np.sin(phase)])
        inward = np.array([0.0, -np.sin(phase), np.cos(phase)])
        v_hand[:3] = hand.rotation.T @ (radius * rate * along)
        a_hand[:3] = hand.rotation.T @ (radius * rate**2 * inward)
        wanted = a_hand + 900.0 * error + 50.0 * (v_hand - J @ v) - J_dot @ v
        damped = J.T @ np.linalg.inv(J @ J.T + 1e-6 * np.eye(6))
        a_ref = -5.0 * v + damped @ (wanted + 5.0 * J @ v)
        tau = pin.rnea(model, data, q, v, a_ref) + added - 2.0 * v
        if 2.0 < t < 12.0:
            pin.computeJointJacobians(model, data, q)
            lever = pin.getJointJacobian(model, data, arm.elbow, pin.LOCAL_WORLD_ALIGNED)
            tau += lever[:3].T @ np.array([0.0, force, 0.0])
        v = v + DT * pin.aba(model, data, q, v, tau)
        q = q + DT * v
        memory = np.abs(compliance.memory.a).max()
        rows.append((np.linalg.norm(error[:3]), np.abs(added).max(), memory))
    return np.array(rows)


def compare() -> None:
    """Run the same pushes without and with a budget and print what became of them."""
    print("budget       push   hand error   largest torque   memory")
    for budget in (np.inf, 10.0):
        for force in (-40.0, 0.0, 40.0):
            error, torque, memory = motion(force, budget)[2000:].max(axis=0)
            print(
                f"{budget:4.0f} N m {force:6.0f} N {1e3 * error:8.1f} mm {torque:12.1f} N m "
                f"{memory:9.1f}"
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motion", action="store_true", help="simulate too; takes minutes")
    options = parser.parse_args()
    cost()
    if options.motion:
        compare()


if __name__ == "__main__":
    main()
