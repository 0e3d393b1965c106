# SPDX-License-Identifier: Apache-2.0
"""What the theory of null-space compliance says, against Pinocchio's dynamics of real arms."""

import numpy as np
import pytest
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.nullspace import NullspaceCompliance, fast_weight
from torque_safety_controller.integral_feedback.nullspace_step import (
    THRESHOLD,
    dynamically_consistent_inverse,
)

NEVER_FORGETS = dict(slow_leak_rate=0.0, fast_leak_rate=0.0)
"""(23) to the letter: a alone decides, and does not leak."""
TWO_RATES = dict(slow_leak_rate=0.3, fast_leak_rate=20.0)
# The Panda's elbow nearly stretched: the hand loses a direction.
STRETCHED = 0.25 * np.array([0.3, 0.4, 0.2, -1.6, 0.1, 2.0, 0.5])


class PassivityLoop:
    """An arm under a waving reference and the additional torque; the memory is not zero."""

    def __init__(self, robot, rows, dt, disturbance=0.0, posture=None, speed=0.5, **changes):
        self.arm, self.dt, self.t = TaskArm(robot, rows), dt, 0.0
        n = self.arm.n
        self.settings = IntegralSettings(np.full(n, np.inf), **changes)
        self.compliance = NullspaceCompliance(self.settings, rows)
        self.posture = self.arm.posture if posture is None else posture
        self.q, self.v = self.posture.copy(), speed * np.cos(np.arange(n))
        self.terms = self.arm.terms(self.q, self.v)
        weights = np.diag(self.terms.M)
        self.disturbance = disturbance * weights * np.sin(1.0 + np.arange(n))
        torque = weights * np.cos(2.0 * np.arange(n))
        self.torque = self.compliance.initialise(torque, arm_terms(self.terms, self.v))
        self.act()
        self.step()

    def act(self):
        n = self.arm.n
        self.a_ref = 40.0 * (self.posture - self.q) - 10.0 * self.v
        self.a_ref += 3.0 * np.sin(3.0 * self.t + np.arange(n))
        t = self.terms
        tau = t.M @ self.a_ref + t.h + self.torque + self.disturbance
        self.q, self.v = self.arm.move(self.q, self.v, tau, self.dt)
        self.t += self.dt

    def step(self):
        self.terms = t = self.arm.terms(self.q, self.v)
        self.torque = self.compliance.torque(arm_terms(t, self.v), self.a_ref, self.dt)

    def inverse(self):
        t = self.terms
        return dynamically_consistent_inverse(t.J, t.J_dot, t.M, t.C + t.C.T, THRESHOLD)[0]

    def near_singular(self):
        return np.linalg.svd(self.terms.J)[1][-1] < THRESHOLD

    def forgotten(self):
        """x = a - a_fast."""
        return self.compliance.memory.root / np.sqrt(np.diag(self.terms.M))

    def energy(self):
        """W of the documentation."""
        a, x = self.compliance.memory.a, self.forgotten()
        M = self.terms.M
        return 0.5 * (a @ M @ a + fast_weight(self.settings) * x @ (np.diag(M) * x))

    def power(self):
        """What the energy should change by, W: the terms of the proof in the documentation."""
        g, t = self.settings, self.terms
        P = self.inverse() @ t.J
        a, x = self.compliance.memory.a, self.forgotten()
        fast, slow = a - x, P @ a
        K, slow_rate, fast_rate = g.gain * np.diag(t.M), g.slow_leak_rate, g.fast_leak_rate
        power = -(1.0 - g.mu) * slow @ (K * slow) - g.mu * fast @ (K * fast)
        power -= slow_rate * a @ t.M @ a
        power -= (fast_rate - slow_rate) * a @ t.M @ (a - P @ a)
        if fast_rate > slow_rate:
            power -= slow_rate * g.mu * x @ (K * x) / (fast_rate - slow_rate)
        return power - a @ self.disturbance


def energy_balance(loop, duration):
    """Energies and the largest difference from what the integrated power makes of the first."""
    energies, expected = [loop.energy()], loop.energy()
    power, off = loop.power(), 0.0
    for _ in range(round(duration / loop.dt)):
        loop.act()
        loop.step()
        now = loop.power()
        expected += 0.5 * loop.dt * (power + now)
        power = now
        energies.append(loop.energy())
        off = max(off, abs(energies[-1] - expected))
    return np.array(energies), off


@pytest.mark.parametrize("robot, rows", [("panda", 6), ("panda", 3), ("talos", 6), ("talos", 8)])
def test_energy_falls_at_the_rate_of_the_theory(robot, rows):
    """V = a'Ma/2 falls by what the gains take; what is off halves with the period."""
    offs = []
    for dt in (1e-3, 5e-4):
        energies, off = energy_balance(PassivityLoop(robot, rows, dt, **NEVER_FORGETS), 0.25)
        assert (np.diff(energies) < 0.0).all()
        assert off < 0.005 * energies[0]
        offs.append(off)
    # Less than half is as good: then first-order parts of different sign met.
    assert offs[1] < 0.6 * offs[0]


@pytest.mark.parametrize("robot, rows", [("panda", 6), ("talos", 3)])
def test_energy_of_the_two_rate_law_with_a_disturbance(robot, rows):
    """The storage function of the documentation, with all its terms, a changing M included."""
    offs = []
    for dt in (1e-3, 5e-4):
        loop = PassivityLoop(robot, rows, dt, disturbance=1.0, **TWO_RATES)
        energies, off = energy_balance(loop, 0.25)
        assert off < 0.01 * energies[0]
        offs.append(off)
    assert 0.4 * offs[0] < offs[1] < 0.6 * offs[0]


def test_energy_falls_near_a_singularity_too():
    """With a direction damped (23) still holds, and with it passivity."""
    offs = []
    for dt in (1e-3, 5e-4):
        loop = PassivityLoop("panda", 6, dt, posture=STRETCHED, speed=0.02, **TWO_RATES)
        near = loop.near_singular()
        energies, off = energy_balance(loop, 0.1)
        assert near
        assert (np.diff(energies) < 0.0).all()
        offs.append(off)
    assert offs[1] < 0.6 * offs[0]


@pytest.mark.parametrize("slow", [0.0, 2.0])
@pytest.mark.parametrize("robot, rows", [("panda", 6), ("talos", 3), ("talos", 8)])
def test_integral_of_the_task_error_is_exact(robot, rows, slow):
    """J a is the sum of J s' in the middle of the steps, leaking slowly: to rounding."""
    dt = 1e-3
    loop = PassivityLoop(robot, rows, dt, disturbance=1.0, slow_leak_rate=slow)
    decay, gain = leak_factors(slow, dt, False)
    expected = loop.terms.J @ loop.compliance.memory.a
    largest = 0.0
    for _ in range(300):
        J, v = loop.terms.J, loop.v
        loop.act()
        loop.step()
        error = loop.a_ref * dt - (loop.v - v)
        expected = decay * expected + gain * 0.5 * (J + loop.terms.J) @ error
        largest = max(largest, np.abs(expected).max())
        assert not loop.near_singular()
        found = loop.terms.J @ loop.compliance.memory.a
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert largest > 0.1


def test_integral_of_the_task_error_near_a_singularity():
    """What is lost there, step by step: the relation of the documentation, to rounding."""
    dt, theta = 1e-3, 2.0
    loop = PassivityLoop(
        "panda",
        6,
        dt,
        disturbance=0.1,
        posture=STRETCHED,
        speed=0.02,
        slow_leak_rate=theta,
        fast_leak_rate=theta,
    )
    decay, gain = leak_factors(theta, dt, False)
    lost_most, near = 0.0, 0
    for _ in range(100):
        J, v, a, J_plus = loop.terms.J, loop.v, loop.compliance.memory.a.copy(), loop.inverse()
        loop.act()
        loop.step()
        near += loop.near_singular()
        error = loop.a_ref * dt - (loop.v - v)
        J_new = loop.terms.J
        R, R_new = np.eye(6) - J @ J_plus, np.eye(6) - J_new @ loop.inverse()
        s = a - J_plus @ J @ a
        middle = 0.5 * (decay * s + decay * s + gain * error)
        integral = -decay * J @ a + (J_new - J) @ middle
        lost = R_new @ integral + decay * R @ J @ a
        expected = decay * J @ a + gain * 0.5 * (J + J_new) @ error + lost
        found = J_new @ loop.compliance.memory.a
        np.testing.assert_allclose(found, expected, atol=1e-11)
        lost_most = max(lost_most, np.abs(lost).max())
        # Nothing is lost in directions that are damped neither now nor before.
        U, singular, _ = np.linalg.svd(np.hstack([R, R_new]))
        np.testing.assert_allclose(U[:, singular < 1e-9].T @ lost, 0.0, atol=1e-9)
        assert (singular < 1e-9).any()
    assert near > 10
    assert lost_most > 1e-6
