# SPDX-License-Identifier: Apache-2.0
"""Each gain reaches what the controller sends."""

from dataclasses import replace

import numpy as np
import pytest
from controllers import GAINS, SOLVED, make, pose_at, strong, wide

from torque_safety_controller.supervisor import REST
from viability_bounds_pkg.state import State


@pytest.mark.parametrize(
    ("gain", "value"),
    [
        ("pose_kp", 20.0),
        ("pose_kd", 12.0),
        ("pose_weight", 1e-4),
        ("posture_kp", 16.0),
        ("posture_kd", 10.0),
        ("posture_weight", 1.0),
        ("pose_speed_max", np.array([0.01, 0.05])),
    ],
)
def test_each_gain_of_the_tasks_reaches_the_torque(arm, gain, value):
    assert not np.array_equal(getattr(GAINS, gain), value)

    def tau(gains):
        controller = make(arm, gains=gains)
        controller.reset(arm.q_start + 0.1)
        controller.goals.set_pose(pose_at(arm, arm.q_start + 0.05))
        return controller.step(State(arm.q_start, 0.02 * arm.v_max), wide(arm)).tau

    changed = replace(GAINS, **{gain: value})
    assert np.abs(tau(changed) - tau(GAINS)).max() > 1e-3
    # Also when it changes while the controller runs.
    controller = make(arm)
    controller.reset(arm.q_start + 0.1)
    controller.goals.set_pose(pose_at(arm, arm.q_start + 0.05))
    controller.goals.gains = changed
    step = controller.step(State(arm.q_start, 0.02 * arm.v_max), wide(arm))
    np.testing.assert_allclose(step.tau, tau(changed), atol=1e-6)


@pytest.mark.parametrize("way", ["hold", "rest"])
def test_the_damping_in_hold_reaches_the_acceleration(arm, way):
    v = 0.01 * arm.v_max
    for kd in (5.0, 40.0):
        controller = strong(arm, gains=replace(GAINS, hold_kd=kd))
        step = (
            controller.step(State(arm.q_start, v), None, REST)
            if way == "hold"
            else controller.step(State(arm.q_start, v), wide(arm), REST)
        )
        np.testing.assert_allclose(step.a, -kd * v, rtol=1e-4, atol=SOLVED)


def test_a_pose_without_weight_is_left_out(arm):
    controller = strong(arm, gains=replace(GAINS, pose_weight=0.0))
    controller.reset(arm.q_start + 0.1)
    controller.goals.set_pose(pose_at(arm, arm.q_start + 0.3))
    step = controller.step(State(arm.q_start, np.zeros(arm.n)), wide(arm))
    np.testing.assert_allclose(step.a, GAINS.posture_kp * 0.1, atol=1e-3)
