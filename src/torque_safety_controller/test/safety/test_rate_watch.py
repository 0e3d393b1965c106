# SPDX-License-Identifier: Apache-2.0
"""The watch over rows of states without an answer."""

import numpy as np
import pytest

from torque_safety_controller.safety.rate_watch import (
    FALL_TIME,
    REST_TIME,
    RETURN_TIME,
    RateWatch,
)

DT = 0.002  # s


def after(periods):
    """Return the share so long after the arm has begun to go on."""
    return min(1.0, periods * DT / RETURN_TIME) ** 2


def test_rows_that_the_bounds_cover_change_nothing():
    watch = RateWatch(DT, 2)
    for elapsed in (None, DT, 2 * DT, 3 * DT, 3.4 * DT):
        assert watch.note(elapsed) == ""
        assert watch.share == 1.0
    assert (watch.too_long, watch.longest, watch.trouble) == (0, 2, "")


def test_a_longer_row_stops_the_arm_and_it_goes_on_by_itself():
    watch = RateWatch(DT, 2)
    said = watch.note(7 * DT)
    assert said.startswith("6 states in a row")
    assert "cover 2" in said
    assert watch.share == 0.0
    assert watch.trouble.startswith("slowed to 0%")
    steps = 0
    while watch.slowed:
        said = watch.note(DT)
        steps += 1
        assert watch.share == pytest.approx(after(steps))
    assert steps == pytest.approx(RETURN_TIME / DT, abs=1)
    assert said == "the arm goes on"
    assert watch.note(DT) == ""


def test_after_a_row_in_which_the_robot_may_have_held_its_command_the_share_falls_without_a_step():
    watch, shares = RateWatch(DT, 2), []
    assert watch.note(4 * DT).startswith("3 states in a row")
    while watch.share:
        shares.append(watch.share)
        assert watch.note(DT) == ""
    np.testing.assert_allclose(shares, np.exp(-DT / FALL_TIME * np.arange(1, len(shares) + 1)))
    assert 0.01 < shares[-1] < 0.012
    assert watch.note(DT) == ""
    assert watch.share == pytest.approx(after(1))


def test_a_row_that_was_shorter_does_not_stop_what_falls_already():
    watch = RateWatch(DT, 2)
    watch.note(4 * DT)
    watch.note(2 * DT)
    assert watch.share == pytest.approx(np.exp(-2.0 * DT / FALL_TIME))
    watch.note(9 * DT)
    assert watch.share == 0.0


def test_the_share_does_not_grow_while_it_is_to_wait():
    watch = RateWatch(DT, 2)
    watch.slow("no limits")
    for _ in range(3):
        watch.wait()
        watch.note(DT)
    assert watch.share == 0.0
    watch.note(DT)
    assert watch.share == pytest.approx(after(1))


def test_missed_states_add_nothing_to_the_share():
    watch = RateWatch(DT, 2)
    watch.slow("no limits")
    for periods in (1, 3, 2):
        watch.note(periods * DT)
    assert watch.share == pytest.approx(after(3))


def test_what_had_gone_wrong_takes_the_share_down_gently_where_it_is_to():
    watch = RateWatch(DT, 2)
    watch.slow("motors", gently=True)
    assert watch.share == pytest.approx(np.exp(-DT / FALL_TIME))
    assert watch.trouble == "slowed to 90%: motors"
    watch.slow("motors")
    assert watch.share == 0.0


def test_rows_one_after_the_other_are_told_once():
    watch = RateWatch(DT, 0)
    said = [watch.note(2 * DT if step % 10 == 0 else DT) for step in range(100)]
    assert sum(map(bool, said)) == 1
    assert watch.too_long == 10
    assert watch.share < 0.5


def test_what_had_gone_wrong_slows_the_arm_too():
    watch = RateWatch(DT, 2)
    watch.slow("no limits")
    assert (watch.share, watch.too_long, watch.trouble) == (0.0, 0, "slowed to 0%: no limits")
    said = [watch.note(DT) for _ in range(round(RETURN_TIME / DT) + 1)]
    assert watch.share == 1.0
    assert [each for each in said if each] == ["the arm goes on"]


def test_the_arm_comes_to_rest_before_it_goes_on():
    watch = RateWatch(DT, 2)
    watch.slow("no limits")
    for _ in range(50):
        watch.note(DT, at_rest=False)
        watch.slow("no limits")  # told until it goes on
    assert watch.share == 0.0
    watch.note(DT, at_rest=True)
    assert watch.share > 0.0
    # Only at the beginning: what goals ask for is no braking.
    watch.note(DT, at_rest=False)
    assert watch.share == pytest.approx(after(2))


def test_an_arm_that_is_shaken_goes_on_too():
    watch = RateWatch(DT, 2)
    for _ in range(2):
        watch.slow("no limits")
        waited = 0
        while watch.share == 0.0 and waited * DT < 2.0 * REST_TIME:
            watch.note(DT, at_rest=False)
            waited += 1
        assert waited * DT == pytest.approx(REST_TIME, abs=2 * DT)


def test_what_is_doubted_takes_the_share_down_as_fast_as_it_grows():
    watch = RateWatch(DT, 2)
    watch.slow("not obeyed")
    for _ in range(20):
        watch.note(DT)
    grown = 20
    for at_rest in (True, False):
        for _ in range(30):
            watch.ease(DT)
            watch.note(DT, at_rest)
            grown = max(0, grown - 1)
            assert watch.share == pytest.approx(after(grown), abs=1e-12)
    watch.ease(None)  # the first state
    assert watch.share == 0.0
    watch.note(None)
    watch.note(DT)
    assert watch.share == pytest.approx(after(1)), "it does not go on"
