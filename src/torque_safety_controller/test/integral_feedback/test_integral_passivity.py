# SPDX-License-Identifier: Apache-2.0
"""What the theory of the integral action says, against Pinocchio's dynamics of real arms."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from scipy.integrate import solve_ivp

from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralFeedback,
    IntegralSettings,
)

LAMBDA = 2.0
KP = 20.0
SHARP = dict(rtol=1e-11, atol=1e-12, method="DOP853")


def unlimited(n, **changes) -> IntegralSettings:
    """The plain law (3)-(4): never forgets, no limits."""
    return replace(
        IntegralSettings(np.full(n, np.inf), LAMBDA, 0.0, 0.0, anti_windup="paper"), **changes
    )


def terms(M, C, v) -> ArmTerms:
    """Terms of an arm without a task."""
    no_task = np.zeros((0, len(v)))
    return ArmTerms(np.ascontiguousarray(M), np.ascontiguousarray(C), no_task, no_task, v)


def wave(arm, t, amplitude=0.3, rate=3.0):
    """A smooth motion about the middle of the range: q, v and a."""
    phase = rate * t + np.arange(arm.n)
    middle = np.where(np.isfinite(arm.q_max), 0.5 * (arm.q_min + arm.q_max), 0.0)
    return (
        middle + amplitude * np.sin(phase),
        amplitude * rate * np.cos(phase),
        -amplitude * rate**2 * np.sin(phase),
    )


class Dynamics:
    """M and C of an arm."""

    def __init__(self, arm):
        self.model, self.data = arm.model, arm.model.createData()

    def M(self, q):
        return pin.crba(self.model, self.data, q).copy()

    def C(self, q, v):
        return pin.computeCoriolisMatrix(self.model, self.data, q, v).copy()


class PassivityRun:
    """A controlled arm in simulation: torque of a step held, motion by Runge and Kutta."""

    def __init__(self, arm, settings, dt, disturbance=None, amplitude=0.3, kp=KP):
        self.kp, self.kd = kp, 2.0 * np.sqrt(kp)
        self.arm, self.dt, self.amplitude = arm, dt, amplitude
        self.disturbance = np.zeros(arm.n) if disturbance is None else disturbance
        self.dynamics = Dynamics(arm)
        self.feedback = IntegralFeedback(settings)
        self.a_ref, self.t = np.zeros(arm.n), 0.0
        self.q, self.v, _ = wave(arm, 0.0, amplitude)
        none = np.zeros((arm.n, arm.n))
        self.feedback.reset(terms(none, none, self.v))

    def step(self) -> np.ndarray:
        """One control period; the additional torque."""
        M, C = self.dynamics.M(self.q), self.dynamics.C(self.q, self.v)
        self.last_M = M
        # At the start no time has passed since the last step.
        y = self.feedback.torque(terms(M, C, self.v), self.a_ref, self.dt if self.t > 0.0 else 0.0)
        y = self.limit(y)
        q, v, a = wave(self.arm, self.t, self.amplitude)
        self.a_ref = a + self.kp * (q - self.q) + self.kd * (v - self.v)
        tau = pin.rnea(self.arm.model, self.dynamics.data, self.q, self.v, self.a_ref)
        total = tau + y + self.disturbance
        self.q, self.v = self.arm.move(self.q, self.v, total, self.dt, 1)
        self.t += self.dt
        return y

    def limit(self, y) -> np.ndarray:
        """The torque that the motors get of it."""
        return y

    def steps(self, duration):
        """As many steps as the duration takes; the additional torques."""
        return np.array([self.step() for _ in range(round(duration / self.dt))])


def test_coriolis_matrix_makes_m_dot_minus_2_c_skew(arm):
    """M' along v by central differences."""
    dynamics, rng, h = Dynamics(arm), np.random.default_rng(0), 1e-5
    for _ in range(20):
        q, v = arm.random_state(rng)
        M_dot = (dynamics.M(q + h * v) - dynamics.M(q - h * v)) / (2.0 * h)
        N = M_dot - 2.0 * dynamics.C(q, v)
        size = np.abs(M_dot).max()
        assert size > 1e-2
        np.testing.assert_allclose(N + N.T, 0.0, atol=1e-7 * size)
        # It is the factorisation, and C v the torque that it should be.
        h_v = pin.nonLinearEffects(arm.model, dynamics.data, q, v)
        g = pin.computeGeneralizedGravity(arm.model, dynamics.data, q)
        np.testing.assert_allclose(dynamics.C(q, v) @ v, h_v - g, atol=1e-10)


@pytest.mark.parametrize("with_coriolis", [True, False])
def test_energy_decreases_at_the_rate_of_the_theory(arm, with_coriolis):
    """M s' = -(C + K) s along a moving arm: V = s'Ms/2 falls by the integral of s'Ks."""
    dynamics, n = Dynamics(arm), arm.n

    def slope(t, state):
        q, v, _ = wave(arm, t)
        s, M = state[:n], dynamics.M(q)
        Ks = LAMBDA * np.diag(M) * s
        Cs = dynamics.C(q, v) @ s if with_coriolis else 0.0
        return np.r_[np.linalg.solve(M, -Cs - Ks), s @ Ks]

    def energy(t, s):
        return 0.5 * s @ dynamics.M(wave(arm, t)[0]) @ s

    s_start = 0.3 * np.cos(np.arange(n))
    times = np.linspace(0.0, 1.5, 31)
    solution = solve_ivp(slope, (0.0, 1.5), np.r_[s_start, 0.0], t_eval=times, **SHARP)
    energies = np.array([energy(t, y[:n]) for t, y in zip(times, solution.y.T, strict=True)])
    off = np.abs(energies + solution.y[n] - energies[0]).max() / energies[0]
    if with_coriolis:
        assert off < 1e-10
        assert (np.diff(energies) < 0.0).all()
    else:
        assert off > 1e-2  # so C has a part in it


def test_two_rates_lose_energy_as_derived(arm):
    """The rate of W, the sum of both energies, as docs/theory/integral_action.md has it."""
    dynamics, n = Dynamics(arm), arm.n
    mu, theta_f, theta_s = 0.4, 9.0, 0.5

    def terms(t, state):
        q, v, _ = wave(arm, t)
        fast, slow = state[:n], state[n : 2 * n]
        M, C = dynamics.M(q), dynamics.C(q, v)
        return fast, slow, mu * fast + (1.0 - mu) * slow, M, C

    def slope(t, state):
        fast, slow, s, M, C = terms(t, state)
        Ks = LAMBDA * np.diag(M) * s
        s_dot = np.linalg.solve(M, -C @ s - Ks)
        e = fast - slow
        rate = (
            -s @ Ks
            - mu * theta_f * fast @ M @ fast
            - (1.0 - mu) * theta_s * slow @ M @ slow
            + mu * (1.0 - mu) * e @ C @ e
        )
        return np.r_[s_dot - theta_f * fast, s_dot - theta_s * slow, rate]

    def energy(t, state):
        fast, slow, _, M, _ = terms(t, state)
        return 0.5 * (mu * fast @ M @ fast + (1.0 - mu) * slow @ M @ slow)

    start = np.r_[0.3 * np.cos(np.arange(n)), -0.2 * np.sin(np.arange(n)), 0.0]
    start[-1] = energy(0.0, start)
    times = np.linspace(0.0, 1.0, 21)
    solution = solve_ivp(slope, (0.0, 1.0), start, t_eval=times, **SHARP)
    energies = [energy(t, y) for t, y in zip(times, solution.y.T, strict=True)]
    np.testing.assert_allclose(energies, solution.y[-1], atol=1e-10 * energies[0])


def energy_balance(arm, dt, duration=0.5):
    """How far V is from what the rate -s'Ks leaves of it, relative; and the energies."""
    run = PassivityRun(arm, unlimited(arm.n), dt)
    run.feedback.memory.fast[:] = run.feedback.memory.slow[:] = 0.3 * np.cos(np.arange(arm.n))
    V, loss = [], []
    for _ in range(round(duration / dt)):
        run.step()
        s = run.feedback.s
        V.append(0.5 * s @ run.last_M @ s)
        loss.append(LAMBDA * s @ (np.diag(run.last_M) * s))
    V, loss = np.array(V), np.array(loss)
    lost = np.r_[0.0, np.cumsum(0.5 * (loss[1:] + loss[:-1]) * dt)]
    return np.abs(V + lost - V[0]).max() / V[0], V


def test_energy_decreases_at_that_rate_in_sampled_control(arm):
    """The whole loop at 1 kHz; what sampling adds is of first order in the period."""
    off = {}
    for dt in (2e-3, 1e-3, 5e-4):
        off[dt], V = energy_balance(arm, dt)
        assert (np.diff(V) < 0.0).all()
    assert off[1e-3] < 0.01
    assert off[1e-3] / off[5e-4] == pytest.approx(2.0, rel=0.1)
    assert off[2e-3] / off[1e-3] == pytest.approx(2.0, rel=0.1)


def largest_rise(arm, method, kind=PassivityRun):
    """The largest rise of V in a step of 1 kHz control, relative, with s far beyond its limit."""
    budget = np.full(arm.n, np.inf) if method == "cut" else 0.02 * arm.tau_max
    law = "paper" if method == "cut" else method
    settings = unlimited(arm.n, budget=budget, anti_windup=law)
    run = kind(arm, settings, 1e-3, amplitude=0.5)
    run.feedback.memory.fast[:] = run.feedback.memory.slow[:] = 1.5 * np.cos(np.arange(arm.n))
    V = []
    for _ in range(1000):
        run.step()
        s = run.feedback.s
        V.append(0.5 * s @ run.last_M @ s)
    return (np.diff(V) / V[:-1]).max()


@pytest.mark.parametrize("method", ["scaling", "paper", "qp"])
def test_limited_torque_never_drives_s(arm, method):
    assert largest_rise(arm, method) < 0.0


def test_cutting_each_joint_s_torque_can_drive_s():
    """With C s in the budget the plain clip is not passive: this is what (11) and the leak add."""

    class Clipped(PassivityRun):
        def limit(self, y):
            return np.clip(y, -0.02 * self.arm.tau_max, 0.02 * self.arm.tau_max)

    arm = load_arm("baxter_left_arm")
    assert largest_rise(arm, "cut", Clipped) > 1e-4
    assert largest_rise(arm, "qp") < 0.0


def test_constant_disturbance_is_balanced_without_a_position_error():
    arm = load_arm("panda")
    d = 0.1 * arm.tau_max * np.cos(np.arange(arm.n))
    run = PassivityRun(arm, unlimited(arm.n), 2e-3, d, amplitude=0.0)
    y = run.steps(12.0)[-1]
    np.testing.assert_allclose(y, -d, atol=1e-4 * np.abs(d).max())
    np.testing.assert_allclose(
        run.feedback.s, -d / (LAMBDA * np.diag(run.last_M)), rtol=1e-3, atol=1e-6
    )
    without = np.linalg.solve(run.last_M, d) / KP
    assert np.abs(run.q - wave(arm, 0.0, 0.0)[0]).max() < 1e-4 * np.abs(without).max()


@pytest.mark.parametrize("method", ["qp", "paper"])
def test_leak_leaves_the_position_error_that_it_must(method):
    """At rest M a_ref + K (mu / theta_f + (1 - mu) / theta_s) a_ref + d = 0."""
    arm, mu, fast, slow, dt = load_arm("panda"), 0.5, 100.0, 0.5, 2e-3
    d = 0.1 * arm.tau_max * np.cos(np.arange(arm.n))
    settings = unlimited(
        arm.n, fast_leak_rate=fast, slow_leak_rate=slow, mu=mu, anti_windup=method
    )
    run = PassivityRun(arm, settings, dt, d, amplitude=0.0)
    run.steps(12.0)
    memory = mu / fast + (1.0 - mu) / slow
    if method == "paper":  # (13) as printed
        memory = sum(w * dt / -np.expm1(-t * dt) for w, t in ((mu, fast), (1.0 - mu, slow)))
    M = run.last_M
    a = -np.linalg.solve(M + LAMBDA * np.diag(np.diag(M)) * memory, d)
    error = wave(arm, 0.0, 0.0)[0] - run.q
    np.testing.assert_allclose(error, a / KP, rtol=2e-3, atol=1e-5)
    # Several times smaller than without the integral.
    without = np.linalg.solve(M, d) / KP
    assert np.abs(error).max() < 0.5 * np.abs(without).max()


def test_integral_is_forgotten_with_its_time_constants():
    """Held by something stronger for 1 s, then let go where it is: no s' any more."""
    arm = load_arm("panda")
    mu, fast, slow, dt = 0.5, 20.0, 0.5, 1e-3
    settings = unlimited(arm.n, fast_leak_rate=fast, slow_leak_rate=slow, mu=mu, anti_windup="qp")
    feedback = IntegralFeedback(settings)
    held = terms(np.eye(arm.n), np.zeros((arm.n, arm.n)), np.zeros(arm.n))
    for _ in range(1000):
        before = feedback.torque(held, np.ones(arm.n), dt)
    grown = [w * (1.0 - np.exp(-t)) / t for w, t in ((mu, fast), (1.0 - mu, slow))]
    np.testing.assert_allclose(before, LAMBDA * sum(grown), rtol=1e-9)
    for k in range(1, 2001):
        torque = feedback.torque(held, held.v, dt)
        left = grown[0] * np.exp(-fast * k * dt) + grown[1] * np.exp(-slow * k * dt)
        np.testing.assert_allclose(torque, LAMBDA * left, rtol=1e-9)
    np.testing.assert_allclose(torque[0] / LAMBDA, grown[1] * np.exp(-1.0), rtol=1e-9)


def test_saturation_is_left_at_once_when_the_error_reverses():
    """Pushed for 2 s against the budget; then s' turns round."""
    arm, dt = load_arm("panda"), 1e-3
    left_after = {}
    for method in ("qp", "paper"):
        settings = unlimited(arm.n, budget=0.1 * arm.tau_max, anti_windup=method)
        feedback = IntegralFeedback(settings)
        M = Dynamics(arm).M(arm.q_start)
        still = terms(M, np.zeros((arm.n, arm.n)), np.zeros(arm.n))
        push = np.where(np.arange(arm.n) == 1, 10.0, 0.0)
        for _ in range(2000):
            feedback.torque(still, push, dt)
        assert feedback.saturated[1]
        steps = 0
        while feedback.torque(still, -push, dt)[1] >= settings.budget[1]:
            steps += 1
        left_after[method] = steps
    assert left_after["qp"] == 0
    # What has been wound up takes as long to unwind.
    excess = 20.0 - 0.1 * arm.tau_max[1] / (LAMBDA * M[1, 1])
    assert left_after["paper"] == pytest.approx(excess / 10.0 / dt, abs=2)
    assert left_after["paper"] > 300


def test_pushed_beyond_the_budget_and_released():
    """As IV-B of the paper: the budget is kept, and the arm swings through its goal less far."""
    arm, dt, joints = load_arm("panda"), 2e-3, [1, 3]
    settings = IntegralSettings(0.1 * arm.tau_max)
    push = np.zeros(arm.n)
    push[joints] = 6.0 * settings.budget[joints] * [1.0, -1.0]
    overshoot, back = {}, {}
    for name, changes in (
        ("limited", {}),
        ("not corrected", {"anti_windup": "paper"}),
        ("unlimited", {"anti_windup": "paper", "budget": np.full(arm.n, np.inf)}),
    ):
        run = PassivityRun(arm, replace(settings, **changes), dt, push, amplitude=0.0, kp=200.0)
        home, torques = run.q, [run.steps(5.0)]
        away = run.q - home
        run.disturbance = np.zeros(arm.n)
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
    assert back["not corrected"] > 1.4
    assert back["unlimited"] > 1.4
