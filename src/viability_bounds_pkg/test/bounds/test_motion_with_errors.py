# SPDX-License-Identifier: Apache-2.0
"""Limits are kept in continuous time, whatever happens within what is declared."""

from dataclasses import replace

import numpy as np
import pytest
from adversary import VIOLATION
from imperfect_robot import ImperfectRobot, random_declarations

STEPS = 250
KINDS = {
    "errors of the states": {},
    "rows of 20 missed": {"missed_deadlines": 20},
    "late, and missed": {"delay": 2, "missed_deadlines": 1},
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
    limits, declared = random_declarations(rng, **KINDS[kind])
    seen = ImperfectRobot(limits, declared, 0.003, rng, predicted).run(STEPS).seen
    assert seen.lost == 0
    assert seen.worst <= VIOLATION


@pytest.mark.parametrize(
    ("kind", "dt"), [("errors of the states", 0.15), ("rows of 20 missed", 0.01)]
)
def test_limits_hold_where_the_discrete_time_condition_fails(kind, dt):
    rng = np.random.default_rng(2)
    robot = ImperfectRobot(*random_declarations(rng, **KINDS[kind]), dt, rng).run(STEPS)
    assert (~robot.solver.exact).sum() >= 5
    assert robot.seen.lost == 0
    assert robot.seen.worst <= VIOLATION


HALVED = [("position", kind) for kind in ("errors of the states", "late, and missed")]
HALVED += [("velocity", kind) for kind in KINDS]


@pytest.mark.parametrize(("margin", "kind"), HALVED)
def test_half_of_a_margin_does_not_keep_them(margin, kind):
    """Save that of the position where the horizon is long, or a delay changes."""
    shares = (0.5, 1.0) if margin == "position" else (1.0, 0.5)
    rng = np.random.default_rng(3)
    declarations = random_declarations(rng, **KINDS[kind])
    robot = ImperfectRobot(*declarations, 0.003, rng, shares=shares)
    assert robot.run(STEPS).seen.worst > 1e-4


def test_a_row_of_missed_deadlines_needs_its_horizon():
    rng = np.random.default_rng(4)
    limits, declared = random_declarations(rng, missed_deadlines=1)
    robot = ImperfectRobot(limits, declared, 0.003, rng)
    robot.declared = replace(declared, missed_deadlines=2)
    assert robot.run(STEPS).seen.worst > 1e-4
