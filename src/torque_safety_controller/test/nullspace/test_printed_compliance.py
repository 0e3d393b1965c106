# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance as printed, beside the equations written down once more.

Nothing of the controller is used for what is expected: inverses and rates by NumPy and by
differences along the motion, (11) by ProxQP.
"""

from dataclasses import replace

import numpy as np
import pytest
from compliance_run import DT, ComplianceRun, unlimited
from general_solver import nearest
from printed_law import FAST, LAMBDA, MU, SLOW, STEP, PrintedLaw
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.integral_feedback.printed import PrintedCompliance

SMALL = 1e-5  # s; of differences


class Motion(PrintedLaw):
    """A real arm on a motion, and how its torque is limited."""

    def __init__(self, robot, rows, limit, limit_torque):
        self.arm = TaskArm(robot, rows, armature=0.1)
        super().__init__(self.arm.model, self.arm.posture, rows, 0.3, 2.0, SMALL)
        self.limit, self.limit_torque = limit, limit_torque
        self.binding = 0

    def J(self, t):
        return self.arm.terms(self.q(t), self.v(t)).J

    def limited(self, u):
        return self.limit_torque(self, u)


def factor(u, limit):
    """(10)."""
    return min(1.0, (limit / np.abs(u)).min())


def scaled(motion, u):
    return factor(u, motion.limit) * u


def solved(motion, u):
    """(11), with a for s: what u takes energy out of."""
    limit = motion.limit
    x = nearest(u, -limit, limit, motion.a, factor(u, limit) * motion.a @ u)
    motion.binding += np.abs(x - np.clip(u, -limit, limit)).max() > 1e-3
    return x


LIMITED = {"scaling": scaled, "paper": solved}


@pytest.mark.parametrize("method", LIMITED)
@pytest.mark.parametrize(("robot", "rows"), [("panda", 6), ("panda", 3), ("talos", 6)])
def test_it_is_what_the_paper_prints(method, robot, rows):
    """What differs is J' in the middle of a step: less than 1e-4 of the torque."""
    n = TaskArm(robot, rows).n
    limit = np.where(np.arange(n) % 3 == 0, 0.02, 1.0)
    motion = Motion(robot, rows, limit, LIMITED[method])
    compliance = PrintedCompliance(IntegralSettings(limit, LAMBDA, SLOW, FAST, MU, method), rows)

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
    assert limited > 100
    # Its second condition is rarely felt; here it is throughout.
    if method == "paper":
        assert (motion.binding > 200) == ((robot, rows) == ("panda", 3))


def test_energy_falls_at_the_rate_of_the_paper_s_proof():
    """(23), (24): without leaks V = a'Ma / 2 falls by a'u_K."""
    offs = []
    for dt in (1e-3, 5e-4):
        arm = TaskArm("panda", 6)
        law = unlimited(7, slow_leak_rate=0.0, fast_leak_rate=0.0, anti_windup="paper")
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
    """And one within the range of the task's inverse goes on."""
    run = ComplianceRun("panda")
    compliance = PrintedCompliance(replace(unlimited(7), anti_windup=method), 6)
    torque = run.terms.J.T @ np.array([3.0, -2.0, 4.0, 0.3, 0.1, -0.2])
    np.testing.assert_allclose(compliance.initialise(torque, run.now), torque, rtol=1e-9)
    after = compliance.torque(run.now, np.zeros(7), DT)
    np.testing.assert_allclose(after, torque, rtol=0.01)
