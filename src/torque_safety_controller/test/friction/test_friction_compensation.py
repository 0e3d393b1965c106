# SPDX-License-Identifier: Apache-2.0
"""The law by itself, and on joints that stick and slip exactly."""

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from torque_safety_controller.friction.settings import FrictionModel, FrictionSettings
from torque_safety_controller.parts.friction import Friction

DT = 1e-3
GAMMA = 0.1 / DT
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


@pytest.mark.parametrize(("theta", "share"), [(0.0, 1.0), (3.0, 0.3), (100.0, 1.0)])
def test_it_is_the_law(theta, share):
    rng = np.random.default_rng(0)
    budget = np.array([8.0, 40.0])
    compensation = started(FrictionSettings(MODEL, budget, share, theta))
    w = compensation.reference_velocity.copy()
    at_limit = 0
    for _ in range(300):
        v, a = 0.1 * rng.standard_normal(2), 60.0 * rng.standard_normal(2)
        dt = rng.uniform(0.5, 2.0) * DT
        w, tau = expected(w, MODEL, M2, v, a, dt, theta, share, budget)
        np.testing.assert_allclose(compensation.torque(M2, v, a, dt, DT), tau, atol=1e-9)
        np.testing.assert_allclose(compensation.reference_velocity, w, atol=1e-12)
        at_limit += np.abs(tau[0]) > 0.999 * min(share * MODEL.level(v)[0], 8.0)
    assert 20 < at_limit < 280


@settings(max_examples=80, deadline=None, derandomize=True)
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


@settings(max_examples=80, deadline=None, derandomize=True)
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
    before = compensation.torque(M2, np.full(2, 0.01), np.full(2, 3.0), DT, DT)
    after = compensation.torque(M2, np.full(2, 0.01), np.full(2, 50.0), 0.0, DT)
    np.testing.assert_array_equal(after, before)


def test_switching_and_new_coefficients_fade():
    v, a = np.array([0.5, -0.4]), np.array([2.0, -1.0])
    compensation = Friction(replace(FULL, scale=0.0))
    assert compensation.idle
    other = FrictionModel(*np.array([[15.0, 0.2], [15.0, 0.2], [0.0, 3.0], [0.05, 0.002]]))
    taus = [compensation.torque(M2, v, a, DT, DT).copy()]
    assert not taus[0].any()
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
    assert np.abs(np.diff(taus, axis=0)).max() < 40.0 * DT / 0.2


# One joint that sticks and slips


STILL = 1e-9  # rad/s
INERTIA, KP, KD = 0.5, 100.0, 20.0
TRUTH = FrictionModel(*np.array([[10.0], [13.0], [2.0], [0.02]]))


def friction_joint(share, theta=3.0, delay=0):
    """Play a joint that is believed to have `share` of its friction, on its way to zero.

    Under a spring and a damper, with torques late by some periods. Friction is solved for the end
    of each period as Karnopp does: it stops the joint where it can.

    Returns:
        The distance that is left, and the greatest speed of the last second.
    """
    believed = FrictionModel(*(share * np.array([[10.0], [13.0], [2.0]])), TRUTH.stribeck_velocity)
    compensation = Friction(FrictionSettings(believed, 1e3 * ONE, 1.0, theta))
    M = INERTIA * np.eye(1)
    for _ in range(200):  # fades in
        compensation.torque(M, np.zeros(1), np.zeros(1), 0.01, DT)
    x, v, a, speeds = np.array([0.2]), np.zeros(1), np.zeros(1), []
    late = deque([np.zeros(1)] * delay)
    for _ in range(5000):
        tau = compensation.torque(M, v, a, DT, DT)
        a = -KP * x - KD * v
        late.append(tau + INERTIA * a)
        free = v + DT * late.popleft() / INERTIA
        dry = TRUTH.level(v) * DT / INERTIA
        v = np.sign(free) * np.maximum(np.abs(free) - dry, 0.0)
        x = x + DT * v
        speeds.append(abs(v[0]))
    return abs(x[0]), max(speeds[-1000:])


@pytest.mark.parametrize(("share", "delay"), [(0.7, 0), (1.0, 0), (2.0, 0), (1.3, 2)])
def test_it_comes_to_rest_nearer_to_its_goal(share, delay):
    without, _ = friction_joint(0.0)
    assert 0.05 < without < 13.0 / INERTIA / KP
    left, speed = friction_joint(share, delay=delay)
    assert speed < STILL  # no limit cycle
    missing = max(1.3 - share, 0.0) * 10.0 / INERTIA / KP
    assert left < max(0.1 * without, 1.05 * missing)


def test_believing_too_much_needs_the_memory_that_the_damping_allows():
    """theta <= kd - kp / kd keeps it at rest; with less friction than believed, 100 1/s do not."""
    assert friction_joint(2.0, 15.0)[1] < STILL
    assert friction_joint(2.0, 100.0)[1] > 0.05
    # With no more than there is, any memory is fine.
    assert friction_joint(0.77, 100.0)[1] < STILL


def lyapunov(x, v, w, M, kp, kd, theta, limit):
    """V of `docs/guides/tuning.md` for springs and dampers times M, and torques up to `limit`."""
    gain = GAMMA * felt(M)
    free = np.minimum(np.abs(w), limit / gain)
    energy = np.sum(0.5 * gain * free**2 + limit * (np.abs(w) - free))
    W = 0.5 * (kd - theta) * v @ M @ v + kp * x @ M @ v
    return (energy + W + 0.5 * kp * (2.0 * kd - theta) * x @ M @ x) / theta


def test_joints_without_any_friction_are_stable_under_the_compensation():
    """V falls along every motion as long as theta <= kd - kp / kd; by how much is derived."""
    rng, n, step = np.random.default_rng(1), 4, 1e-6
    for share in np.linspace(0.1, 1.0, 30):
        A = rng.standard_normal((n, n))
        M = A @ A.T + np.diag(rng.uniform(0.05, 1.0, n))
        kp = rng.uniform(1.0, 900.0)
        kd = rng.uniform(1.1, 2.5) * math.sqrt(kp)
        theta = share * (kd - kp / kd)
        limit = rng.uniform(0.1, 30.0, n)
        x, v, w = rng.standard_normal((3, n)) * np.array([[0.1], [1.0], [0.3]])
        a = -kp * x - kd * v
        phi = np.clip(GAMMA * felt(M) * w, -limit, limit)
        rate = -phi @ w - ((kd * (kd - theta) - kp) * v @ M @ v + kp**2 * x @ M @ x) / theta
        changes = v, a + np.linalg.solve(M, phi), a - theta * (w - v)
        before, after = (
            [each + sign * step * change for each, change in zip((x, v, w), changes, strict=True)]
            for sign in (-1.0, 1.0)
        )
        rest = M, kp, kd, theta, limit
        measured = (lyapunov(*after, *rest) - lyapunov(*before, *rest)) / (2.0 * step)
        assert measured == pytest.approx(rate, rel=1e-4, abs=1e-6)
        assert rate <= 0.0
