# SPDX-License-Identifier: Apache-2.0
"""The robot node in time: lockstep, real time, pauses, resets, and commands that fail."""

import time

import numpy as np
from robot_probe import BRAKES, PERIOD, Q, RobotProbe
from std_msgs.msg import Header

from sim_bridge.node.bullet_node import AHEAD
from viability_bounds_pkg.ros.runtime import NEWEST_QOS, set_stamp


def test_an_unanswered_state_is_sent_again_and_nothing_moves(ros):
    robot = RobotProbe(ros)
    ros.wait_until(lambda: len(robot.states) >= 3, "repeats")
    assert set(robot.states.stamps) == {PERIOD}


def test_a_reset_brings_it_back_to_the_start_at_rest(ros):
    robot = RobotProbe(ros)
    robot.push("panda_link4", 50.0)
    robot.step(robot.gravity() + 1.0, times=20)
    assert np.abs(robot.q - Q).max() > 1e-4
    robot.send(0, [1.0] * 7)
    ros.wait_until(lambda: "not for this period" in robot.reported("commands_refused"))
    robot.reset()
    np.testing.assert_array_equal(robot.q, Q)
    np.testing.assert_array_equal(robot.v, np.zeros(7))
    # The push is gone, and all counts are at zero.
    robot.step(times=5)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)
    robot.await_reported("periods", "5")
    assert robot.reported("commands_refused") == "none"


def test_a_pause_stops_time_and_resuming_asks_anew(ros):
    robot = RobotProbe(ros)
    robot.step(times=2)
    robot.pause(True)
    robot.await_reported("paused", "True")
    stamp = robot.stamp
    robot.send(stamp, robot.gravity())
    ros.run_for(0.1)
    assert robot.stamp == stamp
    robot.pause(False)
    ros.wait_until(lambda: robot.stamp == stamp + PERIOD, "a state with a new stamp")
    robot.step()


def test_it_pauses_itself_after_the_time_asked_for(ros):
    robot = RobotProbe(ros, start_paused=True)
    ros.accepts("bullet_node", pause_after=0.02)
    robot.pause(False)
    ros.wait_until(
        lambda: robot.reported("periods") == "10",
        each=lambda: robot.send(robot.stamp, robot.gravity()),
    )
    robot.await_reported("paused", "True")


def test_in_lockstep_it_waits_for_its_recorder(ros):
    robot, header = RobotProbe(ros), Header()
    recorder = ros.talk(Header, "recorded", NEWEST_QOS)
    robot.step()
    for recorded in (robot.stamp, robot.stamp + 5 * PERIOD):
        last = str(recorded + AHEAD * PERIOD)
        set_stamp(header.stamp, recorded)
        recorder.publish(header)
        ros.wait_until(
            lambda end=last: (
                robot.reported("message") == "waiting for the recorder"
                and robot.reported("stamp_ns") == end
            ),
            each=lambda: robot.send(robot.stamp, robot.gravity()),
        )
    robot.reset()  # the recorder was killed
    robot.step(times=AHEAD + 2)


def test_in_real_time_it_moves_by_itself_and_brakes_without_commands(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=3, **BRAKES)
    # Not one command yet: the brakes hold it, and no deadline has been missed.
    ros.wait_until(lambda: int(robot.reported("braked_periods") or 0) > 10)
    assert robot.reported("deadline_misses") == "0"
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)
    ros.wait_until(
        lambda: np.abs(robot.v).max() > 1e-3,
        "motion under commands",
        each=lambda: robot.send(robot.stamp, robot.gravity() + 0.3),
        period=0.001,
    )
    braked = int(robot.reported("braked_periods"))
    # Silence: held for three periods, then braked to rest.
    ros.wait_until(lambda: np.abs(robot.v).max() < 1e-6, "rest under the brakes")
    ros.wait_until(lambda: int(robot.reported("braked_periods")) > braked)
    ros.wait_until(lambda: int(robot.reported("deadline_misses")) >= 3)
    assert robot.reported("message") == "braking: no commands"


def test_when_commands_fail_it_stops_within_its_limits_and_goes_on_when_they_return(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=2)
    robot.await_reported("control", "brakes")  # there was no command yet
    push = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    ros.wait_until(
        lambda: robot.v[0] > 0.3,
        "motion under commands",
        each=lambda: robot.send(robot.stamp, robot.gravity() + push),
        period=0.001,
    )
    robot.await_reported("control", "stopped")
    ros.wait_until(lambda: np.abs(robot.v).max() < 1e-6, "rest")
    assert robot.reported("message") == "stopped: no commands"
    assert max(map(float, robot.reported("velocity_violation_rad_s").split())) == 0.0
    held, q = robot.tau, robot.q
    np.testing.assert_allclose(held, robot.gravity(), atol=0.05)  # of the motors: no brakes

    # Back at rest: the torque that holds it goes on.
    ros.wait_until(
        lambda: robot.reported("control") == "torque",
        "commands",
        each=lambda: robot.send(robot.stamp, held),
        period=0.001,
    )
    np.testing.assert_allclose(robot.q, q, atol=1e-3)
    robot.reset()
    robot.await_reported("control", "brakes")


def test_periods_in_which_it_was_late_itself_are_counted(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0)
    before = int(ros.wait_until(lambda: robot.reported("late_periods")))
    end = time.monotonic() + 0.1
    while time.monotonic() < end:
        pass  # as another callback of its process would
    ros.wait_until(lambda: int(robot.reported("late_periods")) >= before + 8)
    assert float(robot.reported("period_error_max_us")) > 0.08e6
