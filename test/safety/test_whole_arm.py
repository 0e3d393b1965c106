# SPDX-License-Identifier: Apache-2.0
"""Arms with motors that are too weak for their own weight or haste, with the safety filter."""

import numpy as np
import pinocchio as pin
import pytest
from direct import DirectLoop, column

from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter

STIFF = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
"""A posture task that drives each joint to its limits, whatever the hand does."""
SHOULDER = 1
STRETCHED = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Where Baxter's shoulder needs more than it has."""


def load_at(loop, q):
    """What holds the arm, as a share of the torque limits."""
    data = loop.model.createData()
    return np.abs(pin.computeGeneralizedGravity(loop.model, data, q)) / loop.config.torque_max


def random_posture(loop, rng):
    """Return one with half of the joints at their limits."""
    low, high = loop.limits.q_min, loop.limits.q_max
    ends = np.where(rng.random(low.size) < 0.5, low, high)
    return np.where(rng.random(low.size) < 0.5, ends, rng.uniform(low, high))


def race(loop, seconds, seed):
    """Go to random postures, each for 3 s."""
    rng = np.random.default_rng(seed)
    for _ in range(round(seconds / 3.0)):
        loop.controller.goals.set_posture(random_posture(loop, rng))
        loop.run(3.0)


def beyond(loop):
    """The largest violations of position and speed limits, and the largest share of torque."""
    monitor = loop.robot.monitor
    return (
        monitor.max_position_violation.max(),
        monitor.max_velocity_violation.max(),
        monitor.max_torque_ratio.max(),
    )


def assert_kept(loop):
    position, speed, torque = beyond(loop)
    assert position == 0.0
    assert speed == 0.0
    assert torque <= 1.0 + 1e-9


@pytest.mark.long
def test_baxters_shoulder_keeps_its_limits_only_with_the_filter():
    for filtered in (False, True):
        loop = DirectLoop("baxter_left_arm", STIFF | {"safety_filter": filtered})
        race(loop, 18.0, 4)
        if not filtered:
            assert min(beyond(loop)[:2]) > 0.1
    assert_kept(loop)
    outcomes = loop.controller.find(SafetyFilter).outcomes
    assert outcomes["outside"] == 0
    assert outcomes["as wanted"] > 0.9 * outcomes.total()


@pytest.mark.long
@pytest.mark.parametrize(("robot", "seconds"), [("panda", 6.0), ("talos_left_arm", 3.0)])
def test_arms_with_weaker_motors_keep_their_limits(robot, seconds):
    """With limits of acceleration that were found for torque limits of 100%."""
    tau_max = 0.6 * DirectLoop(robot).config.torque_max
    loop = DirectLoop(robot, STIFF | {"safety_filter": True, "torque_max": tau_max.tolist()})
    race(loop, seconds, 0)
    assert_kept(loop)


def test_a_posture_that_cannot_be_held_is_approached_as_far_as_one_that_can():
    loop = DirectLoop("baxter_left_arm", STIFF | {"safety_filter": True})
    assert load_at(loop, STRETCHED)[SHOULDER] > 1.0
    start = loop.robot.state().q
    loop.controller.goals.set_posture(STRETCHED)
    last = loop.run(8.0)[-100:]
    q = column(last, "q")
    assert np.ptp(q, axis=0).max() < 0.02, "it does not stay"
    assert 0.9 < load_at(loop, q[-1])[SHOULDER] <= 0.98
    assert np.abs(q[-1] - STRETCHED).max() < 0.8 * np.abs(start - STRETCHED).max()
    assert beyond(loop)[:2] == (0.0, 0.0)
    assert loop.controller.find(SafetyFilter).outcomes["outside"] == 0


def test_an_arm_that_starts_where_it_cannot_be_held_comes_down_slowly():
    loop = DirectLoop("baxter_left_arm", STIFF | {"safety_filter": True})
    loop.robot.reset(STRETCHED, np.zeros(7))
    loop.begin()
    samples = loop.run(6.0)
    assert loop.controller.find(SafetyFilter).slack >= -1e-3
    assert np.abs(column(samples, "v")[-1]).max() < 0.1
    assert load_at(loop, samples[-1].q)[SHOULDER] < 0.98
    assert beyond(loop)[:2] == (0.0, 0.0)


def test_before_what_cannot_be_held_the_arm_stops_short_of_its_goal():
    """From one side of the horizontal to the other, the elbow straight at both ends."""
    loop = DirectLoop("baxter_left_arm", STIFF | {"safety_filter": True})
    above = np.array([0.0, -1.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    below = np.array([0.0, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    loop.robot.reset(above, np.zeros(7))
    loop.begin()
    loop.controller.goals.set_posture(below)
    samples = loop.run(10.0)
    assert np.abs(samples[-1].q - below).max() > 0.01
    assert np.abs(samples[-1].v).max() < 0.05
    assert beyond(loop)[:2] == (0.0, 0.0)
