# SPDX-License-Identifier: Apache-2.0
"""Postures for a pose of the end effector, within the limits."""

import numpy as np
import pinocchio as pin
from searches import finished

from torque_safety_controller.tasks.posture_search import COST, EXACT, ITERATIONS, PostureSearch


def pose_of(arm, q):
    data = arm.model.createData()
    pin.framesForwardKinematics(arm.model, data, q)
    return data.oMf[arm.model.getFrameId(arm.frame)].copy()


def test_poses_on_the_limits_are_found_from_some_of_the_beginnings(arm):
    rng = np.random.default_rng(0)
    search = PostureSearch(arm.model, arm.frame, arm.q_min, arm.q_max)
    for _ in range(5):
        ends = np.where(rng.random(arm.n) < 0.5, arm.q_min, arm.q_max)
        q = np.where(rng.random(arm.n) < 0.5, ends, rng.uniform(arm.q_min, arm.q_max))
        pose = pose_of(arm, q)
        for _ in range(100):
            found, _ = finished(search.find(pose, rng.uniform(arm.q_min, arm.q_max)))
            if found is not None:
                break
        assert found is not None
        assert (found >= arm.q_min - 1e-12).all()
        assert (found <= arm.q_max + 1e-12).all()
        error = pin.log6(pose_of(arm, found).actInv(pose)).vector
        assert np.abs(error).max() < 2.0 * EXACT  # m, rad


def test_a_pose_out_of_reach_is_given_up(arm):
    search = PostureSearch(arm.model, arm.frame, arm.q_min, arm.q_max)
    pose = pin.SE3(np.eye(3), np.array([5.0, 0.0, 0.0]))
    found, cost = finished(search.find(pose, arm.q_start))
    assert found is None
    assert cost <= ITERATIONS * COST
