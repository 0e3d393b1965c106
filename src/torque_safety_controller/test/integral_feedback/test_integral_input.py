# SPDX-License-Identifier: Apache-2.0
"""What the integral action is given: settings, pauses, and what it refuses."""

import math

import numpy as np
import pytest
from integral_terms import (
    DT,
    N,
    arm_terms,
    begun,
    moving,
    random_dynamics,
)

from torque_safety_controller.integral_feedback import (
    IntegralFeedback,
    IntegralSettings,
)
from viability_bounds_pkg.exceptions import SettingError


def test_a_pause_or_a_jump_in_time_does_not_kick():
    rng = np.random.default_rng(12)
    feedback = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    arm, torques = moving(feedback, rng)
    fast, slow = feedback.memory.fast.copy(), feedback.memory.slow.copy()
    elsewhere = arm._replace(v=arm.v + 3.0)
    feedback.skip(elsewhere, 2.0)
    np.testing.assert_allclose(feedback.memory.fast, math.exp(-200.0) * fast, rtol=1e-9)
    np.testing.assert_allclose(feedback.memory.slow, math.exp(-0.2) * slow, rtol=1e-12)
    torque = feedback.torque(elsewhere, np.zeros(N), 0.0)
    assert np.abs(torque).max() <= 1.5 * np.abs(torques[-1]).max()
    # The same without skipping is what it protects from.
    kicked = IntegralFeedback(IntegralSettings(np.full(N, 5.0)))
    moving(kicked, np.random.default_rng(12))
    assert np.abs(kicked.torque(elsewhere, np.zeros(N), 2.0)).max() > 1.0


def test_reset_forgets():
    rng = np.random.default_rng(13)
    arm = arm_terms(*random_dynamics(rng), np.ones(N))
    feedback = begun(IntegralSettings(np.full(N, 5.0)), arm.v)
    np.testing.assert_array_equal(feedback.torque(arm, np.zeros(N), DT), 0.0)
    still = arm._replace(v=np.zeros(N))
    assert np.abs(feedback.torque(still, np.zeros(N), DT)).max() > 0.1
    feedback.reset(arm)
    assert not feedback.saturated.any()
    np.testing.assert_array_equal(feedback.torque(arm, np.zeros(N), DT), 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"budget": [1.0, -1.0]}, "'budget' is .* a number >= 0 for each joint"),
        ({"budget": [1.0, math.nan]}, "budget"),
        ({"budget": []}, "budget"),
        ({"budget": [[1.0]]}, "budget"),
        ({"budget": [math.nan]}, "'budget' is .* >= 0"),
        ({"gain": 0.0}, "'gain' is '?0'?; allowed: a finite number > 0"),
        ({"gain": math.nan}, "gain"),
        ({"slow_leak_rate": -0.1}, "'slow_leak_rate' is '?-0.1'?; allowed: a finite number >= 0"),
        ({"fast_leak_rate": math.inf}, "fast_leak_rate"),
        ({"fast_leak_rate": 0.01}, "'fast_leak_rate' is '?0.01'?; allowed: .* slow one, 0.1"),
        ({"mu": 1.1}, "'mu' is '?1.1'?; allowed: a number from 0 to 1"),
        ({"mu": math.nan}, "mu"),
        (
            {"anti_windup": "hope"},
            "'anti_windup' is '?hope'?; allowed: qp or paper or scaling",
        ),
    ],
)
def test_settings_out_of_range_are_refused(values, message):
    with pytest.raises(SettingError, match=message) as caught:
        IntegralSettings(**{"budget": np.ones(2), **values})
    assert caught.value.name in values


def test_unusable_input_changes_nothing():
    rng = np.random.default_rng(14)
    feedback = IntegralFeedback(IntegralSettings(np.ones(N)))
    arm, _ = moving(feedback, rng)
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


def test_budget_of_the_settings_is_a_copy():
    budget = np.ones(N)
    law = IntegralSettings(budget)
    budget[:] = 7.0
    np.testing.assert_array_equal(law.budget, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        law.budget[0] = 2.0
