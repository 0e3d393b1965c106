# SPDX-License-Identifier: Apache-2.0
"""A simulated arm that holds its hand still with null-space compliance, for tests."""

import numpy as np
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.nullspace import NullspaceCompliance, fast_weight

DT = 2e-3


def unlimited(n, **changes) -> IntegralSettings:
    return IntegralSettings(np.full(n, np.inf), **changes)


def energy(compliance, M) -> float:
    """What the memory stores, J."""
    a, x = compliance.memory.a, compliance.memory.root / np.sqrt(np.diag(M))
    weight = fast_weight(compliance.settings)
    return 0.5 * (a @ M @ a + weight * x @ (np.diag(M) * x))


class ComplianceRun:
    """An arm with friction and heavy rotors that holds its hand still; `push` is on its elbow."""

    def __init__(self, robot="talos", rows=6, q=None, **reference):
        self.arm = TaskArm(robot, rows, armature=0.15)
        self.q = self.arm.posture.copy() if q is None else np.array(q, dtype=float)
        self.v = np.zeros(self.arm.n)
        self.hand = self.arm.hand(self.q)
        self.reference = reference
        self.a_ref = np.zeros(self.arm.n)
        self.terms = self.arm.terms(self.q, self.v)
        self.errors, self.torques, self.positions = [], [], []

    @property
    def now(self) -> ArmTerms:
        return arm_terms(self.terms, self.v)

    def arguments(self):
        return self.now, self.a_ref, DT

    def move(self, added, disturbance=0.0, push=None, a_ref=None):
        """Hold the model's and the added torque for a control period."""
        t, error = self.terms, np.zeros(6)
        if a_ref is None:
            a_ref, error = self.arm.reference(self.q, self.v, t, self.hand, **self.reference)
        self.a_ref = a_ref
        tau = t.M @ self.a_ref + t.h + added + disturbance
        if push is not None:
            tau = tau + self.arm.push(self.q, np.array(push))
        self.q, self.v = self.arm.move(self.q, self.v, tau, DT, friction=2.0)
        self.terms = self.arm.terms(self.q, self.v)
        self.errors.append(error)
        self.torques.append(added)
        self.positions.append(self.q)

    def go(self, compliance, duration, **others):
        for _ in range(round(duration / DT)):
            self.move(compliance.torque(*self.arguments()), **others)
        return self


def started(run, settings, m=6) -> NullspaceCompliance:
    """Without any memory, at the state of an arm."""
    compliance = NullspaceCompliance(settings, m)
    compliance.reset(run.now)
    return compliance


def hand_errors(run):
    return np.linalg.norm(np.array(run.errors)[:, :3], axis=1)
