# SPDX-License-Identifier: Apache-2.0
"""What the judge of a simulated arm calls a violation."""

import numpy as np
import pytest

from franka_bridge.limit_watch import LimitWatch

# Joint 2 of an FR3, which stands at 0.25^2 / (2 * 2.585) rad before its limit at the latest.
LIMITS = {
    "q_min": [-1.7837],
    "q_max": [1.7837],
    "v_max": [2.62],
    "velocity_offset": [0.25],
    "deceleration_limit": [2.585],
    "tau_max": [87.0],
    "rate_max": [1000.0],
}
REST = 0.25**2 / (2 * 2.585)


def watch():
    return LimitWatch(**LIMITS, dt=1e-3)


def updated(q, v=0.0, tau=0.0):
    judge = watch()
    judge.update(np.array([q]), np.array([v]), np.array([tau]))
    return judge


@pytest.mark.parametrize(
    ("state", "violated"),
    [
        ((0.0, 2.62, 87.0), False),
        ((0.0, 2.6201), True),
        ((0.0, 0.0, -87.1), True),
        ((1.7838,), True),
        ((-1.7838,), True),
        ((1.7836,), False),
        ((1.7837 - REST, 1e-6), True),  # here it may only move away
        ((1.7837 - REST, -2.62), False),
        ((-1.7837 + REST, -1e-6), True),
        ((-1.7837 + REST, 2.62), False),
        ((float("nan"),), True),
        ((0.0, float("nan")), True),
        ((0.0, 0.0, float("nan")), True),
    ],
)
def test_states_within_and_beyond(state, violated):
    assert updated(*state).violated == violated


def test_speed_is_judged_by_the_distance_to_the_limit_ahead():
    room = 0.3  # rad
    allowed = np.sqrt(2 * 2.585 * room) - 0.25  # rad/s
    for side in (1.0, -1.0):
        excess = updated(side * (1.7837 - room), side * (allowed + 0.1)).speed
        assert excess == pytest.approx([0.1], abs=1e-12)
        assert not updated(side * (1.7837 - room), side * (allowed - 1e-9)).violated


def test_the_worst_of_all_updates_counts():
    judge = watch()
    for q in (0.0, 1.8, -1.0):
        judge.update(np.array([q]), np.zeros(1), np.zeros(1))
    assert judge.position == pytest.approx([1.8 - 1.7837], abs=1e-12)
    assert judge.upper == pytest.approx([1.7837 - 1.8], abs=1e-12)
    assert judge.lower == pytest.approx([0.7837], abs=1e-12)


def test_a_torque_that_is_sent_may_change_by_1_nm_in_a_period():
    judge = watch()
    judge.sent(np.array([1.0]), np.array([0.0]))
    assert not judge.violated
    judge.sent(np.array([-0.5]), np.array([1.0]))
    assert judge.violated
    assert judge.rate == pytest.approx([1.5], abs=1e-12)
