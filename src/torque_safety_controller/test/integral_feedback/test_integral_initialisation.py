# SPDX-License-Identifier: Apache-2.0
"""Initialised, also after a change of settings, the integral torque does not jump."""

from dataclasses import replace

import numpy as np
import pytest
from integral_terms import (
    DT,
    ROUGH,
    N,
    arm_terms,
    begun,
    moving,
    random_dynamics,
)

from torque_safety_controller.integral_feedback import (
    METHODS,
    InitialisationError,
    IntegralFeedback,
    IntegralSettings,
)

CHANGES = [
    {"gain": 0.5},
    {"gain": 9.0},
    {"mu": 0.0},
    {"mu": 1.0},
    {"slow_leak_rate": 5.0},
    {"fast_leak_rate": 1.0},
    {"budget": np.full(N, 1e-3)},
    {"budget": np.zeros(N)},
    {"budget": np.full(N, np.inf)},
    *({"anti_windup": method} for method in METHODS),
    {"gain": 0.7, "mu": 0.9, "budget": np.full(N, 0.01), "anti_windup": "paper"},
]


@pytest.mark.parametrize("change", CHANGES, ids=str)
@pytest.mark.parametrize("method", ["qp", "paper"])
def test_initialised_after_a_change_the_torque_does_not_jump(change, method):
    rng = np.random.default_rng(9)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 0.05), anti_windup=method))
    arm, torques = moving(feedback, rng)
    ordinary = np.abs(np.diff(torques, axis=0)).max()
    assert feedback.saturated.any()
    last, steps = torques[-1], []
    feedback.settings = replace(feedback.settings, **change)
    held = feedback.initialise(last, arm)
    if method == "qp" and not {"budget", "anti_windup"} & set(change):
        np.testing.assert_allclose(held, last, rtol=1e-10, atol=1e-12)
    last = held
    for _ in range(4):
        torque = feedback.torque(arm, np.zeros(N), DT)
        steps.append(np.abs(torque - last).max())
        last = torque
    # The leak of the new rates is no jump.
    assert max(steps) < 1.5 * ordinary + 0.1 * np.abs(torques[-1]).max()


def test_after_a_change_the_new_settings_count():
    rng = np.random.default_rng(10)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 0.5)))
    arm, torques = moving(feedback, rng, steps=300)
    last = torques[-1]
    assert np.abs(last).max() > 0.15
    feedback.settings = replace(feedback.settings, budget=np.full(N, 0.1))
    assert (np.abs(feedback.initialise(last, arm)) <= 0.1).all()
    torque = feedback.torque(arm, np.zeros(N), 0.02)
    assert 0.09 < np.abs(torque).max() <= 0.1


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("method", ["qp", "paper"])
def test_initialising_gives_the_torque_asked_for(mu, method):
    rng = np.random.default_rng(11)
    for _ in range(20):
        M, C = random_dynamics(rng, speed=0.1)
        wanted = 3.0 * rng.normal(size=N)
        arm = arm_terms(M, C, rng.normal(size=N))
        feedback = begun(IntegralSettings(np.full(N, np.inf), mu=mu, anti_windup=method), arm.v)
        np.testing.assert_allclose(feedback.initialise(wanted, arm), wanted, rtol=1e-9, atol=1e-9)
        limited = 2.0 * np.diag(M) * feedback.s
        # It goes on from there, and is forgotten slowly.
        after = feedback.torque(arm, np.zeros(N), 0.01)
        if method == "paper" and mu < 1.0:
            decay = (after - C @ feedback.s) / limited
            np.testing.assert_allclose(decay, np.exp(-0.01 * 0.1), rtol=1e-8)
        assert np.abs(after - wanted).max() < (0.1 if mu < 1.0 else 0.7) * np.abs(wanted).max()


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


def test_settings_are_compared_by_value():
    law = IntegralSettings(np.ones(N))
    assert law.same_as(IntegralSettings([1.0] * N))
    for change in CHANGES:
        changed = replace(law, **change)
        assert changed.same_as(law) == (change == {"anti_windup": "qp"})
