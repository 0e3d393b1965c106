# SPDX-License-Identifier: Apache-2.0
"""What the integral action remembers: how it begins, skips and forgets, and what it refuses."""

import math

import numpy as np
import pytest
from integral_terms import ROUGH, N, arm_terms, begun, random_dynamics

from torque_safety_controller.integral_feedback import InitialisationError, IntegralSettings
from viability_bounds_pkg.exceptions import SettingError

DT = 1e-3


def moved(settings, seed):
    """An integral action after some steps of a slow motion, and the arm's terms then."""
    rng = np.random.default_rng(seed)
    M, C = np.diag(rng.uniform(0.5, 2.0, N)), 0.2 * rng.normal(size=(N, N))
    v, feedback = np.zeros(N), begun(settings)
    for k in range(50):
        v = v + DT * rng.normal(size=N)
        a_ref = 3.0 * np.cos(0.05 * k + np.arange(N))
        feedback.torque(arm_terms(M, C, v), a_ref, DT)
    return feedback, arm_terms(M, C, v)


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("method", ["qp", "paper"])
def test_initialising_gives_the_torque_asked_for(mu, method):
    rng = np.random.default_rng(11)
    for _ in range(5):
        M, C = random_dynamics(rng, speed=0.1)
        wanted = 3.0 * rng.normal(size=N)
        arm = arm_terms(M, C, rng.normal(size=N))
        feedback = begun(IntegralSettings(np.full(N, np.inf), mu=mu, anti_windup=method), arm.v)
        feedback.memory.fast[:] = 0.3 * rng.normal(size=N)
        in_fast = mu * (C + 2.0 * np.diag(np.diag(M))) @ feedback.memory.fast
        np.testing.assert_allclose(feedback.initialise(wanted, arm), wanted, rtol=1e-9, atol=1e-9)
        # It goes on from there, and is forgotten: what is new at the slow rate if there is one.
        in_fast = in_fast if mu < 1.0 else wanted
        left = math.exp(-100.0 * 0.01) * in_fast + math.exp(-0.1 * 0.01) * (wanted - in_fast)
        np.testing.assert_allclose(feedback.torque(arm, np.zeros(N), 0.01), left, rtol=1e-8)


def test_of_an_initial_torque_the_memory_holds_what_the_budget_allows():
    arm = arm_terms(np.eye(N), np.zeros((N, N)))
    feedback = begun(IntegralSettings(np.full(N, 1.0), slow_leak_rate=0.0))
    np.testing.assert_allclose(feedback.initialise(np.full(N, 3.0), arm), 1.0, rtol=ROUGH)
    # The state came along: it leaves the limit at once.
    assert (feedback.torque(arm, np.full(N, -1.0), 0.01) < 0.99).all()


def test_initialising_is_refused_with_a_reason():
    feedback = begun(IntegralSettings(np.ones(N)))
    M = np.eye(N)
    with pytest.raises(InitialisationError):
        feedback.initialise(np.full(N, np.nan), arm_terms(M, 0.0 * M))
    for C in (-2.0 * M, -1.999999 * M, np.full((N, N), np.nan)):
        with pytest.raises(InitialisationError, match="too fast"):
            feedback.initialise(np.ones(N), arm_terms(M, C))
    np.testing.assert_array_equal(feedback.s, 0.0)


def test_a_time_that_is_skipped_is_forgotten_and_does_not_kick():
    feedback, arm = moved(IntegralSettings(np.full(N, 5.0)), seed=12)
    fast, slow = feedback.memory.fast.copy(), feedback.memory.slow.copy()
    elsewhere = arm._replace(v=arm.v + 3.0)
    feedback.skip(elsewhere, 0.02)
    np.testing.assert_allclose(feedback.memory.fast, math.exp(-2.0) * fast, rtol=1e-12)
    np.testing.assert_allclose(feedback.memory.slow, math.exp(-0.002) * slow, rtol=1e-12)
    left = (arm.C + 2.0 * arm.M) @ feedback.s
    np.testing.assert_allclose(feedback.torque(elsewhere, np.zeros(N), 0.0), left, rtol=1e-9)
    # The same without skipping is what it protects from.
    kicked, _ = moved(IntegralSettings(np.full(N, 5.0)), seed=12)
    assert np.abs(kicked.torque(elsewhere, np.zeros(N), 0.02)).max() > 1.0


def test_reset_forgets():
    arm = arm_terms(*random_dynamics(np.random.default_rng(14), speed=5.0), np.ones(N))
    feedback = begun(IntegralSettings(np.full(N, 0.1)), arm.v)
    np.testing.assert_array_equal(feedback.torque(arm, np.zeros(N), DT), 0.0)
    feedback.torque(arm._replace(v=np.zeros(N)), np.zeros(N), DT)
    assert feedback.saturated.any() and feedback.leak > 0.0
    feedback.reset(arm)
    assert not feedback.saturated.any() and feedback.leak == 0.0
    np.testing.assert_array_equal(feedback.torque(arm, np.zeros(N), DT), 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"budget": [1.0, -1.0]}, "'budget' is .* a number >= 0 for each joint"),
        ({"budget": [1.0, math.nan]}, "budget"),
        ({"budget": []}, "budget"),
        ({"gain": 0.0}, "'gain' is '?0'?; allowed: a finite number > 0"),
        ({"slow_leak_rate": -0.1}, "'slow_leak_rate' is '?-0.1'?; allowed: a finite number >= 0"),
        ({"fast_leak_rate": math.inf}, "fast_leak_rate"),
        ({"fast_leak_rate": 0.01}, "'fast_leak_rate' is '?0.01'?; allowed: .* slow one, 0.1"),
        ({"mu": 1.1}, "'mu' is '?1.1'?; allowed: a number from 0 to 1"),
        ({"mu": math.nan}, "mu"),
        ({"anti_windup": "hope"}, "'anti_windup' is '?hope'?; allowed: qp or paper or scaling"),
    ],
)
def test_settings_out_of_range_are_refused(values, message):
    with pytest.raises(SettingError, match=message) as caught:
        IntegralSettings(**{"budget": np.ones(2), **values})
    assert caught.value.name in values


def test_unusable_input_changes_nothing():
    feedback, arm = moved(IntegralSettings(np.ones(N)), seed=14)
    before = np.array(feedback.memory)
    for name in ("M", "C", "v"):
        value = getattr(arm, name).copy()
        value.flat[0] = np.nan
        with pytest.raises(ValueError, match="must be finite"):
            feedback.torque(arm._replace(**{name: value}), arm.v, DT)
    with pytest.raises(ValueError, match="must be finite"):
        feedback.torque(arm, np.full(N, np.inf), DT)
    with pytest.raises(ValueError, match="v must be finite"):
        feedback.skip(arm._replace(v=np.full(N, np.nan)), 0.1)
    np.testing.assert_array_equal(np.array(feedback.memory), before)
