# SPDX-License-Identifier: Apache-2.0
"""TALOS with friction, compliant in its null space or at its hand.

Shorter runs of what `scripts/reproduce.sh paper1-compliance` plays. The simulated sensor has bias
and noise, and a tool heavier than the URDF says.
"""

import compliance_curve as curve
import compliance_push as pushing
import numpy as np
import pinocchio as pin
import pytest
from compliance_hand import ELBOW, ELBOW_PUSH, HAND, PULL, ROBOT, lead
from direct import DirectLoop, within_limits

pytestmark = pytest.mark.long

LACKING, COMPLIANT = pushing.MODES


def test_a_pushed_elbow_gives_way_and_the_hand_stays_as_stiff():
    runs = {name: pushing.push(own, axes="z", held=0.7) for name, own in pushing.MODES.items()}
    found = {name: pushing.judge(run) for name, run in runs.items()}
    moved = {name: each["witness_motion_rad"] for name, each in found.items()}
    assert moved[COMPLIANT] > 0.1
    assert moved[COMPLIANT] > 3.0 * moved[LACKING]
    assert found[COMPLIANT]["hand_m"] < 5e-3
    assert found[COMPLIANT]["hand_rad"] < np.radians(1.0)
    assert found[COMPLIANT]["steady_m"] <= found[LACKING]["steady_m"]
    assert all(within_limits(run.loop) for run in runs.values())


def test_unknown_poles_are_given_way_to_and_the_curve_is_drawn():
    run = curve.draw(pushing.MODES[COMPLIANT], curve.POLES, turns=1, period=6.0)
    assert run.touched
    found = curve.judge(run)
    assert found["hand_m"] < 0.02
    assert found["within_limits"]


def test_a_pulled_hand_stays_where_it_is_let_go_and_does_not_yield_for_the_elbow():
    led = lead([(0.7, 1.7, HAND, PULL), (2.2, 3.2, ELBOW, ELBOW_PUSH)], 3.4)
    pulled, released, pushed = led.at(0.7), led.at(1.7), led.at(2.2)
    assert np.linalg.norm(led.place[released] - led.place[pulled]) > 0.01
    assert np.linalg.norm(led.place[released:] - led.place[released], axis=1).max() < 0.007
    assert led.state[pushed] == "holding"
    assert "yielding" not in led.state[pushed:]
    assert np.abs(led.joints[pushed:] - led.joints[pushed]).max() > 0.05
    assert within_limits(led.loop)


def test_a_hand_whose_sensor_falls_silent_is_led_no_more():
    led = lead([(0.7, 2.2, HAND, PULL)], 2.2, silent_at=1.5)
    silent = led.state.index("sensor silent")
    assert led.t[silent] < 1.6
    assert np.linalg.norm(led.place[silent] - led.place[led.at(0.7)]) > 0.005
    # Still pulled at, it is stiff.
    assert np.linalg.norm(led.place[silent:] - led.place[silent], axis=1).max() < 0.005
    assert within_limits(led.loop)


def test_an_arm_with_a_stretched_elbow_gets_away_from_a_goal_beyond_reach():
    """J has lost rank; the arm stays within its limits, and comes to rest."""
    straight = np.array([0.0, 0.15, -0.3, 0.5, -0.3, -0.02, 0.0, 0.0, 0.0])
    loop = DirectLoop(ROBOT, {"start_positions": straight, "integral_action": "task"})
    assert np.linalg.svd(loop.controller.robot.J)[1][-1] < 0.08
    start = loop.pose()
    away = start.translation / np.linalg.norm(start.translation)
    loop.controller.goals.set_pose(pin.SE3(start.rotation, start.translation + 0.2 * away))
    samples = loop.run(2.0)
    last = np.array([sample.error[:3] for sample in samples[-200:]])
    assert np.ptp(last, axis=0).max() < 0.005
    back = start.translation - 0.1 * away
    loop.controller.goals.set_pose(pin.SE3(start.rotation, back))
    loop.run(2.0)
    assert np.linalg.norm(loop.pose().translation - back) < 0.02
    assert within_limits(loop)
