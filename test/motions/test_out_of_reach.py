# SPDX-License-Identifier: Apache-2.0
"""Arms whose hand cannot reach its goal come to rest; `reproduce.sh out_of_reach` has more."""

import numpy as np
import pinocchio as pin
from direct import DirectLoop, column, distance

BACK = pin.SE3(np.eye(3), np.array([-1.0, 0.0, 0.0]))


def last_second(robot, seconds, speed_max):
    """Return torque step, in torque limits, speed, rad/s, and distance, m."""
    loop = DirectLoop(robot, {"pose_speed_max": speed_max})
    loop.controller.set_pose_goal(loop.pose() * BACK)
    last = loop.run(seconds)[-round(1.0 / loop.dt) :]
    steps = np.abs(np.diff(column(last, "tau"), axis=0)) / loop.config.torque_max
    return steps.max(), np.abs(column(last, "v")).max(), distance(last)[-1]


def test_baxter_comes_to_rest():
    step, speed, left = last_second("baxter_left_arm", 15.0, [0.2, 0.6])
    assert left > 0.4
    assert step < 1e-3
    assert speed < 1e-3


def test_without_a_largest_speed_it_does_not():
    step, speed, left = last_second("baxter_left_arm", 15.0, [])
    assert left > 0.4
    assert step > 0.01
    assert speed > 0.1


def test_talos_becomes_still_but_for_its_friction():
    step, _, left = last_second("talos_left_arm", 6.0, [0.5, 1.5])
    assert left > 0.5
    assert step < 0.1  # 0.4 without
