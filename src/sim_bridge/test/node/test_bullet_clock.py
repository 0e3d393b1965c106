# SPDX-License-Identifier: Apache-2.0
"""The robot node in time: lockstep, real time, and commands that fail."""

import time

import numpy as np
import pytest
from robot_probe import BRAKES, PERIOD, Q, RobotProbe
from std_srvs.srv import SetBool, Trigger


def test_an_unanswered_state_is_sent_again_and_nothing_moves(ros):
    robot = RobotProbe(ros)
    ros.wait_until(lambda: len(robot.states) >= 3, "repeats")
    assert set(robot.states.stamps) == {PERIOD}


def test_positions_are_held_for_the_time_out_and_then_braked(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=3, **BRAKES)
    ros.wait_until(
        lambda: robot.reported("control") == "position",
        each=lambda: robot.send(robot.stamp, q=Q),
        period=0.001,
    )
    robot.await_reported("control", "brakes")
    assert int(robot.reported("deadline_misses")) >= 3
    np.testing.assert_allclose(robot.q, Q, rtol=0.0, atol=1e-3)


def test_in_real_time_it_keeps_its_rate_and_brakes_without_commands(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=3, **BRAKES)
    # Not one command yet: the brakes hold it, and no deadline has been missed.
    ros.wait_until(lambda: int(robot.reported("braked_periods") or 0) > 10)
    assert robot.reported("deadline_misses") == "0"
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)
    assert 50.0 < float(robot.reported("rate_hz")) < 120.0

    def answer():
        robot.send(robot.stamp, robot.gravity() + 0.3)

    ros.wait_until(
        lambda: np.abs(robot.v).max() > 1e-3, "motion under commands", each=answer, period=0.001
    )
    braked = int(robot.reported("braked_periods"))
    # Silence: held for three periods, then braked to rest.
    ros.wait_until(lambda: np.abs(robot.v).max() < 1e-6, "rest under the brakes")
    ros.wait_until(lambda: int(robot.reported("braked_periods")) > braked)
    ros.wait_until(lambda: int(robot.reported("deadline_misses")) >= 3)
    assert "braking" in robot.reported("message")


@pytest.mark.parametrize("delay", [1, 4])
def test_commands_may_come_as_late_as_they_act(ros, delay):
    """As over a network: each answers the state of two periods ago."""
    robot = RobotProbe(ros, clock="real_time", rate_hz=25.0, command_delay=delay, **BRAKES)
    ros.wait_until(lambda: len(robot.states) > 3, "states")

    def answer():
        robot.send(robot.states.stamps[-3], robot.gravity() + 0.3)

    if delay == 1:
        late = "not for this period"
        ros.wait_until(lambda: late in robot.reported("commands_refused"), each=answer)
        assert robot.reported("control") == "brakes"
        return
    ros.wait_until(lambda: robot.reported("control") == "torque", each=answer, period=0.01)
    ros.wait_until(lambda: np.abs(robot.v).max() > 1e-3, "motion", each=answer, period=0.01)
    assert float(robot.reported("latency_p50_us")) > 0.07e6


def test_periods_in_which_it_was_late_itself_are_counted(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0)
    ros.wait_until(lambda: robot.reported("late_periods"))
    before = int(robot.reported("late_periods"))
    end = time.monotonic() + 0.1
    while time.monotonic() < end:
        pass  # as another callback of its process would
    ros.wait_until(lambda: int(robot.reported("late_periods")) >= before + 8)
    assert float(robot.reported("period_error_max_us")) > 0.08e6


def test_when_commands_fail_it_stops_within_its_limits_and_goes_on_when_they_return(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=2)
    robot.await_reported("control", "brakes")  # there was no command yet
    assert robot.node._robot._brakes.all()
    push = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def answer():
        robot.send(robot.stamp, robot.gravity() + push)

    ros.wait_until(lambda: robot.v[0] > 0.3, "motion under commands", each=answer, period=0.001)
    robot.await_reported("control", "stopped")
    ros.wait_until(lambda: np.abs(robot.v).max() < 1e-6, "rest")
    assert robot.reported("message") == "stopped: no commands"
    assert int(robot.reported("braked_periods")) > 2
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


def test_the_brakes_hold_it_again_after_a_reset(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=1)
    ros.wait_until(
        lambda: robot.reported("control") == "torque",
        each=lambda: robot.send(robot.stamp, robot.gravity()),
        period=0.001,
    )
    robot.await_reported("control", "stopped")
    ros.call(Trigger, "bullet_node/reset", Trigger.Request())
    robot.await_reported("control", "brakes")


def test_the_first_period_after_a_pause_is_a_whole_one(ros):
    """Resumed anywhere between two ticks, a robot leaves time to answer before the next."""
    robot = RobotProbe(ros, clock="real_time", rate_hz=5.0)
    known = {"stamp": 0}

    def answer():
        if robot.stamp != known["stamp"]:
            known["stamp"] = robot.stamp
            robot.send(robot.stamp, robot.gravity())

    def misses():
        ros.diagnostics.clear()
        ros.wait_until(lambda: robot.reported("deadline_misses"), each=answer, period=0.0)
        return int(robot.reported("deadline_misses"))

    ros.wait_until(lambda: robot.reported("message") == "running", each=answer, period=0.0)
    for _ in range(5):  # a busy machine may stall for longer than a period
        before = misses()
        for wait in (0.05, 0.1, 0.15):
            ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=True))
            ros.run_for(wait)
            paused_at = robot.stamp
            ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))
            ros.wait_until(
                lambda s=paused_at: robot.stamp > s + 200_000_000, each=answer, period=0.0
            )
        if misses() == before:
            return
    pytest.fail("a deadline is missed after each pause")
