# SPDX-License-Identifier: Apache-2.0
"""Kinematics and dynamics of a control step, against finite differences and motions."""

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.robot.files import RobotDescriptionError
from viability_bounds_pkg.state import State

H = 1e-6  # rad; step of finite differences
DIFFERENCE_TOLERANCE = 1e-7  # m and rad; of finite differences with H


def updated(arm, q, v, a=None, dt=None) -> RobotModel:
    robot = arm.robot(dt)
    robot.update(State(q, v), np.zeros(arm.n) if a is None else a)
    return robot


def test_pose_and_jacobian_are_those_of_the_frame_now_by_finite_differences(arm):
    """Of the current state, not of the middle of the step."""
    rng = np.random.default_rng(2)
    data, frame = arm.model.createData(), arm.model.getFrameId(arm.frame)
    for _ in range(3):
        q, v = arm.random_state(rng)
        robot = updated(arm, q, v)
        pin.framesForwardKinematics(arm.model, data, q)
        assert robot.pose.isApprox(data.oMf[frame], 1e-12)
        for j, step in enumerate(H * np.eye(arm.n)):
            behind, ahead = (updated(arm, q + s * step, v).pose for s in (-1.0, 1.0))
            column = pin.log6(behind.actInv(ahead)).vector / (2.0 * H)
            np.testing.assert_allclose(robot.J[:, j], column, atol=DIFFERENCE_TOLERANCE)


def test_the_drift_by_finite_differences(arm):
    rng = np.random.default_rng(3)
    for _ in range(5):
        q, v = arm.random_state(rng)
        behind, ahead = (updated(arm, q + s * H * v, v).J for s in (-1.0, 1.0))
        drift = (ahead - behind) @ v / (2.0 * H)
        assert np.abs(drift).max() > 0.1, "a state without drift tells nothing"
        np.testing.assert_allclose(updated(arm, q, v).drift, drift, atol=1e-6)


def test_mass_matrix_and_bias_are_those_of_the_middle_of_the_step(arm):
    rng = np.random.default_rng(4)
    for dt in (0.0, 1e-3, 2e-2):
        q, v = arm.random_state(rng)
        a_last = rng.normal(size=arm.n)
        robot = updated(arm, q, v, a_last, dt)
        q_mid = q + v * dt / 2.0 + a_last * dt**2 / 8.0
        v_mid = v + a_last * dt / 2.0
        data = arm.model.createData()
        bias = pin.rnea(arm.model, data, q_mid, v_mid, np.zeros(arm.n))
        np.testing.assert_allclose(robot.h, bias, atol=1e-11)
        for j in range(arm.n):
            e = np.eye(arm.n)[j]
            column = pin.rnea(arm.model, data, q_mid, v_mid, e) - bias
            np.testing.assert_allclose(robot.M[:, j], column, atol=1e-11)
        # With the last acceleration again, the QP's linear law is the torque itself.
        np.testing.assert_allclose(robot.torque(a_last), robot.M @ a_last + robot.h, atol=1e-10)


def mean_acceleration_defect(arm, q, v, a, dt, lead) -> float:
    """How far a torque held for dt misses the wanted mean acceleration, rad/s^2."""
    tau = updated(arm, q, v, a, lead).torque(a)
    _, v_end = arm.move(q, v, tau, dt, steps=8)
    return float(np.linalg.norm((v_end - v) / dt - a))


def test_a_torque_for_the_middle_of_the_step_is_right_to_second_order(arm):
    rng = np.random.default_rng(6)
    dt = 2e-3
    middle, begin = [], []
    for _ in range(10):
        q, v = arm.random_state(rng)
        a = rng.uniform(-2.0, 2.0, arm.n)
        for ratios, leads in ((middle, (dt, dt / 2)), (begin, (0.0, 0.0))):
            coarse, fine = (
                mean_acceleration_defect(arm, q, v, a, step, lead)
                for step, lead in zip((dt, dt / 2), leads, strict=True)
            )
            ratios.append(coarse / fine)
    assert np.median(middle) == pytest.approx(4.0, rel=0.05)
    assert np.median(begin) == pytest.approx(2.0, rel=0.05)


def test_an_unknown_frame_is_refused_by_name(arm):
    with pytest.raises(RobotDescriptionError, match="unknown frame 'elsewhere'.*" + arm.frame):
        RobotModel(arm.model, "elsewhere", 0.01)
