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
    "max_position_violation_rad": 0.0,
    "max_velocity_violation_rad_s": 0.0,
    "max_torque_ratio": 0.9,
    "most_violated_joint": None,
}
BROKEN = {
    "limits_kept": False,
    "max_position_violation_rad": 0.02,
    "most_violated_joint": "left_e1",
}
REASON = "the promise needs a command in every period"


@pytest.mark.parametrize(
    ("changed", "said", "unsaid"),
    [
        ({}, "no limit was broken, at any physics step.", "deadlines"),
        ({"clock": "real_time"}, "step; 0 of 6145 deadlines were missed.", REASON),
        (
            {"clock": "real_time", "deadline_misses": 7, "braked_periods": 2},
            "step; 7 of 6145 deadlines were missed; the robot braked without commands for 2 of "
            "6145 periods.",
            REASON,
        ),
        (
            {"torque_rates_clipped": True},
            "step; torque_rate_max is clipped: limits are not promised with it.",
            REASON,
        ),
        ({"late_periods": 4}, "; the simulation itself was late by 4 periods.", REASON),
        (BROKEN, "limits were BROKEN: position by 0.02 rad (left_e1).", REASON),
        (
            BROKEN | {"clock": "real_time", "deadline_misses": 1372},
            f"position by 0.02 rad (left_e1); 1372 of 6145 deadlines were missed: {REASON}",
            "braked",
        ),
        (BROKEN | {"clock": "real_time", "braked_periods": 9}, REASON, "speed"),
        # These bounds break limits by themselves.
        (
            BROKEN | {"clock": "real_time", "deadline_misses": 3, "bounds_method": "naive"},
            "3 of 6145 deadlines were missed.",
            REASON,
        ),
        (
            BROKEN | {"max_velocity_violation_rad_s": 0.5, "max_torque_ratio": 1.2},
            "(left_e1); speed by 0.5 rad/s; torque, 1.2 of its limit.",
            "deadlines",
        ),
    ],
)
def test_the_verdict_names_what_was_broken_and_why(changed, said, unsaid):
    text = verdict(KEPT | changed)
    assert said in text
    assert unsaid not in text
