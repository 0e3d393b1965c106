# SPDX-License-Identifier: Apache-2.0
"""Panda with speed limits that depend on position, driven to limits of position in PyBullet."""

import numpy as np
import pytest
from direct import DirectLoop

OVERSHOOTING = {"pose_weight": 0.0, "posture_weight": 1.0, "posture_kp": 100.0, "posture_kd": 8.0}
CURVE = {
    "velocity_offset": [0.3] * 7,
    "deceleration_limit": [6.0, 2.5, 4.0, 4.0, 10.0, 6.0, 17.0],
}


@pytest.mark.parametrize("safety_filter", [False, True])
def test_joints_keep_them_and_come_to_rest_where_they_end(safety_filter):
    loop = DirectLoop("panda", OVERSHOOTING | CURVE | {"safety_filter": safety_filter})
    rng, limits, monitor = np.random.default_rng(0), loop.limits, loop.robot.monitor
    for _ in range(2):
        loop.controller.goals.set_posture(
            np.where(rng.random(7) < 0.5, limits.q_min, limits.q_max)
        )
        loop.run(1.0)
    assert monitor.max_position_violation.max() == monitor.max_velocity_violation.max() == 0.0
    closest = np.minimum(monitor.closest_to_q_min, monitor.closest_to_q_max)
    left = closest - limits.rest_distance
    assert (left > 0.0).all() and (left < 1e-3).sum() >= 2, left
