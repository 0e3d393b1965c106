# SPDX-License-Identifier: Apache-2.0
from sim_bridge.node.commands import CommandOutage


def news(outage, *silent):
    return [text for each in silent if (text := outage.count(each))]


def test_nothing_is_said_before_the_first_command():
    assert news(CommandOutage(5, 3), *[True] * 20, *[False] * 20) == []


def test_an_outage_is_told_once_when_it_begins_and_once_when_it_is_over():
    outage = CommandOutage(5, 3)
    assert news(outage, False, True) == ["no command for 6 periods: stopping until they are back"]
    # A busy machine: commands come and go, none for as long as it takes to count as back.
    assert news(outage, *[True, False, True, False, False] * 100, True) == []
    (end,) = news(outage, *[False] * 50)
    assert end == "commands are back; the robot stopped itself for 202 periods"
    assert len(news(outage, True, *[False] * 3)) == 2
