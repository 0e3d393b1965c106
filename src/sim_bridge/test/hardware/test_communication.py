# SPDX-License-Identifier: Apache-2.0
"""Commands on their way to the drives: lost, delayed, late."""

from collections import Counter
from itertools import groupby

import pytest
from robot_probe import JOINTS, PERIOD, VALUES

from sim_bridge.command_path import CommandPath
from sim_bridge.hardware import Imperfections
from sim_bridge.node.bullet_parameters import BulletConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.ros.commands import CommandStream
from viability_bounds_pkg.testing.ros_harness import joint_state


def make(**given):
    return CommandPath(Imperfections(**given))


def arriving(path, command):
    """Return what acts in a period in which a command comes; None for none."""
    if command is not None:
        assert path.send(command)
    return path.due()


def rows(path, count=20_000):
    """Return the lengths of rows of lost commands."""
    lost = [arriving(path, k) is None for k in range(count)]
    return [len(list(group)) for value, group in groupby(lost) if value]


@pytest.mark.parametrize(("probability", "longest"), [(0.3, 4), (0.9, 3)])
def test_deadlines_are_missed_as_often_as_asked_and_never_in_longer_rows(probability, longest):
    missed = rows(make(missed_probability=probability, missed_in_row=longest))
    assert max(missed) == longest
    # The stationary share of a chain that goes on with that probability and ends at the longest.
    all_of_row = probability ** (longest + 1)
    expected = (probability - all_of_row) / (1.0 - all_of_row)
    assert sum(missed) / 20_000 == pytest.approx(expected, abs=0.012)


def test_the_seed_decides_which():
    losses = []
    for seed in (0, 0, 1):
        path = make(missed_probability=0.3, imperfection_seed=seed)
        losses.append([arriving(path, k) is None for k in range(200)])
    assert losses[0] == losses[1] != losses[2]


def test_outages_have_all_lengths_up_to_the_longest():
    outages = rows(make(outage_probability=0.02, outage_longest=10))
    single = [length for length in outages if length <= 10]  # others started as the last ended
    assert len(single) > 0.95 * len(outages)
    assert set(single) == set(range(1, 11))
    assert sum(single) / len(single) == pytest.approx(5.5, abs=0.4)


def test_an_outage_leaves_the_missed_deadlines_as_they_were():
    missed, both = (
        make(missed_probability=0.3, outage_probability=probability, outage_longest=9)
        for probability in (0.0, 0.1)
    )
    alone = {k for k in range(300) if arriving(missed, k) is None}
    lost = {k for k in range(300) if arriving(both, k) is None}
    assert lost > alone
    assert both.missed == len(lost)


@pytest.mark.parametrize("delay", [0, 3])
def test_a_command_arrives_so_many_periods_later_or_never(delay):
    path = make(command_delay=delay, missed_probability=0.4, missed_in_row=3)
    arrived = [arriving(path, k) for k in range(300)]
    assert arrived[:delay] == [None] * delay
    assert set(arrived[delay:]) <= {None, *range(300 - delay)}
    assert all(command in (None, k) for k, command in enumerate(arrived[delay:]))
    lost_so_far = arrived[delay:].count(None)
    assert 50 < lost_so_far <= path.missed <= lost_so_far + delay


def test_a_period_without_a_command_is_not_a_missed_one():
    path = make(missed_probability=0.9, missed_in_row=100)
    assert [arriving(path, None) for _ in range(50)] == [None] * 50
    assert path.missed == 0


def test_a_command_that_comes_late_acts_at_its_time_unless_that_is_over():
    path = make(command_delay=3)
    for k in range(5):
        arriving(path, k if k in (0, 1) else None)
    assert path.send("again", 3)
    assert not path.send("twice", 3)
    assert not path.send("over", 4)
    assert path.send("newest", 1)
    assert [path.due() for _ in range(3)] == ["again", None, "newest"]
    path.due()
    assert path.absent


NOW = 100 * PERIOD


def accepts(stream, stamp):
    message = joint_state(JOINTS, stamp, tau=[1.0] * 7)
    return stream.accept(message, NOW, 0.0, ended=False, paused=False)


@pytest.fixture
def refused():
    return Counter()


@pytest.fixture
def stream(refused):
    config = read(BulletConfiguration, VALUES)
    path = make(command_delay=2)
    made = CommandStream(config, refused, lambda _: None, lambda tau: tau, lambda: path)
    made.proceed()
    return made


def test_the_stamp_of_a_message_tells_how_late_it_is(stream, refused):
    assert not accepts(stream, NOW - PERIOD)  # it is kept, and does not end the period
    assert not refused
    assert not accepts(stream, NOW - PERIOD)  # for the second time
    assert not accepts(stream, NOW - 3 * PERIOD)
    assert refused == {"not for this period": 2}
    stream.proceed()
    assert stream.acting is None
    stream.proceed()
    assert stream.acting.tau.tolist() == [1.0] * 7


def test_one_for_a_state_of_a_pause_does_not_act_after_it(stream):
    """With a delay it would be in time for the first period."""
    stream.resume(NOW - PERIOD)
    accepts(stream, NOW - PERIOD)
    for _ in range(3):
        stream.proceed()
        assert stream.acting is None
