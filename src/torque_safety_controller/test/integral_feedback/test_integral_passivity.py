# SPDX-License-Identifier: Apache-2.0
"""What the theory of the integral action says, against Pinocchio's dynamics of real arms."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from integral_terms import arm_terms, begun

from torque_safety_controller.integral_feedback import IntegralSettings


def unlimited(n, **changes) -> IntegralSettings:
    """The plain law (3)-(4): never forgets, no limits."""
    return replace(IntegralSettings(np.full(n, np.inf), 2.0, 0.0, 0.0), **changes)


class PassivityRun:
    """A controlled arm in simulation: torque of a step held, motion by Runge and Kutta."""

    def __init__(self, arm, settings, dt, disturbance=0.0, amplitude=0.3, kp=20.0):
        self.arm, self.dt, self.t = arm, dt, 0.0
        self.amplitude, self.kp, self.disturbance = amplitude, kp, disturbance
        self.data = arm.model.createData()
        self.q, self.v, self.a_ref = self.reference()
        self.feedback = begun(settings, self.v)

    def reference(self):
        """A smooth motion about the middle of the range: q, v and a."""
        arm, rate = self.arm, 3.0
        phase = rate * self.t + np.arange(arm.n)
        middle = np.where(np.isfinite(arm.q_max), 0.5 * (arm.q_min + arm.q_max), 0.0)
        return (
            middle + self.amplitude * np.sin(phase),
            self.amplitude * rate * np.cos(phase),
            -self.amplitude * rate**2 * np.sin(phase),
        )

    def step(self, cut=np.inf) -> np.ndarray:
        """Play a control period; return the additional torque, of which motors give up to cut."""
        model, data = self.arm.model, self.data
        self.M = pin.crba(model, data, self.q).copy()
        self.C = pin.computeCoriolisMatrix(model, data, self.q, self.v).copy()
        # At the start no time has passed since the last step.
        elapsed = self.dt if self.t > 0.0 else 0.0
        y = self.feedback.torque(arm_terms(self.M, self.C, self.v), self.a_ref, elapsed)
        y = np.clip(y, -cut, cut)
        q, v, a = self.reference()
        self.a_ref = a + self.kp * (q - self.q) + 2.0 * np.sqrt(self.kp) * (v - self.v)
        tau = pin.rnea(model, data, self.q, self.v, self.a_ref) + y + self.disturbance
        self.q, self.v = self.arm.move(self.q, self.v, tau, self.dt, 1)
        self.t += self.dt
        return y

    def steps(self, duration, **others):
        """As many steps as the duration takes; the additional torques."""
        return np.array([self.step(**others) for _ in range(round(duration / self.dt))])


@pytest.mark.parametrize(("slow_rate", "fast_rate"), [(0.0, 0.0), (0.5, 9.0)])
def test_energy_falls_at_the_rate_of_the_theory(arm, slow_rate, fast_rate):
    """W of docs/theory/integral_action.md; what sampling adds is of first order in the period."""
    mu, offs = 0.4, []
    law = unlimited(arm.n, slow_leak_rate=slow_rate, fast_leak_rate=fast_rate, mu=mu)
    for dt in (2e-3, 1e-3):
        run = PassivityRun(arm, law, dt)
        run.feedback.memory.slow[:] = 0.3 * np.cos(np.arange(arm.n))
        run.feedback.memory.fast[:] = (0.3 - 0.02 * fast_rate) * np.cos(np.arange(arm.n))
        W, rates = [], []
        for _ in range(round(0.5 / dt)):
            run.step()
            M, fast, slow = run.M, run.feedback.memory.fast, run.feedback.memory.slow
            s, e = mu * fast + (1.0 - mu) * slow, fast - slow
            fast_energy, slow_energy = mu * fast @ M @ fast, (1.0 - mu) * slow @ M @ slow
            W.append(0.5 * (fast_energy + slow_energy))
            rates.append(
                -s @ (2.0 * np.diag(M) * s)
                - fast_rate * fast_energy
                - slow_rate * slow_energy
                + mu * (1.0 - mu) * e @ run.C @ e
            )
        W, rates = np.array(W), np.array(rates)
        assert (np.diff(W) < 0.0).all()
        expected = W[0] + dt * np.r_[0.0, np.cumsum(0.5 * (rates[1:] + rates[:-1]))]
        offs.append(np.abs(W - expected).max() / W[0])
    assert offs[1] < 0.01
    assert offs[0] / offs[1] == pytest.approx(2.0, rel=0.1)


def test_limited_torque_never_drives_s_and_a_torque_that_is_cut_does():
    """With C s in the budget the plain clip is not passive: this is what (11) and the leak add."""
    arm = load_arm("baxter_left_arm")
    few = 0.02 * arm.tau_max

    def largest_rise(cut=np.inf, **changes):
        """Of V in a step of 1 kHz, relative, with s far beyond its limit."""
        run = PassivityRun(arm, unlimited(arm.n, **changes), 1e-3, amplitude=0.5)
        run.feedback.memory.fast[:] = run.feedback.memory.slow[:] = 1.5 * np.cos(np.arange(arm.n))
        V = []
        for _ in range(1000):
            run.step(cut)
            V.append(run.feedback.s @ run.M @ run.feedback.s)
        return (np.diff(V) / V[:-1]).max()

    for method in ("scaling", "paper", "qp"):
        assert largest_rise(budget=few, anti_windup=method) < 0.0
    assert largest_rise(cut=few) > 1e-4


@pytest.mark.parametrize(
    ("method", "slow", "fast"), [("qp", 0.0, 0.0), ("qp", 0.5, 100.0), ("paper", 0.5, 100.0)]
)
def test_against_a_disturbance_the_error_is_what_forgetting_costs(method, slow, fast):
    """At rest M a_ref + K (mu / theta_f + (1 - mu) / theta_s) a_ref + d = 0."""
    arm, gain, kp, dt = load_arm("panda"), 5.0, 60.0, 2e-3
    d = 0.1 * arm.tau_max * np.cos(np.arange(arm.n))
    law = unlimited(arm.n, gain=gain, slow_leak_rate=slow, fast_leak_rate=fast, anti_windup=method)
    run = PassivityRun(arm, law, dt, d, amplitude=0.0, kp=kp)
    home = run.q
    run.steps(5.0)
    if slow == 0.0:
        memory = 1e9
    elif method == "qp":
        memory = 0.5 / fast + 0.5 / slow
    else:  # (13) as printed
        memory = sum(0.5 * dt / -np.expm1(-theta * dt) for theta in (fast, slow))
    a = -np.linalg.solve(run.M + gain * memory * np.diag(np.diag(run.M)), d)
    np.testing.assert_allclose(home - run.q, a / kp, rtol=2e-3, atol=1e-5)
    # Several times smaller than without the integral.
    without = np.linalg.solve(run.M, d) / kp
    assert np.abs(home - run.q).max() < 0.5 * np.abs(without).max()


def test_pushed_beyond_the_budget_and_released():
    """As IV-B of the paper: the budget is kept, and the arm swings through its goal less far."""
    arm, dt, joints = load_arm("panda"), 2e-3, [1, 3]
    settings = IntegralSettings(0.1 * arm.tau_max, gain=5.0)
    push = np.zeros(arm.n)
    push[joints] = 6.0 * settings.budget[joints] * [1.0, -1.0]
    overshoot, back = {}, {}
    for name, changes in (
        ("limited", {}),
        ("not corrected", {"anti_windup": "paper"}),
        ("unlimited", {"budget": np.full(arm.n, np.inf)}),
    ):
        run = PassivityRun(arm, replace(settings, **changes), dt, push, amplitude=0.0, kp=200.0)
        home, torques = run.q, [run.steps(2.0)]
        away = run.q - home
        run.disturbance = 0.0
        errors = []
        for _ in range(750):
            torques.append(run.step())
            errors.append(run.q - home)
        kept = (np.abs(np.vstack(torques)) <= settings.budget).all()
        assert kept == (name == "limited")
        beyond = (-np.sign(away) * errors)[:, joints]
        overshoot[name] = beyond.max()
        far = np.abs(np.array(errors)[:, joints]).max(axis=1) > 0.01
        back[name] = dt * (np.nonzero(far)[0][-1] + 1)
    assert overshoot["limited"] < overshoot["unlimited"] / 3.0
    assert back["limited"] < 1.0
    # Without correction the integral has grown behind the limit, and must first unwind.
    assert back["not corrected"] > 1.4 * back["limited"]
    assert back["unlimited"] > 1.4 * back["limited"]
