# SPDX-License-Identifier: Apache-2.0
"""The safety filter beside everything else that changes torques or constrains accelerations."""

import numpy as np
import pinocchio as pin
import pytest
from direct import DirectLoop, column
from test_collision_avoidance import MARGIN, around_the_wall, play
from test_whole_arm import STIFF, assert_kept, beyond, race, random_posture

from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter

pytestmark = pytest.mark.long

STRONG = {"safety_filter": True}


def weak(robot, share):
    """Parameters of an arm with a share of its torque limits, and the filter."""
    tau_max = share * DirectLoop(robot).config.torque_max
    return STRONG | {"torque_max": tau_max.tolist()}


def test_integral_torque_for_a_small_payload_counts_in_plans():
    """0.3 kg that no model knows: 7% of the shoulder's torque, half of it the integral's."""
    own = {"integral_action": "joints", "integral_budget": [5.0] * 4 + [1.5] * 3}
    loop = DirectLoop("baxter_left_arm", STIFF | STRONG | own)
    weight = [0.0, 0.0, -0.3 * 9.81]
    loop.robot.apply_wrench(loop.controller.robot.frame, weight, np.zeros(3))
    race(loop, 15.0, 4)
    assert_kept(loop)
    used = np.abs(column(tuple(loop.samples), "additional")).max(axis=0)
    assert used[1] > 2.0, "nothing was integrated"
    assert (used <= np.array(own["integral_budget"]) + 1e-9).all()


def test_a_constant_push_is_in_the_plans():
    """What holds the arm in the end of a plan holds the push too."""
    force = [5.0, 0.0, 0.0]
    loop = DirectLoop("panda", STIFF | weak("panda", 0.6))
    hand = loop.controller.robot.frame
    loop.robot.apply_wrench(hand, force, np.zeros(3))
    loop.run(1.0)
    model, keeper = loop.controller.robot, loop.controller.find(SafetyFilter)
    gravity = pin.computeGeneralizedGravity(loop.model, loop.model.createData(), model.q)
    push = model.J[:3].T @ (model.pose.rotation.T @ force)
    assert np.abs(push).max() > 1.0
    np.testing.assert_allclose(keeper.rest_torque, gravity - push, atol=0.05)  # N m
    race(loop, 6.0, 4)
    assert_kept(loop)


@pytest.mark.parametrize("reserve", [None, [7.0, 7.0, 5.0, 5.0, 2.5, 2.5, 0.5]])
def test_an_arm_that_is_stretched_out_withstands_what_is_reserved_for(reserve):
    """As far as it can be held, 5 N more throw it down; with torque left for them, they do not."""
    own = {"start_positions": [0.0, -1.2, 0.0, 2.0, 0.0, 0.0, 0.0]}
    own |= {} if reserve is None else {"torque_reserve": reserve}
    loop = DirectLoop("baxter_left_arm", STIFF | STRONG | own)
    keeper, hand = loop.controller.find(SafetyFilter), loop.controller.robot.frame
    loop.controller.goals.set_posture(np.zeros(7))
    loop.run(4.0)
    np.testing.assert_allclose(abs(keeper.rest_torque[1]), keeper.usable[1], rtol=0.02)
    stood = loop.robot.state().q[1]
    moved = 0.0
    for push in [*np.linspace(0.25, 5.0, 20), *[5.0] * 60, *[0.0] * 60]:
        loop.robot.apply_wrench(hand, [0.0, 0.0, -push], np.zeros(3))
        loop.step()
        moved = max(moved, abs(loop.robot.state().q[1] - stood))
    if reserve is None:
        assert keeper.outcomes["outside"] > 0
        assert moved > 0.3
    else:
        assert keeper.outcomes["outside"] == 0
        assert moved < 0.1
        assert_kept(loop)


def test_a_weak_arm_keeps_its_distances_only_with_the_filter():
    """It cannot brake in front of the wall, or itself, as its acceleration limits promise."""
    _, known = around_the_wall()
    least, beyonds = {}, {}
    for filtered in (False, True):
        own = weak("panda", 0.6) | {"safety_filter": filtered}
        loop = DirectLoop("panda", STIFF | known | own)
        rng = np.random.default_rng(2)
        distances = []
        for _ in range(3):
            loop.controller.goals.set_posture(random_posture(loop, rng))
            distances.append(play(loop, 2.0)[0].min())
        least[filtered], beyonds[filtered] = min(distances), beyond(loop)
    assert least[False] < 0.0
    assert beyonds[False][0] > 0.1
    assert least[True] > MARGIN
    assert beyonds[True][:2] == (0.0, 0.0)
