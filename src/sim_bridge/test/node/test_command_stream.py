# SPDX-License-Identifier: Apache-2.0
"""Commands as they arrive: in time, late, of a rival, refused."""

from collections import Counter

import numpy as np
import pytest
from robot_probe import JOINTS, PERIOD, VALUES, Q

from sim_bridge.node.bullet_parameters import BulletConfiguration
from sim_bridge.node.commands import CommandStream
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import joint_state

NOW = 100 * PERIOD
TAU = [1.0] * 7


class Robot:
    """A stream, and what it says."""

    def __init__(self, **changed):
        self.refused, self.said = Counter(), []
        config = read(BulletConfiguration, VALUES | {"clock": "real_time"} | changed)
        self.stream = CommandStream(config, self.refused, self.said.append)

    def takes(self, stamp, tau=TAU, *, ended=False, paused=False):
        message = joint_state(JOINTS, stamp, tau=tau)
        now = self.stream.accept(message, NOW, 0.0, ended=ended, paused=paused)
        if now:
            self.stream.proceed()
        return now


def test_the_command_of_the_period_acts_and_is_clipped():
    robot = Robot()
    assert robot.takes(NOW, [1e4] * 7)
    np.testing.assert_array_equal(robot.stream.acting.tau, VALUES["torque_max"])
    assert robot.stream.torque_ratio == pytest.approx(1e4 / min(VALUES["torque_max"]))
    assert not robot.refused


@pytest.mark.parametrize("stamp", [NOW - PERIOD, NOW + PERIOD, NOW + 1])
def test_one_for_another_period_is_counted_and_told_when_no_other_comes(stamp):
    robot = Robot()
    for _ in range(50):
        assert not robot.takes(stamp)
    assert robot.refused == {"not for this period": 50}
    (said,) = robot.said
    assert said.startswith("joint_commands refused: 50 in a row")
    assert robot.stream.acting is None
    assert robot.takes(NOW)


def test_one_that_comes_twice_is_for_no_period():
    robot = Robot()
    robot.stream.proceed()
    assert not robot.takes(NOW, ended=True)
    assert robot.refused == {"not for this period": 1}


def test_a_late_one_acts_when_it_would_have_acted_anyhow():
    robot = Robot(command_delay=2)
    stream = robot.stream
    stream.proceed()
    assert not robot.takes(NOW - PERIOD)  # it does not end the period
    assert not robot.refused
    assert not robot.takes(NOW - PERIOD)  # for the second time
    assert robot.refused == {"not for this period": 1}
    stream.proceed()
    assert stream.acting is None
    stream.proceed()
    np.testing.assert_array_equal(stream.acting.tau, TAU)


def test_during_a_pause_none_is_obeyed():
    robot = Robot()
    assert not robot.takes(NOW, paused=True)
    assert not robot.takes(NOW + PERIOD, paused=True)
    assert robot.stream.acting is None
    assert not robot.refused


def test_what_cannot_be_read_is_told_once_and_counted():
    robot = Robot()
    for _ in range(2):
        assert not robot.takes(NOW, [np.nan] * 7)
    assert robot.refused == {"not finite": 2}
    assert robot.said == ["joint_commands refused: not finite"]


def test_one_for_a_state_of_a_pause_does_not_act_after_it():
    """With a delay it would be in time for the first period."""
    robot = Robot(command_delay=1)
    robot.stream.resume(NOW - PERIOD)
    robot.takes(NOW - PERIOD)
    robot.stream.proceed()
    assert robot.stream.acting is None


def test_the_last_one_is_held_for_the_time_out():
    robot = Robot(command_timeout=3)
    assert robot.takes(NOW)
    for _ in range(3):
        robot.stream.proceed()
        assert robot.stream.acting is not None
    robot.stream.proceed()
    assert robot.stream.acting is None
    assert (robot.stream.missed, robot.stream.missed_in_row) == (4, 4)
    assert robot.said == ["no command for 4 periods: stopping until they are back"]
    robot.stream.restart()
    assert (robot.stream.missed, robot.stream.missed_in_row) == (0, 0)


def test_positions_are_commands_too():
    robot = Robot()
    message = joint_state(JOINTS, NOW, Q)
    message.velocity = []
    assert robot.stream.accept(message, NOW, 0.0, ended=False, paused=False)
    robot.stream.proceed()
    np.testing.assert_array_equal(robot.stream.acting.q, Q)
