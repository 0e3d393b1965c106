# SPDX-License-Identifier: Apache-2.0
"""The robot node: reset and pause."""

import numpy as np
from robot_probe import PERIOD, Q, RobotProbe
from std_srvs.srv import SetBool, Trigger


def test_reset_brings_it_back_to_the_start_at_rest(ros):
    robot = RobotProbe(ros)
    robot.push("panda_link4", 50.0)
    robot.step(robot.gravity() + 1.0, times=30)
    assert np.abs(robot.q - Q).max() > 1e-4
    robot.send(0, [1.0] * 7)
    ros.wait_until(lambda: "not for this period" in robot.reported("commands_refused"))
    before = robot.stamp
    assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
    ros.wait_until(lambda: robot.stamp > before)
    np.testing.assert_array_equal(robot.q, Q)
    np.testing.assert_array_equal(robot.v, np.zeros(7))
    # The push is gone, and all counts are at zero.
    robot.step(times=5)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)
    ros.wait_until(lambda: robot.reported("periods") == "5")
    assert robot.reported("commands_refused") == "none"


def test_pause_stops_time_and_resuming_asks_anew(ros):
    robot = RobotProbe(ros)
    robot.step(times=2)
    ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=True))
    robot.await_reported("paused", "True")
    stamp = robot.stamp
    robot.send(stamp, robot.gravity())
    ros.run_for(0.1)
    assert robot.stamp == stamp
    ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))
    ros.wait_until(lambda: robot.stamp == stamp + PERIOD, "a state with a new stamp")
    robot.step()


def test_it_pauses_itself_after_the_time_asked_for(ros):
    robot = RobotProbe(ros, start_paused=True)
    ros.accepts("bullet_node", pause_after=0.02)
    ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))
    ros.wait_until(
        lambda: robot.reported("periods") == "10",
        each=lambda: robot.send(robot.stamp, robot.gravity()),
    )
    robot.await_reported("paused", "True")
