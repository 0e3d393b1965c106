# SPDX-License-Identifier: Apache-2.0
import pytest

from sim_bridge.scenario.report import verdict

KEPT = {
    "limits_kept": True,
    "clock": "lockstep",
    "bounds_method": "exact",
    "torque_rates_clipped": False,
    "steps": 6145,
    "deadline_misses": 0,
    "late_periods": 0,
    "braked_periods": 0,
    "recording_lost_periods": 0,
    "max_position_violation_rad": 0.0,
    "max_velocity_violation_rad_s": 0.0,
    "max_torque_ratio": 0.9,
    "max_torque_rate_ratio": None,
    "most_violated_joint": None,
    "most_too_fast_joint": None,
    "joints": {"left_e1": {"unit": "rad"}},
}
FAST = {"max_velocity_violation_rad_s": 0.5, "most_too_fast_joint": "left_e1"}
SLIDE = {"joints": {"left_e1": {"unit": "m"}, "lift": {"unit": "rad"}}}
BROKEN = {
    "limits_kept": False,
    "max_position_violation_rad": 0.02,
    "most_violated_joint": "left_e1",
}
MISSED = {"clock": "real_time", "deadline_misses": 7}
REASON = "the promise needs a command in every period"


@pytest.mark.parametrize(
    ("changed", "said", "unsaid"),
    [
        ({}, "no limit was broken, at any physics step.", "deadlines"),
        (MISSED, "no limit was broken, at any physics step; 7 of 6145 deadlines were", REASON),
        (BROKEN, "limits were BROKEN: position by 0.02 rad (left_e1).", REASON),
        (BROKEN | MISSED, f"7 of 6145 deadlines were missed: {REASON}", "braked"),
        (BROKEN | {"braked_periods": 9}, REASON, "speed"),
        (BROKEN | MISSED | {"bounds_method": "naive"}, "deadlines were missed.", REASON),
        (BROKEN | FAST, "speed by 0.5 rad/s", "torque"),
        (BROKEN | FAST | SLIDE, "position by 0.02 m (left_e1); speed by 0.5 m/s (left", "rad"),
        ({"limits_kept": False, "max_torque_ratio": 1.2}, "torque, 1.2 of its limit", "position"),
        ({"limits_kept": False, "max_torque_rate_ratio": 3.0}, "rate, 3 of its limit", "speed"),
        ({"recording_lost_periods": 9}, "recording lacks messages of 9 of 6145 periods", REASON),
        ({"torque_rates_clipped": True}, "limits are not promised", REASON),
    ],
)
def test_the_verdict_names_what_was_broken_and_why(changed, said, unsaid):
    text = verdict(KEPT | changed)
    assert said in text
    assert unsaid not in text
