# SPDX-License-Identifier: Apache-2.0
"""Commands that do not act are seen in the torques that are reported."""

import math

import numpy as np
import pytest

from torque_safety_controller.command_check import IGNORED_AFTER, TRUSTED_AFTER, CommandCheck

TOLERANCE = np.array([1.0, 2.0])
TAU = np.array([5.0, -3.0])


def agreed(reach=3) -> CommandCheck:
    """Return a check after enough states that agree."""
    check = CommandCheck(TOLERANCE, reach)
    for _ in range(TRUSTED_AFTER):
        check.sent(TAU)
        assert check.agrees(TAU)
    return check


def test_from_the_third_state_in_a_row_on_commands_are_ignored():
    check = agreed()
    for in_row in range(1, IGNORED_AFTER + 3):
        assert not check.agrees(TAU + [0.0, 2.1])
        assert check.ignored == (in_row >= IGNORED_AFTER)
        check.sent(TAU)
    assert check.times == 1
    assert check.agrees(TAU + [0.9, -1.9])
    assert not check.ignored


def test_a_torque_of_any_of_the_last_commands_agrees():
    check = agreed(reach=3)
    for tau in (TAU + 4.0, TAU, TAU):
        check.sent(tau)
    assert check.agrees(TAU + 4.5)
    check.sent(TAU)
    assert not check.agrees(TAU + 4.5)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_agrees_with_nothing(value):
    assert not agreed().agrees(np.array([value, -3.0]))


def test_torques_that_never_agreed_are_of_another_kind():
    check = CommandCheck(TOLERANCE, 3)
    for _ in range(3 * TRUSTED_AFTER):
        check.sent(TAU)
        assert check.agrees(np.zeros(2))
    assert not check.ignored


def test_nothing_is_known_before_the_first_command_and_after_a_reset():
    check = agreed()
    check.reset()
    assert check.agrees(-TAU)
    check.sent(TAU)
    assert check.agrees(-TAU), "it has to agree first"
