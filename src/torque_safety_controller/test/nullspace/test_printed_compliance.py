# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance as printed, beside the equations written down once more.

Nothing of the controller is used for what is expected: inverses and rates by NumPy and by
differences along the motion, (11) by ProxQP.
"""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from compliance_run import DT, ComplianceRun, unlimited
from proxsuite import proxqp
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.nullspace.compliance import NullspaceCompliance, PrintedCompliance

STEP = 1e-3  # s
SMALL = 1e-5  # s; of differences
LAMBDA, MU, SLOW, FAST = 7.0, 0.3, 0.4, 60.0


class Motion:
    """An arm on a given motion, and what (16) to (26) say of it."""

    def __init__(self, robot, rows, limit, limited, mass):
        self.arm = TaskArm(robot, rows, armature=0.1)
        self.limit, self.limited, self.mass = limit, limited, mass
        self.s = self.a = self.slow = self.fast = np.zeros(self.arm.n)
        self.integral = np.zeros(rows)
        self.binding = 0

    def q(self, t):
        k = np.arange(self.arm.n)
        return self.arm.posture + 0.3 * np.sin(2.0 * t + k)

    def v(self, t):
        return 0.6 * np.cos(2.0 * t + np.arange(self.arm.n))

    def a_ref(self, t):
        return 4.0 * np.cos(5.0 * t + 2.0 * np.arange(self.arm.n))

    def M(self, t):
        upper = np.triu(pin.crba(self.arm.model, self.arm.model.createData(), self.q(t)))
        return upper + np.triu(upper, 1).T

    def J(self, t):
        return self.arm.terms(self.q(t), self.v(t)).J

    def inverse(self, t):
        """J^+, dynamically consistent."""
        M_inv_JT = np.linalg.solve(self.M(t), self.J(t).T)
        return M_inv_JT @ np.linalg.inv(self.J(t) @ M_inv_JT)

    @staticmethod
    def rate(f, t):
        return (f(t + SMALL) - f(t - SMALL)) / (2.0 * SMALL)

    def expected(self, t):
        """Return the torque of the step that ends at t."""
        arm, dt = self.arm, STEP
        C = pin.computeCoriolisMatrix(arm.model, arm.model.createData(), self.q(t), self.v(t))
        M, J, J_plus = self.M(t), self.J(t), self.inverse(t)
        K = LAMBDA * (M if self.mass else np.diag(np.diag(M)))
        s_last, a_last = self.s, self.a
        self.s = s_last + self.a_ref(t - dt) * dt - (self.v(t) - self.v(t - dt))
        middle = 0.5 * (s_last + self.s)
        self.integral = self.integral + dt * self.rate(self.J, t - 0.5 * dt) @ middle
        self.a = self.s - J_plus @ self.integral  # (16)
        self.slow = np.exp(-SLOW * dt) * self.slow + self.a - a_last  # (13)
        self.fast = np.exp(-FAST * dt) * self.fast + self.a - a_last
        P = J_plus @ J
        u_K = (1.0 - MU) * P.T @ K @ P @ self.slow + MU * K @ self.fast  # (26)
        feedforward = C @ self.a - M @ J_plus @ self.rate(self.J, t) @ self.s
        feedforward -= M @ self.rate(self.inverse, t) @ self.integral
        return feedforward + self.limited(self, u_K)  # (21)


def free(motion, u):
    return u


def factor(u, limit):
    """(10)."""
    return min(1.0, (limit / np.abs(u)).min())


def scaled(motion, u):
    return factor(u, motion.limit) * u


def solved(motion, u):
    """(11), with a for s: what u takes energy out of."""
    n, a, limit = len(u), motion.a / np.abs(motion.a).max(), motion.limit
    qp = proxqp.dense.QP(n, 0, n + 1)
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-11, 0.0
    lower = np.r_[-limit, factor(u, limit) * a @ u]
    qp.init(np.eye(n), -u, None, None, np.vstack([np.eye(n), a]), lower, np.r_[limit, np.inf])
    qp.solve()
    motion.binding += np.abs(qp.results.x - np.clip(u, -limit, limit)).max() > 1e-3
    return qp.results.x


LIMITED = {"none": free, "scaling": scaled, "paper": solved, "paper_mass": solved}


@pytest.mark.parametrize("method", LIMITED)
@pytest.mark.parametrize(("robot", "rows"), [("panda", 6), ("panda", 3), ("talos", 6)])
def test_it_is_what_the_paper_prints(method, robot, rows):
    """What differs is J' in the middle of a step: less than 1e-4 of the torque."""
    n = TaskArm(robot, rows).n
    limit = np.where(np.arange(n) % 3 == 0, 0.02, 1.0)
    motion = Motion(robot, rows, limit, LIMITED[method], method == "paper_mass")
    budget = np.full(n, np.inf) if method == "none" else limit
    compliance = PrintedCompliance(IntegralSettings(budget, LAMBDA, SLOW, FAST, MU, method), rows)

    def terms(t):
        return arm_terms(motion.arm.terms(motion.q(t), motion.v(t)), motion.v(t))

    compliance.reset(terms(0.0))
    limited = 0
    for k in range(1, 300):
        t = k * STEP
        expected = motion.expected(t)
        found = compliance.torque(terms(t), motion.a_ref(t - STEP), STEP)
        np.testing.assert_allclose(found, expected, atol=1e-4 * max(1.0, np.abs(expected).max()))
        limited += compliance.saturated.any()
    assert (limited > 100) == (method != "none")
    # Its second condition is rarely felt; here it is throughout.
    if method == "paper":
        assert (motion.binding > 200) == ((robot, rows) == ("panda", 3))


def test_energy_falls_at_the_rate_of_the_paper_s_proof():
    """(23), (24): without leaks V = a'Ma / 2 falls by a'u_K."""
    offs = []
    for dt in (1e-3, 5e-4):
        arm = TaskArm("panda", 6)
        law = unlimited(7, slow_leak_rate=0.0, fast_leak_rate=0.0, anti_windup="none")
        compliance = PrintedCompliance(law, 6)
        q, v = arm.posture.copy(), 0.5 * np.cos(np.arange(7))
        now = arm.terms(q, v)
        compliance.initialise(np.diag(now.M) * np.cos(2.0 * np.arange(7)), arm_terms(now, v))
        compliance.memory.fast[:] = compliance.memory.a  # which it is without leaks
        energies, off, expected, power, a_ref, elapsed = [], 0.0, 0.0, 0.0, v, 0.0
        for k in range(round(0.2 / dt)):
            added = compliance.torque(arm_terms(now, v), a_ref, elapsed)
            a = compliance.memory.a
            K = 2.0 * np.diag(now.M)
            J_plus = np.linalg.solve(now.M, now.J.T)
            J_plus = J_plus @ np.linalg.inv(now.J @ J_plus)
            Pa = J_plus @ now.J @ a
            last, power = power, -0.5 * Pa @ (K * Pa) - 0.5 * a @ (K * a)
            energies.append(0.5 * a @ now.M @ a)
            expected = energies[0] if k == 0 else expected + 0.5 * dt * (last + power)
            off = max(off, abs(energies[-1] - expected))
            a_ref = 40.0 * (arm.posture - q) - 10.0 * v + 3.0 * np.sin(3.0 * k * dt + np.arange(7))
            q, v = arm.move(q, v, now.M @ a_ref + now.h + added, dt)
            now, elapsed = arm.terms(q, v), dt
        assert (np.diff(energies) < 0.0).all()
        assert off < 0.005 * energies[0]
        offs.append(off)
    assert offs[1] < 0.6 * offs[0]


@pytest.mark.parametrize("method", LIMITED)
def test_a_torque_is_taken_over_as_far_as_the_task_feels_it(method):
    """And one within the range of the task's inverse goes on, budgets widened."""
    run = ComplianceRun("panda")
    compliance = PrintedCompliance(replace(unlimited(7), anti_windup=method), 6)
    compliance.settings = replace(compliance.settings, budget=np.full(7, 0.01))
    torque = run.terms.J.T @ np.array([3.0, -2.0, 4.0, 0.3, 0.1, -0.2])
    np.testing.assert_allclose(compliance.initialise(torque, run.now), torque, rtol=1e-9)
    after = compliance.torque(run.now, np.zeros(7), DT)
    np.testing.assert_allclose(after, torque, rtol=0.01)


@pytest.mark.parametrize("rate", [0.1, 5.0, 100.0])
def test_what_is_in_the_null_space_is_forgotten_at_its_own_rate(rate):
    """theta_null of `NullspaceCompliance`, at rest and without gains to speak of."""
    run = ComplianceRun("panda")
    compliance = NullspaceCompliance(unlimited(7, gain=1e-9, null_leak_rate=rate), 6)
    compliance.reset(run.now)
    J = run.terms.J
    null = np.linalg.svd(J)[2][6]
    compliance.memory.a[:] = compliance.memory.s[:] = null
    for _ in range(50):
        compliance.torque(run.now, np.zeros(7), DT)
    assert np.abs(J @ compliance.memory.a).max() < 1e-9
    assert compliance.memory.a @ null == pytest.approx(np.exp(-rate * 50 * DT), rel=1e-6)
