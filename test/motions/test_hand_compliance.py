# SPDX-License-Identifier: Apache-2.0
"""Hands that yield to who pulls, press on a table, and hold when their sensor falls silent.

With the simulated sensor, its bias, noise and a tool heavier than the URDF says.
"""

import numpy as np
import pinocchio as pin
import pytest
from compliance_hand import (
    ELBOW,
    ELBOW_PUSH,
    FORCE,
    HAND,
    PULL,
    ROBOT,
    judge_press,
    lead,
    press,
    within_limits,
)
from direct import DirectLoop

pytestmark = pytest.mark.long


def test_a_pulled_hand_moves_and_stays_where_it_is_let_go():
    led = lead([(0.7, 2.0, HAND, PULL)], 3.0)
    pulled, released = led.at(0.7), led.at(2.0)
    assert np.linalg.norm(led.place[released] - led.place[pulled]) > 0.02
    kept = np.linalg.norm(led.place[released:] - led.place[released], axis=1)
    assert kept.max() < 0.005
    assert led.state[-1] == "holding"
    assert within_limits(led.loop)


def test_a_push_on_the_elbow_moves_the_arm_but_not_the_hand():
    led = lead([(0.7, 2.7, ELBOW, ELBOW_PUSH)], 3.2)
    assert np.abs(led.joints - led.joints[led.at(0.7)])[led.at(0.7) :].max() > 0.05
    assert np.linalg.norm(led.place, axis=1).max() < 0.005
    assert led.turn.max() < np.radians(1.0)
    assert "yielding" not in led.state
    assert within_limits(led.loop)


def test_a_hand_whose_sensor_falls_silent_is_led_no_more():
    led = lead([(0.7, 3.0, HAND, PULL)], 3.0, silent_at=1.5)
    silent = led.state.index("sensor silent")
    assert led.t[silent] < 1.6
    assert np.linalg.norm(led.place[silent] - led.place[led.at(0.7)]) > 0.005
    # Still pulled at, it is stiff.
    assert np.linalg.norm(led.place[silent:] - led.place[silent], axis=1).max() < 0.005
    assert within_limits(led.loop)


def test_a_table_is_pressed_on_without_a_bounce_while_the_hand_slides():
    run = press(duration=5.6, slide=(2.2, 4.9))
    numbers = judge_press(run)
    assert numbers["error_standing"] < 0.05
    assert numbers["error_sliding"] < 0.05
    assert numbers["most_n"] < FORCE + 2.0
    assert numbers["least_after_contact_n"] > FORCE - 2.0
    assert numbers["periods_without_contact"] == 0.0
    assert numbers["slid_m"] > 0.14
    assert numbers["limits_kept"]


@pytest.mark.parametrize("mode", ["joints", "task"])
def test_a_start_with_a_stretched_elbow_and_a_goal_beyond_reach(mode):
    """J has lost rank; the arm stays within its limits, comes to rest, and gets away again."""
    straight = [0.0, 0.15, -0.3, 0.5, -0.3, -0.02, 0.0, 0.0, 0.0]
    loop = DirectLoop(ROBOT, {"start_positions": np.array(straight), "integral_action": mode})
    assert np.linalg.svd(loop.controller.robot.J)[1][-1] < 0.08
    start = loop.pose()
    away = start.translation / np.linalg.norm(start.translation)
    loop.controller.goals.set_pose(pin.SE3(start.rotation, start.translation + 0.2 * away))
    samples = loop.run(2.5)
    last = np.array([sample.error[:3] for sample in samples[-200:]])
    assert np.ptp(last, axis=0).max() < 0.005
    back = start.translation - 0.1 * away
    loop.controller.goals.set_pose(pin.SE3(start.rotation, back))
    loop.run(2.5)
    assert np.linalg.norm(loop.pose().translation - back) < 0.02
    assert within_limits(loop)
