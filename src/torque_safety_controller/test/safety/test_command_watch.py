# SPDX-License-Identifier: Apache-2.0
"""The watch over torques that the motors do not give."""

import numpy as np
import pytest

from torque_safety_controller.safety.command_watch import AGAIN, ENOUGH, IGNORED, CommandWatch

TOLERANCE = np.array([1.0, 0.5])  # N m
REACH = 3
DT = 0.002  # s


def wave(k):
    """A command that changes by less than the tolerance in a period, and by more in `REACH`."""
    return np.array([20.0, 5.0]) * np.sin(0.04 * k)


class Loop:
    """Motors that give the commands, some periods late, or something else."""

    def __init__(self, late=0, moving=False):
        self.watch = CommandWatch(TOLERANCE, REACH)
        self.sent, self.late, self.moving, self.slowed = [], late, moving, False

    def look(self, off=0.0, effort=None):
        """Show a state, `off` tolerances beside the command; return whether it agrees."""
        given = self.sent[-1 - min(self.late, len(self.sent) - 1)] if self.sent else np.zeros(2)
        # The last bits of a sensor change.
        self.watch.effort[:] = given + off * TOLERANCE + 1e-9 * (len(self.sent) % 2)
        if effort is not None:
            self.watch.effort[:] = effort
        agrees = self.watch.look(self.slowed, DT)
        self.slowed = self.slowed or self.watch.ignored
        self.sent.append(wave(len(self.sent) if self.moving else 30))
        self.watch.note(self.sent[-1])
        return agrees

    def agree(self, count=ENOUGH + 1):
        assert all(self.look() for _ in range(count))


@pytest.mark.parametrize("late", range(REACH))
def test_commands_that_act_within_their_reach_are_never_doubted(late):
    loop = Loop(late, moving=True)
    loop.agree(500)
    assert loop.watch.times == 0
    assert loop.watch.seen < 1e-8


def test_commands_that_act_later_are_ignored():
    loop = Loop(moving=True)
    loop.agree()
    loop.late = REACH + 20
    seen = [loop.look() for _ in range(200)]
    assert seen.count(False) > 150
    assert loop.watch.times == 1


@pytest.mark.parametrize("off", [1.2, -1.2, np.nan, np.inf])
def test_they_are_ignored_after_some_states_and_act_again_at_once(off):
    loop = Loop()
    loop.agree()
    for row in range(1, 10):
        assert not loop.look(off=np.array([0.0, off]))
        assert loop.watch.in_row == row
        assert loop.watch.ignored == (row >= IGNORED)
        assert loop.watch.ignored_for == pytest.approx(row * DT)
    loop.agree(1)
    assert not loop.watch.ignored
    assert loop.watch.ignored_for == 0.0
    assert loop.watch.times == 1


def test_a_single_wrong_torque_is_not_relied_on_and_changes_nothing():
    loop = Loop()
    loop.agree()
    for _ in range(20):
        assert not loop.look(off=5.0)
        loop.agree(3)
    assert loop.watch.times == 0


@pytest.mark.parametrize("effort", [0.0, 40.0, np.nan])
def test_a_robot_whose_torques_never_agree_is_not_watched(effort):
    loop = Loop()
    for k in range(1000):  # now and then zero is right
        assert loop.look(effort=effort)
        assert loop.watch.times == 0, k


def test_what_holds_an_arm_that_goes_on_must_agree_better():
    loop = Loop()
    loop.agree()
    assert loop.look(off=0.8)
    loop.watch.seen = 0.1
    for _ in range(IGNORED):
        loop.look(off=5.0)
    assert not loop.look(off=0.3)
    assert loop.look(off=0.15)  # up to twice what was seen
    loop.slowed = False
    assert loop.look(off=0.8)


def test_no_arm_is_slowed_for_ever_by_what_is_within_the_tolerance():
    loop = Loop()
    loop.agree()
    for _ in range(IGNORED):
        loop.look(off=5.0)
    states = 0
    while not loop.look(off=0.9):
        states += 1
        assert states < 2000
    assert states > 500  # an outage teaches little


def test_a_restart_forgets_the_commands():
    loop = Loop()
    loop.agree()
    for _ in range(IGNORED):
        loop.look(off=5.0)
    loop.watch.reset()
    assert not (loop.watch.ignored or loop.watch.doubted)
    assert loop.look(off=5.0)  # of the arm that was there before
    assert loop.watch.times == 1


def test_torques_that_stay_the_same_to_the_last_bit_are_stuck_and_tried_again():
    loop = Loop()
    loop.agree()
    frozen = loop.sent[-1] + 3.0 * TOLERANCE
    seen = []
    for _ in range(round(3 * AGAIN / DT)):
        assert not loop.look(effort=frozen)
        seen.append(loop.watch.stuck)
    assert seen.index(True) == IGNORED  # the first one was another
    tried = np.flatnonzero(np.diff(np.array(seen, dtype=int)) == -1)
    assert np.diff(tried) * DT == pytest.approx(AGAIN, abs=10 * DT)
    while not loop.watch.stuck:
        loop.look(effort=frozen)
    assert not loop.look(effort=frozen + 1e-9)  # they change: it sees the motors again
    assert not loop.watch.stuck
    assert loop.watch.ignored
    assert loop.watch.times == 1
