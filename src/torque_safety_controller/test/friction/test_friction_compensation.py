# SPDX-License-Identifier: Apache-2.0
"""The law by itself, and on joints that stick and slip exactly."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from torque_safety_controller.friction.settings import (
    GAIN,
    FrictionModel,
    FrictionSettings,
)
from torque_safety_controller.parts.friction import Friction

DT = 1e-3
GAMMA = GAIN / DT
ONE = np.ones(1)
MODEL = FrictionModel(*np.array([[10.0, 1.0], [13.0, 1.5], [2.0, 0.0], [0.02, 0.01]]))
WIDE = np.full(2, 40.0)
FULL = FrictionSettings(MODEL, WIDE, scale=1.0)
M2 = np.array([[0.8, 0.2], [0.2, 0.3]])


def started(settings=FULL, v=(0.0, 0.0)) -> Friction:
    """A compensation that has faded in, and has no memory yet."""
    compensation = Friction(settings)
    compensation.reset()
    for _ in range(60):
        compensation.torque(M2, np.array(v), np.zeros(2), 0.1, DT)
    return compensation


# The law


def felt(M):
    """The inertia that each joint's motor feels when the others give way."""
    return 1.0 / np.diag(np.linalg.inv(M))


def expected(w, model, M, v, a, dt, theta, share=1.0, budget=WIDE):
    """The law as `docs/guides/tuning.md` has it, one joint after the other."""
    w, tau = w.copy(), np.empty(len(w))
    for i in range(len(w)):
        friction = min(share * model.level(v)[i], budget[i])
        if theta > 0.0:
            kept = math.exp(-theta * dt)
            w[i] = kept * w[i] + (1.0 - kept) * (v[i] + a[i] / theta)
        else:
            w[i] += dt * a[i]
        gain = GAMMA * felt(M)[i]
        room = friction / gain
        w[i] = np.clip(w[i], min(v[i], 0.0) - room, max(v[i], 0.0) + room)
        tau[i] = np.clip(gain * w[i], -friction, friction)
    return w, tau


@pytest.mark.parametrize("theta", [0.0, 3.0, 100.0])
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_it_is_the_law(theta, share):
    rng = np.random.default_rng(0)
    budget = np.array([8.0, 40.0])
    compensation = started(FrictionSettings(MODEL, budget, share, theta))
    w = compensation.reference_velocity.copy()
    at_limit = 0
    for _ in range(500):
        v, a = 0.1 * rng.standard_normal(2), 60.0 * rng.standard_normal(2)
        dt = rng.uniform(0.5, 2.0) * DT
        w, tau = expected(w, MODEL, M2, v, a, dt, theta, share, budget)
        np.testing.assert_allclose(compensation.torque(M2, v, a, dt, DT), tau, atol=1e-9)
        np.testing.assert_allclose(compensation.reference_velocity, w, atol=1e-12)
        at_limit += np.abs(tau[0]) > 0.999 * min(share * MODEL.level(v)[0], 8.0)
    assert 20 < at_limit < 480


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    arrays(float, (5, 2), elements=st.floats(-3.0, 3.0)),
    arrays(float, (5, 2), elements=st.floats(-100.0, 100.0)),
    st.floats(0.0, 300.0),
    st.floats(0.1, 1.0),
)
def test_with_the_friction_it_never_adds_power(v, a, theta, share):
    compensation = started(FrictionSettings(MODEL, WIDE, share, theta))
    for velocity, acceleration in zip(v, a, strict=True):
        tau = compensation.torque(M2, velocity, acceleration, DT, DT)
        assert (np.abs(tau) <= share * MODEL.level(velocity) * (1.0 + 1e-12)).all()
        power = (tau - np.sign(velocity) * MODEL.level(velocity)) * velocity
        assert (power <= 1e-12).all()


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    arrays(float, (4, 2), elements=st.floats(allow_nan=True, allow_infinity=True)),
    arrays(float, (4, 2), elements=st.floats(allow_nan=True, allow_infinity=True)),
)
def test_whatever_comes_the_torque_is_finite_and_within_the_budget(v, a):
    budget = np.array([20.0, 0.3])
    compensation = started(replace(FULL, budget=budget))
    for velocity, acceleration in zip(v, a, strict=True):
        with np.errstate(all="ignore"):
            tau = compensation.torque(M2, velocity, acceleration, DT, DT)
        assert (np.abs(tau) <= budget).all()
    usual = compensation.torque(M2, np.array([0.1, -0.1]), np.zeros(2), DT, DT)
    assert np.isfinite(usual).all()


def test_a_time_that_is_not_known_moves_nothing():
    compensation = started()
    compensation.torque(M2, np.full(2, 0.01), np.full(2, 3.0), DT, DT)
    before = compensation.reference_velocity.copy()
    compensation.torque(M2, np.full(2, 0.01), np.full(2, 50.0), 0.0, DT)
    np.testing.assert_array_equal(compensation.reference_velocity, before)


# Switching


def test_off_it_adds_nothing_and_is_idle():
    compensation = Friction(replace(FULL, scale=0.0))
    assert compensation.idle
    tau = compensation.torque(M2, np.ones(2), np.ones(2), DT, DT)
    np.testing.assert_array_equal(tau, 0.0)


def test_switching_and_new_coefficients_fade():
    v, a = np.array([0.5, -0.4]), np.array([2.0, -1.0])
    compensation = Friction(replace(FULL, scale=0.0))
    other = FrictionModel(*np.array([[15.0, 0.2], [15.0, 0.2], [0.0, 3.0], [0.05, 0.002]]))
    taus = [compensation.torque(M2, v, a, DT, DT).copy()]
    for settings_ in (
        FULL,
        replace(FULL, scale=0.2),
        replace(FULL, model=other),
        replace(FULL, model=other, budget=np.array([4.0, 0.1])),
        replace(FULL, scale=0.0),
    ):
        compensation.settings = settings_
        assert not compensation.idle
        for _ in range(1500):
            taus.append(compensation.torque(M2, v, a, DT, DT).copy())
        reached = np.minimum(settings_.scale * settings_.model.level(v), settings_.budget)
        np.testing.assert_allclose(taus[-1], np.sign(v) * reached, atol=0.03)
    # Of what changes, the budgets most, the share of a period in 0.2 s.
    steps = np.abs(np.diff(taus, axis=0))
    assert steps[:4500].max() < 17.0 * DT / 0.2
    assert steps.max() < 40.0 * DT / 0.2
    for _ in range(5000):
        compensation.torque(M2, v, a, DT, DT)
    assert compensation.idle


def test_it_begins_with_nothing_and_fades_in():
    v, a = np.array([0.5, -0.4]), np.zeros(2)
    compensation = started(v=v)
    assert np.abs(compensation.torque(M2, v, a, DT, DT)).min() > 0.9
    compensation.reset()
    np.testing.assert_array_equal(compensation.last, 0.0)
    first = compensation.torque(M2, v, a, DT, DT).copy()
    np.testing.assert_allclose(first, DT / 0.2 * np.sign(v) * MODEL.level(v), rtol=5e-3)


# One joint that sticks and slips


class FrictionJoint:
    """A joint of inertia `m` on its way to zero under a spring and a damper.

    Friction as in `FrictionModel`, solved for the end of each period as Karnopp does: it stops
    the joint where it can.
    """

    def __init__(self, compensation, truth, m=0.5, kp=100.0, kd=20.0, load=0.0) -> None:
        self.compensation, self.truth, self.m = compensation, truth, m
        self.kp, self.kd, self.load = kp, kd, load
        self.x, self.v, self.a = np.zeros(1), np.zeros(1), np.zeros(1)

    def step(self, dt=DT):
        tau = self.compensation.torque(self.m * np.eye(1), self.v, self.a, dt, DT)
        self.a = -self.kp * self.x - self.kd * self.v
        free = self.v + dt * (self.a + (tau + self.load) / self.m)
        dry = self.truth.level(self.v) * dt / self.m
        self.v = np.sign(free) * np.maximum(np.abs(free) - dry, 0.0)
        self.x = self.x + dt * self.v

    def run(self, seconds, x=None):
        """Play; return positions and velocities."""
        if x is not None:
            self.x = np.array([x])
        states = []
        for _ in range(round(seconds / DT)):
            self.step()
            states.append((self.x[0], self.v[0]))
        return np.array(states).T


STILL = 1e-9  # rad/s
TRUTH = FrictionModel(10.0 * ONE, 13.0 * ONE, 2.0 * ONE, 0.02 * ONE)


def times(model, share):
    return FrictionModel(
        share * model.coulomb,
        share * model.static,
        share * model.viscous,
        model.stribeck_velocity,
    )


def joint(share, theta=3.0, **others) -> FrictionJoint:
    """A joint that is believed to have `share` of its friction."""
    model = times(TRUTH, share)
    compensation = Friction(FrictionSettings(model, 1e3 * ONE, 1.0, theta))
    held = FrictionJoint(compensation, TRUTH, **others)
    for _ in range(2000):  # fades in
        compensation.torque(held.m * np.eye(1), np.zeros(1), np.zeros(1), DT, DT)
    return held


@pytest.mark.parametrize("theta", [1.0, 3.0, 30.0])
def test_the_acceleration_that_leaves_stiction(theta):
    """F_s / M without, and 1 + gamma / theta times less with the compensation."""
    needed = 13.0 / 0.5 / (1.0 + GAMMA / theta)
    for factor, moves in ((0.97, False), (1.03, True)):
        held = joint(1.0, theta, kd=0.0)
        held.kp = 1e-9  # no spring: the acceleration is given by the load on it
        for _ in range(round(8.0 / theta / DT)):
            held.a = np.array([factor * needed])
            tau = held.compensation.torque(held.m * np.eye(1), held.v, held.a, DT, DT)
            if (tau + held.m * held.a)[0] > 13.0:
                break
        assert ((tau + held.m * held.a)[0] > 13.0) == moves


@pytest.mark.parametrize("share", [0.7, 1.0, 1.3, 2.0])
def test_it_comes_to_rest_nearer_to_its_goal(share):
    without = abs(joint(0.0).run(3.0, x=0.2)[0][-1])
    assert 0.05 < without < 13.0 / 0.5 / 100.0
    x, v = joint(share).run(6.0, x=0.2)
    assert np.abs(v[-1000:]).max() < STILL  # no limit cycle
    missing = max(1.3 - share * 1.0, 0.0) * 10.0 / 0.5 / 100.0
    assert abs(x[-1]) < max(0.1 * without, 1.05 * missing)
    assert abs(x[-1]) < 0.7 * without


def test_believing_too_much_needs_the_memory_that_the_damping_allows():
    """theta <= kd - kp / kd keeps it at rest; with less friction than believed, 100 1/s do not."""
    speeds = {}
    for theta in (3.0, 15.0, 100.0):
        speeds[theta] = np.abs(joint(2.0, theta).run(6.0, x=0.2)[1][-1000:]).max()
    assert max(speeds[3.0], speeds[15.0]) < STILL
    assert speeds[100.0] > 0.05
    # With no more than there is, any memory is fine.
    assert np.abs(joint(0.77, 100.0).run(6.0, x=0.2)[1][-1000:]).max() < STILL


def test_periods_of_delay_do_not_matter():
    class Delayed(FrictionJoint):
        queue = ()

        def step(self, dt=DT):
            tau = self.compensation.torque(self.m * np.eye(1), self.v, self.a, dt, DT).copy()
            a = -self.kp * self.x - self.kd * self.v
            self.queue = (*self.queue[-2:], tau + self.m * a)
            self.a = a
            free = self.v + dt * self.queue[0] / self.m
            dry = self.truth.level(self.v) * dt / self.m
            self.v = np.sign(free) * np.maximum(np.abs(free) - dry, 0.0)
            self.x = self.x + dt * self.v

    for share in (0.7, 1.0, 1.3):
        held = joint(share)
        held.__class__ = Delayed
        x, v = held.run(6.0, x=0.2)
        assert np.abs(v[-1000:]).max() < STILL
        assert abs(x[-1]) < 0.13


# Lyapunov


def lyapunov(x, v, w, M, kp, kd, theta, limit):
    """V of `docs/guides/tuning.md` for springs and dampers times M, and torques up to `limit`."""
    gain = GAMMA * felt(M)
    free = np.minimum(np.abs(w), limit / gain)
    energy = np.sum(0.5 * gain * free**2 + limit * (np.abs(w) - free))
    W = 0.5 * (kd - theta) * v @ M @ v + kp * x @ M @ v
    return (energy + W + 0.5 * kp * (2.0 * kd - theta) * x @ M @ x) / theta


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_joints_without_any_friction_are_stable_under_the_compensation(share):
    """V falls along every motion as long as theta <= kd - kp / kd; by how much is derived."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        n = 4
        A = rng.standard_normal((n, n))
        M = A @ A.T + np.diag(rng.uniform(0.05, 1.0, n))
        kp = rng.uniform(1.0, 900.0)
        kd = rng.uniform(1.1, 2.5) * math.sqrt(kp)
        theta = share * (kd - kp / kd)
        limit = rng.uniform(0.1, 30.0, n)
        x, v, w = rng.standard_normal((3, n)) * np.array([[0.1], [1.0], [0.3]])
        rate, held = derivatives(x, v, w, M, kp, kd, theta, limit)
        step = 1e-6
        change = lyapunov(*(s + step * d for s, d in held), M, kp, kd, theta, limit)
        change -= lyapunov(*(s - step * d for s, d in held), M, kp, kd, theta, limit)
        assert change / (2.0 * step) == pytest.approx(rate, rel=1e-4, abs=1e-6)
        assert rate <= 0.0


def derivatives(x, v, w, M, kp, kd, theta, limit):
    """Return V' as derived, and (state, its derivative) for x, v and w."""
    a = -kp * x - kd * v
    phi = np.clip(GAMMA * felt(M) * w, -limit, limit)
    V_dot = -phi @ w
    V_dot -= ((kd * (kd - theta) - kp) * v @ M @ v + kp**2 * x @ M @ x) / theta
    w_dot = a - theta * (w - v)
    return V_dot, ((x, v), (v, a + np.linalg.solve(M, phi)), (w, w_dot))
