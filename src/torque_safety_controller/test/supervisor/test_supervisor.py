# SPDX-License-Identifier: Apache-2.0
"""Events in; mode, reason and share of the goals out. And commands that do not act."""

import math

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from torque_safety_controller.command_check import CommandCheck
from torque_safety_controller.modes import CAUSES, CHANGES, Control, Goals, Mode
from torque_safety_controller.supervisor import Supervisor

DT, COVERED, PAUSE = 0.01, 1, 0.2
REST, MOVES, TAU = np.zeros(2), np.array([0.0, 0.5]), np.array([5.0, -3.0])
TRUSTED = 100
"""States that agree with their commands before one that does not counts."""


class Chain:
    """A supervisor, and what it has told."""

    def __init__(self, control="torque", commands=None):
        self.told, self.warned = [], []
        self.supervisor = Supervisor(
            DT,
            control,
            COVERED,
            PAUSE,
            commands,
            lambda mode, reason: self.told.append((mode, reason)),
            self.warned.append,
        )

    def answer(self, elapsed=DT, v=REST, tau=TAU, failure="", planned=True, **state):
        """Answer a state; return the order."""
        order = self.supervisor.state(elapsed, v, tau, **state)
        by_drives = self.supervisor.by_drives
        self.supervisor.answered(None if by_drives else TAU, failure, planned)
        return order

    def run(self, count, **state):
        """Answer states; return the shares."""
        return [self.answer(**state).share for _ in range(count)]

    @property
    def now(self):
        return self.supervisor.mode, self.supervisor.reason


# How each cause of CAUSES begins, and what else than the next state ends it.
BEGINS = {
    "silent": lambda c: c.supervisor.silent("no joint state"),
    "refused": lambda c: c.supervisor.refused("refused"),
    "failed": lambda c: c.answer(failure="why"),
    "stale": lambda c: c.answer(limits=False),
    "giving back": lambda c: (c.supervisor.enable(False), c.answer(v=MOVES)),
    "no plan": lambda c: c.answer(planned=False),
    "rival": lambda c: c.answer(goal="rival"),
    "moved": lambda c: c.answer(moved="the lift moves"),
    "no goal": lambda c: c.answer(goal="no goal"),
    "moves": lambda c: (c.supervisor.robot_returned("why"), c.answer(None, v=MOVES)),
    "drives": lambda c: (c.supervisor.enable(False), c.answer()),
    "missed": lambda c: c.answer((COVERED + 2) * DT),
    "ignored": lambda c: c.run(3, tau=-TAU),
}
ENDS = {
    "giving back": lambda c: c.supervisor.enable(True),
    "drives": lambda c: (c.supervisor.enable(True), c.supervisor.change("torque known", "why")),
}


def test_without_usable_states_nothing_is_sent_and_without_a_solution_goals_do_not_count():
    stops = {name for name, cause in CAUSES.items() if cause.mode is Mode.STOPPED}
    slows = {name for name, cause in CAUSES.items() if cause.goals is Goals.SLOWED}
    assert stops == {"silent", "refused"}
    assert slows == {"refused", "failed", "stale", "rival", "moved", "moves"}
    into_torque = {before for before, after in CHANGES.items() if after is Control.TORQUE}
    assert into_torque == {(Control.TAKING_OVER, "torque known"), (Control.GIVING_BACK, "enable")}


@pytest.mark.parametrize("name", CAUSES)
def test_each_cause_gives_its_mode_and_its_share_and_ends(name):
    cause, chain = CAUSES[name], Chain(commands=CommandCheck(0.1 * np.abs(TAU), 1))
    assert chain.now == (Mode.STOPPED, "no joint state yet")
    chain.supervisor.robot_returned("")
    chain.answer(None)
    chain.run(TRUSTED)
    BEGINS[name](chain)
    mode, reason = chain.now
    assert mode is (cause.mode or Mode.TRACKING)
    assert not cause.reason or cause.mode is None or reason == cause.reason
    share = chain.supervisor.values()["goal_share"]
    assert (share == 0.0) == (cause.goals is Goals.SLOWED)
    assert (share == 1.0) == (cause.goals in (Goals.KEPT, Goals.ASIDE))
    ENDS.get(name, lambda c: None)(chain)
    chain.answer(v=MOVES)
    if cause.goals is Goals.SLOWED:
        assert chain.now[0] is Mode.HOLD and chain.now[1].startswith("comes to rest: ")
    shares = chain.run(80)  # longer than it takes to get the goals back
    assert chain.now == (Mode.TRACKING, "goal")
    assert shares[-1] == 1.0


def test_the_first_cause_counts_and_a_repeated_state_takes_back_that_the_robot_was_silent():
    chain = Chain()
    chain.answer(None, goal="no goal")
    assert chain.now == (Mode.HOLD, "no goal")
    chain.answer(goal="no goal", limits=False)
    assert chain.now == (Mode.HOLD, "acceleration limits are stale")
    chain.supervisor.silent("no joint state")
    assert chain.now == (Mode.STOPPED, "no joint state")
    chain.supervisor.repeated()
    assert chain.now == (Mode.HOLD, "acceleration limits are stale")
    assert chain.supervisor.stale
    chain.supervisor.limits_came()
    assert not chain.supervisor.stale


def test_rows_of_missed_states_are_counted_and_told_once():
    chain = Chain()
    chain.answer(None)
    assert not chain.answer((COVERED + 1) * DT).forget_disturbance
    order = chain.answer((COVERED + 2) * DT)
    assert order.forget_disturbance and not order.forget_integral
    assert order.share < 1.0
    chain.answer(4 * DT)
    assert chain.now == (Mode.TRACKING, "goal")
    values = chain.supervisor.values()
    assert (values["missed_rows_too_long"], values["missed_row_longest"]) == (2, 3)
    assert "slowed to" in chain.supervisor.trouble
    chain.run(100)
    assert not chain.supervisor.trouble
    assert chain.warned == [
        "2 states in a row without an answer, the bounds cover 1: the arm is slowed",
        "the arm goes on",
    ]


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        ((0, 1), "keeps 67 of 100 Hz here: set rate_hz to 50 (and the robot's)"),
        ((0, 1, 1, 5), "keeps 37 of 100 Hz here: set rate_hz to 33.3 (and the robot's)"),
        ((0, 0, 0, 9), "keeps 31 of 100 Hz here: set rate_hz to 20 (and the robot's)"),
        ((1,), "keeps 50 of 100 Hz here: set rate_hz to 50 (and the robot's)"),
        ((0,), ""),
        ((0,) * 99 + (15,), ""),  # accidents
    ],
)  # fmt: skip
def test_a_machine_that_does_not_keep_the_rate_tells_after_two_seconds_what_to_set(rows, line):
    chain = Chain()
    chain.answer(None)
    for second in range(4):
        for _ in range(math.ceil(1.0 / (DT * (len(rows) + sum(rows))))):
            for row in rows:
                chain.answer((1 + row) * DT)
        told = [each for each in chain.warned if "keeps" in each]
        assert told == [line] * (bool(line) and second > 0)


def test_a_pause_in_which_the_robot_stops_itself_holds_the_arm_until_it_rests():
    chain = Chain()
    chain.answer(None)
    order = chain.answer(PAUSE + 2 * DT, v=MOVES)
    assert order.share == 0.0 and order.forget_disturbance and order.forget_integral
    chain.run(20, v=MOVES)
    assert chain.now[0] is Mode.HOLD and "states were not answered" in chain.now[1]
    chain.run(2)
    assert chain.now == (Mode.TRACKING, "goal")


# Control


def reach(start, control) -> Chain:
    """Return a chain that has come to a control by events."""
    chain = Chain(start)
    supervisor = chain.supervisor
    if start == "position":
        supervisor.enable(True)
        supervisor.change("torque known", "here")
    if control is not Control.TORQUE:
        supervisor.enable(False)
    if control in (Control.POSITION, Control.TAKING_OVER):
        supervisor.change("at rest", "here")
    if control is Control.TAKING_OVER:
        supervisor.enable(True)
    assert supervisor.control is control
    return chain


@pytest.mark.parametrize(
    ("start", "control", "after"),
    [
        ("torque", Control.TORQUE, Control.TORQUE),
        ("position", Control.TORQUE, Control.POSITION),
        ("torque", Control.TAKING_OVER, Control.POSITION),
        ("torque", Control.GIVING_BACK, Control.POSITION),
        ("torque", Control.POSITION, Control.POSITION),
    ],
)
def test_a_robot_that_was_away_does_not_get_torque_unasked(start, control, after):
    chain = reach(start, control)
    chain.supervisor.robot_returned("")
    assert chain.supervisor.control is after


def test_an_arm_comes_to_rest_before_its_drives_get_it_but_is_not_waited_for_for_ever():
    chain = Chain()
    chain.answer(None)
    chain.supervisor.enable(False)
    assert not chain.answer(v=MOVES).track
    assert chain.now == (Mode.HOLD, "on the way to position control")
    chain.answer()
    assert chain.now == (Mode.POSITION, "enable_torque")
    chain = reach("torque", Control.GIVING_BACK)
    chain.run(round(1.9 / DT), v=MOVES)
    assert chain.supervisor.control is Control.GIVING_BACK
    chain.run(round(0.2 / DT), v=MOVES)
    assert chain.supervisor.control is Control.POSITION


# Commands that do not act


def test_commands_count_as_ignored_from_the_third_state_in_a_row_on_that_disagrees():
    check = CommandCheck(np.array([1.0, 2.0]), reach=3)
    for k in range(3 * TRUSTED):  # torques of another kind, which agree by chance only
        check.sent(TAU)
        assert check.agrees(TAU if k % TRUSTED else np.zeros(2))
    assert check.agrees(np.zeros(2))
    for _ in range(TRUSTED):
        check.sent(TAU)
        assert check.agrees(TAU + [0.9, -1.9])
    check.sent(TAU + 4.0)
    assert check.agrees(TAU + 4.5) and check.agrees(TAU - 0.5), "any of the last three"
    for in_row in (1, 2, 3, 4):
        assert not check.agrees(TAU - [0.0, 2.1])
        assert check.ignored == (in_row >= 3)
    assert not check.agrees(np.array([math.nan, -3.0]))
    assert check.agrees(TAU)
    assert not check.ignored


def test_nothing_is_learned_and_the_integral_fades_while_commands_do_not_act():
    chain = Chain(commands=CommandCheck(0.1 * np.abs(TAU), 1))
    chain.answer(None)
    chain.run(TRUSTED)
    orders = [chain.answer(tau=-TAU) for _ in range(60)]
    assert not any(order.obeyed for order in orders)
    assert [order.forget_disturbance for order in orders[:4]] == [False, False, True, True]
    assert not orders[40].forget_integral and orders[55].forget_integral
    assert orders[1].share == 1.0 and orders[10].share == 0.0
    assert chain.answer(tau=None).obeyed, "it is not known"


# Whatever comes


class Events(RuleBasedStateMachine):
    """Events in any order; times of less than a second."""

    def __init__(self):
        super().__init__()
        self.chain = Chain("torque", CommandCheck(0.1 * np.abs(TAU), 2))
        self.supervisor, self.share = self.chain.supervisor, 1.0
        self.answered = False

    @rule(
        elapsed=st.sampled_from([None, DT, DT, DT, 3 * DT, 0.5]),
        moves=st.booleans(),
        effort=st.sampled_from([None, TAU, TAU, -TAU]),
        limits=st.booleans(),
        goal=st.sampled_from(["", "", "", "no goal", "rival"]),
        failure=st.sampled_from(["", "", "", "why"]),
        planned=st.booleans(),
        count=st.sampled_from([1, 1, 60, 120]),
    )
    def state(self, elapsed, moves, effort, limits, goal, failure, planned, count):
        """States and their answers; some come again and again."""
        supervisor = self.supervisor
        for _ in range(count):
            order = supervisor.state(elapsed, MOVES if moves else REST, effort, limits, goal)
            by_drives = supervisor.by_drives
            assert 0.0 <= order.share <= 1.0
            if not by_drives:
                # It rises by the square of a ramp of half a second.
                assert np.sqrt(order.share) <= np.sqrt(self.share) + DT / 0.5 + 1e-9
                self.share = order.share
            supervisor.answered(None if by_drives else TAU, failure * (not by_drives), planned)
            mode = supervisor.mode
            assert mode is not Mode.STOPPED, "it was answered"
            assert (mode is Mode.POSITION) == by_drives
            if mode is Mode.TRACKING:
                assert limits and not goal and not failure and order.track
        self.answered = True

    @rule(event=st.sampled_from(["silent", "refused"]))
    def stop(self, event):
        """A watchdog barks."""
        getattr(self.supervisor, event)("why")
        assert self.supervisor.mode is Mode.STOPPED

    @rule()
    def repeated(self):
        """A state comes again that was answered."""
        if self.answered:
            self.supervisor.repeated()
            assert self.supervisor.mode is not Mode.STOPPED

    @rule(
        event=st.sampled_from(
            [
                ("limits_came",),
                ("robot_returned", ""),
                ("robot_returned", "the motors held the arm before"),
                ("enable", True),
                ("enable", False),
                ("change", "torque known", "why"),
                ("change", "failed", "why"),
            ]
        )
    )
    def other(self, event):
        """Limits come late, the robot begins anew, the user wants something, a handover ends."""
        name, *arguments = event
        getattr(self.supervisor, name)(*arguments)

    @invariant()
    def mode_has_a_reason(self):
        """Each change is told, with a reason."""
        assert self.supervisor.reason
        if self.chain.told:
            assert self.chain.told[-1] == self.chain.now


TestEvents = Events.TestCase
TestEvents.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
