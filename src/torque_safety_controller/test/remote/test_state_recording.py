# SPDX-License-Identifier: Apache-2.0
"""Recordings of a client: also of robots that report positions only."""

import numpy as np

from torque_safety_controller.remote.arm_client import StateRecording
from viability_bounds_pkg.testing.ros_harness import joint_state


def test_states_without_velocities_are_recorded(tmp_path):
    recording = StateRecording(["a"])
    for k in (1, 2, 3):
        recording.add(joint_state(["a"], 10_000_000 * k, [0.01 * k]))
    np.testing.assert_allclose(recording.t, [0.0, 0.01, 0.02])  # s
    np.testing.assert_allclose(recording.v[1:, 0], [1.0, 1.0])  # rad/s
    assert np.isnan(recording.tau).all()
    recording.save(tmp_path / "run.npz")
    assert np.load(tmp_path / "run.npz")["joints"].tolist() == ["a"]


def test_angles_that_a_driver_wraps_do_not_leap():
    recording = StateRecording(["a", "b"], np.array([True, False]))
    angles = np.array([3.13, 3.14, 3.15])  # rad
    for k, reported in enumerate((angles + np.pi) % (2.0 * np.pi) - np.pi, 1):
        recording.add(joint_state(["a", "b"], 10_000_000 * k, [reported, 0.0]))
    np.testing.assert_allclose(recording.q[:, 0], angles)
    np.testing.assert_allclose(recording.v[1:, 0], [1.0, 1.0])  # rad/s
