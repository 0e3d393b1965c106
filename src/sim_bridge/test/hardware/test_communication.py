# SPDX-License-Identifier: Apache-2.0
from itertools import groupby

import pytest

from sim_bridge.command_path import CommandPath
from sim_bridge.hardware import Imperfections


def arriving(path, command):
    """Return what acts in a period in which a command comes; None for none."""
    if command is not None:
        assert path.send(command)
    return path.due()


def drawn(probability, longest, count=40_000, seed=0):
    """Return which of the commands are lost."""
    given = Imperfections(
        missed_probability=probability, missed_in_row=longest, imperfection_seed=seed
    )
    path = CommandPath(given)
    return [arriving(path, k) is None for k in range(count)]


@pytest.mark.parametrize(("probability", "longest"), [(0.05, 4), (0.3, 4), (0.3, 1), (0.9, 3)])
def test_deadlines_are_missed_as_often_as_asked_and_never_in_longer_rows(probability, longest):
    missed = drawn(probability, longest)
    rows = [len(list(group)) for value, group in groupby(missed) if value]
    assert max(rows) == longest
    # The stationary share of a chain that goes on with that probability and ends at the longest.
    all_of_row = probability ** (longest + 1)
    expected = (probability - all_of_row) / (1.0 - all_of_row)
    assert sum(missed) / len(missed) == pytest.approx(expected, abs=0.012)


def test_none_is_missed_without_a_probability():
    assert not any(drawn(0.0, 4, 100))


def test_the_seed_decides_which():
    assert drawn(0.3, 4, 200) == drawn(0.3, 4, 200)
    assert drawn(0.3, 4, 200) != drawn(0.3, 4, 200, seed=1)


def test_outages_have_all_lengths_up_to_the_longest():
    path = CommandPath(Imperfections(outage_probability=0.02, outage_longest=10))
    lost = [arriving(path, k) is None for k in range(40_000)]
    rows = [len(list(group)) for value, group in groupby(lost) if value]
    single = [length for length in rows if length <= 10]  # others started as the last one ended
    assert len(single) > 0.95 * len(rows)
    assert set(single) == set(range(1, 11))
    assert sum(single) / len(single) == pytest.approx(5.5, abs=0.4)


def test_an_outage_leaves_the_missed_deadlines_as_they_were():
    path = CommandPath(
        Imperfections(missed_probability=0.3, outage_probability=0.1, outage_longest=9)
    )
    lost = {k for k in range(300) if arriving(path, k) is None}
    missed = {k for k, each in enumerate(drawn(0.3, 4, 300)) if each}
    assert lost > missed
    assert path.missed == len(lost)


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_a_command_arrives_so_many_periods_later(delay):
    path = CommandPath(Imperfections(command_delay=delay))
    arrived = [arriving(path, k) for k in range(8)]
    assert arrived == [None] * delay + list(range(8 - delay))
    assert path.missed == 0


def test_a_missed_command_arrives_neither_in_time_nor_later():
    path = CommandPath(Imperfections(command_delay=2, missed_probability=0.4, missed_in_row=3))
    arrived = [arriving(path, k) for k in range(300)]
    missed = [k for k, each in enumerate(drawn(0.4, 3, 300)) if each]
    assert path.missed == len(missed) > 50
    assert arrived == [None, None] + [None if k in missed else k for k in range(298)]


def test_a_period_without_a_command_is_not_a_missed_one():
    path = CommandPath(Imperfections(missed_probability=0.9, missed_in_row=100))
    assert [arriving(path, None) for _ in range(50)] == [None] * 50
    assert path.missed == 0


def test_a_command_that_comes_late_acts_at_its_time_unless_that_is_over():
    path = CommandPath(Imperfections(command_delay=3))
    for k in range(5):
        arriving(path, k if k in (0, 1) else None)
    assert path.send("again", 3)
    assert not path.send("twice", 3)
    assert not path.send("over", 4)
    assert path.send("newest", 1)
    assert [path.due() for _ in range(3)] == ["again", None, "newest"]
    path.due()
    assert path.absent


def test_commands_that_come_late_are_lost_as_often():
    path = CommandPath(Imperfections(command_delay=2, missed_probability=0.4, missed_in_row=3))
    acted = []
    for k in range(300):
        path.send(k, 1)
        acted.append(path.due())
        assert not path.absent or k < 1
    missed = {k for k, each in enumerate(drawn(0.4, 3, 300)) if each}
    assert path.missed == len(missed) > 50
    assert acted[1:] == [None if k in missed else k for k in range(299)]
