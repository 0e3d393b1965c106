# SPDX-License-Identifier: Apache-2.0
"""Limits are kept in continuous time, whatever happens within what is declared."""

from dataclasses import replace

import numpy as np
import pytest
from adversary import VIOLATION
from imperfect_robot import ImperfectRobot, random_plan

JOINTS, MOTIONS, STEPS = 40, 8, 250
KINDS = {
    "errors of the states": {},
    "2 periods late": {"delay": 2},
    "rows of 2 missed": {"missed_deadlines": 2},
    "rows of 20 missed": {"missed_deadlines": 20},
    "late, and missed": {"delay": 2, "missed_deadlines": 1},
    "at times later": {"delay_jitter": 1},
    "late, at times later": {"delay": 2, "delay_jitter": 1},
    "motors with a lag": {"motor_bandwidth": 10.0},
    "all of it": {
        "delay": 1,
        "delay_jitter": 1,
        "missed_deadlines": 2,
        "motor_bandwidth": 20.0,
    },
}


@pytest.mark.parametrize("predicted", [True, False], ids=["predicted", "as reported"])
@pytest.mark.parametrize("kind", KINDS)
def test_limits_hold_for_ever(kind, predicted):
    rng = np.random.default_rng(1)
    for _ in range(2):
        plan = random_plan(rng, JOINTS, predicted=predicted, **KINDS[kind])
        assert len(plan.limits) > 0.4 * JOINTS
        robot = ImperfectRobot(plan, MOTIONS, rng).run(STEPS)
        assert robot.lost == 0
        assert robot.seen.worst <= VIOLATION


@pytest.mark.parametrize("kind", ["errors of the states", "rows of 2 missed", "late, and missed"])
def test_limits_hold_where_the_discrete_time_condition_fails(kind):
    rng = np.random.default_rng(2)
    reduced = 0
    for _ in range(3):
        plan = random_plan(rng, JOINTS, shortest=0.03, **KINDS[kind])
        reduced += (~plan.solver.exact).sum()
        robot = ImperfectRobot(plan, MOTIONS, rng).run(STEPS)
        assert robot.lost == 0
        assert robot.seen.worst <= VIOLATION
    assert reduced >= 5


POSITION = (
    "errors of the states",
    "2 periods late",
    "rows of 2 missed",
    "late, and missed",
    "motors with a lag",
)
HALVED = [("position", kind) for kind in KINDS if kind in POSITION]
HALVED += [("velocity", kind) for kind in KINDS]


@pytest.mark.parametrize(("margin", "kind"), HALVED)
def test_half_of_a_margin_does_not_keep_them(margin, kind):
    """Save that of the position where the horizon is long, or a delay changes."""
    shares = (0.5, 1.0) if margin == "position" else (1.0, 0.5)
    rng = np.random.default_rng(3)
    plan = random_plan(rng, JOINTS, shares=shares, **KINDS[kind])
    assert ImperfectRobot(plan, MOTIONS, rng).run(STEPS).seen.worst > 1e-4


def test_a_row_of_missed_deadlines_needs_its_horizon():
    rng = np.random.default_rng(4)
    short = random_plan(rng, JOINTS, missed_deadlines=1)
    worse = replace(short, declared=replace(short.declared, missed_deadlines=2))
    assert ImperfectRobot(short, MOTIONS, rng).run(STEPS).seen.worst <= VIOLATION
    assert ImperfectRobot(worse, MOTIONS, rng).run(STEPS).seen.worst > 1e-4
