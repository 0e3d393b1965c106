"""What the theory of null-space compliance says, against Pinocchio's dynamics of real arms."""

import math

import numpy as np
import pytest
from task_arm import TaskArm

from torque_safety_controller.integral_feedback.leaky_integrator import LeakyIntegrator, mix
from torque_safety_controller.linalg.generalized_inverse import (
    dynamically_consistent_inverse,
    pseudo_inverse,
)
from torque_safety_controller.nullspace.compliance import NullspaceCompliance, NullspaceSettings

FORMS = [
    dict(dynamically_consistent=consistent, keep_integral=keep)
    for consistent in (True, False)
    for keep in (False, True)
]
PLAIN = dict(mu=0.0, theta_slow=0.0, free_null_space=False)
"""The law (21) with K a, that never forgets: (23) to the letter."""
TWO_RATES = dict(theta_slow=0.3, theta_fast=20.0, theta_null=5.0)


class Loop:
    """An arm under a waving reference and the additional torque; the memory is not zero."""

    def __init__(self, robot, rows, dt, disturbance=0.0, **changes):
        self.arm, self.dt, self.t = TaskArm(robot, rows), dt, 0.0
        n = self.arm.n
        # What the memory cannot hold of the torque that seeds it is gone in the next step.
        settings = NullspaceSettings(np.full(n, np.inf), blend_time=1e-9, **changes)
        self.settings = settings
        self.compliance = NullspaceCompliance(settings, rows)
        self.q, self.v = self.arm.posture.copy(), 0.5 * np.cos(np.arange(n))
        self.terms = self.arm.terms(self.q, self.v)
        weights = np.diag(self.terms.M)
        self.disturbance = disturbance * weights * np.sin(1.0 + np.arange(n))
        torque = weights * np.cos(2.0 * np.arange(n))
        t = self.terms
        self.torque = self.compliance.seed(torque, t.M, t.C, t.J, t.J_dot, self.v)
        self.act()
        self.step()

    def act(self):
        n = self.arm.n
        self.a_ref = 40.0 * (self.arm.posture - self.q) - 10.0 * self.v
        self.a_ref += 3.0 * np.sin(3.0 * self.t + np.arange(n))
        t = self.terms
        tau = t.M @ self.a_ref + t.h + self.torque + self.disturbance
        self.q, self.v = self.arm.move(self.q, self.v, tau, self.dt)
        self.t += self.dt

    def step(self):
        self.terms = t = self.arm.terms(self.q, self.v)
        self.torque = self.compliance.torque(t.M, t.C, t.J, t.J_dot, self.v, self.a_ref, self.dt)

    def inverses(self):
        t, threshold = self.terms, self.settings.threshold
        J_bar = dynamically_consistent_inverse(t.J, t.J_dot, t.M, t.C + t.C.T, threshold)
        if self.settings.dynamically_consistent:
            return J_bar.J_plus, J_bar.J_plus
        return pseudo_inverse(t.J, t.J_dot, threshold).J_plus, J_bar.J_plus

    def power(self):
        """What the energy should change by, W: the terms of the proof in the documentation."""
        g, t = self.settings, self.terms
        J_plus, J_bar = self.inverses()
        a, fast = self.compliance.a, self.compliance.a_fast
        K, x = g.lambda_ * np.diag(t.M), a - fast
        slow = J_plus @ t.J @ a if g.free_null_space else a
        power = -(1.0 - g.mu) * slow @ (K * slow) - g.mu * fast @ (K * fast)
        power -= g.theta_slow * a @ t.M @ a
        power -= (g.null_rate - g.theta_slow) * a @ t.M @ (a - J_bar @ t.J @ a)
        power -= g.theta_slow * g.mu * x @ (K * x) / (g.theta_fast - g.theta_slow)
        return power - a @ self.disturbance


def energy_balance(loop, duration):
    """Energies and the largest difference from what the integrated power makes of the first."""
    energies, expected = [loop.compliance.energy], loop.compliance.energy
    power, off = loop.power(), 0.0
    for _ in range(round(duration / loop.dt)):
        loop.act()
        loop.step()
        now = loop.power()
        expected += 0.5 * loop.dt * (power + now)
        power = now
        energies.append(loop.compliance.energy)
        off = max(off, abs(energies[-1] - expected))
    return np.array(energies), off


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("robot, rows", [("panda", 6), ("panda", 3), ("talos", 6), ("talos", 8)])
def test_energy_falls_at_the_rate_of_the_theory(robot, rows, form):
    """V = a'Ma/2 falls by the integral of a'Ka: what is off halves with the control period."""
    offs = []
    for dt in (1e-3, 5e-4):
        energies, off = energy_balance(Loop(robot, rows, dt, **PLAIN, **form), 0.25)
        assert (np.diff(energies) < 0.0).all()
        assert off < 0.005 * energies[0]
        offs.append(off)
    # Less than half is as good: then first-order parts of different sign met.
    assert offs[1] < 0.6 * offs[0]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("robot, rows", [("panda", 6), ("talos", 3)])
def test_energy_of_the_two_rate_law_with_a_disturbance(robot, rows, form):
    """The storage function of the documentation, with all its terms, a changing M included."""
    offs = []
    for dt in (1e-3, 5e-4):
        loop = Loop(robot, rows, dt, disturbance=1.0, **TWO_RATES, **form)
        energies, off = energy_balance(loop, 0.25)
        assert off < 0.01 * energies[0]
        offs.append(off)
    assert 0.4 * offs[0] < offs[1] < 0.6 * offs[0]


def test_energy_falls_near_a_singularity_too():
    """With every direction damped (23) still holds, and with it passivity."""
    offs = []
    for dt in (1e-3, 5e-4):
        loop = Loop("panda", 6, dt, **TWO_RATES, threshold=5.0)
        energies, off = energy_balance(loop, 0.2)
        assert loop.compliance.near_singular
        assert (np.diff(energies) < 0.0).all()
        offs.append(off)
    assert offs[1] < 0.6 * offs[0]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("theta_slow", [0.0, 2.0])
@pytest.mark.parametrize("robot, rows", [("panda", 6), ("talos", 3), ("talos", 8)])
def test_integral_of_the_task_error_is_exact(robot, rows, theta_slow, form):
    """J a is the sum of J s' in the middle of the steps, forgotten at theta_slow: to rounding."""
    dt = 1e-3
    loop = Loop(robot, rows, dt, disturbance=1.0, theta_slow=theta_slow, **form)
    decay, gain = math.exp(-theta_slow * dt), 1.0
    if theta_slow > 0.0:
        gain = -math.expm1(-theta_slow * dt) / (theta_slow * dt)
    expected = loop.compliance.task_integral
    largest = 0.0
    for _ in range(300):
        J, v = loop.terms.J, loop.v
        loop.act()
        loop.step()
        error = loop.a_ref * dt - (loop.v - v)
        expected = decay * expected + gain * 0.5 * (J + loop.terms.J) @ error
        largest = max(largest, np.abs(expected).max())
        assert not loop.compliance.near_singular
        np.testing.assert_allclose(loop.compliance.task_integral, expected, atol=1e-13)
    assert largest > 0.1


@pytest.mark.parametrize("consistent", [True, False])
def test_integral_of_the_task_error_near_a_singularity(consistent):
    """What is lost there, step by step: the relation of the documentation, to rounding."""
    dt, theta = 1e-3, 2.0
    loop = Loop(
        "talos",
        6,
        dt,
        disturbance=1.0,
        theta_slow=theta,
        theta_null=theta,
        dynamically_consistent=consistent,
        threshold=0.3,
    )
    decay = math.exp(-theta * dt)
    gain = -math.expm1(-theta * dt) / (theta * dt)
    lost_most = 0.0
    for _ in range(200):
        J, v, a = loop.terms.J, loop.v, loop.compliance.a
        J_plus, _ = loop.inverses()
        loop.act()
        loop.step()
        error = loop.a_ref * dt - (loop.v - v)
        J_new = loop.terms.J
        J_plus_new, _ = loop.inverses()
        R, R_new = np.eye(6) - J @ J_plus, np.eye(6) - J_new @ J_plus_new
        s = a - J_plus @ J @ a
        middle = 0.5 * (decay * s + decay * s + gain * error)
        integral = -decay * J @ a + (J_new - J) @ middle
        lost = R_new @ integral + decay * R @ J @ a
        expected = decay * J @ a + gain * 0.5 * (J + J_new) @ error + lost
        np.testing.assert_allclose(loop.compliance.task_integral, expected, atol=1e-12)
        lost_most = max(lost_most, np.abs(lost).max())
        # Nothing is lost in directions that are damped neither now nor before.
        U, singular, _ = np.linalg.svd(np.hstack([R, R_new]))
        np.testing.assert_allclose(U[:, singular < 1e-10].T @ lost, 0.0, atol=1e-10)
        assert 0 < (singular < 1e-10).sum() < 6
    assert lost_most > 1e-5


def test_both_forms_are_one_where_the_jacobian_does_not_change():
    """With J' = 0 and C = 0 the law is K (mu a_fast + (1 - mu) a_slow) of plain s, eq. (14)."""
    rng, n, dt = np.random.default_rng(0), 5, 2e-3
    M = np.diag(rng.uniform(0.5, 2.0, n))
    J = rng.normal(size=(2, n))
    settings = NullspaceSettings(np.full(n, np.inf), mu=0.3, free_null_space=False)
    compliance = NullspaceCompliance(settings, 2)
    slow, fast = (LeakyIntegrator(theta, n) for theta in (0.1, 100.0))
    v, v_ref = np.zeros(n), np.zeros(n)
    zero = np.zeros((2, n))
    compliance.torque(M, np.zeros((n, n)), J, zero, v, v, 0.0)
    for _ in range(100):
        a_ref, v = rng.normal(size=n), rng.normal(size=n)
        v_ref = v_ref + dt * a_ref
        tau = compliance.torque(M, np.zeros((n, n)), J, zero, v, a_ref, dt)
        s = mix(fast.update(v_ref - v, dt), slow.update(v_ref - v, dt), 0.3)
        np.testing.assert_allclose(tau, 2.0 * np.diag(M) * s, atol=1e-12)
        np.testing.assert_allclose(compliance.a_fast, fast.value, atol=1e-12)
