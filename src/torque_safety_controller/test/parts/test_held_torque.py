# SPDX-License-Identifier: Apache-2.0
"""The mean acceleration under a torque that is held for several periods, against motions."""

import numpy as np

from torque_safety_controller.parts.held_torque import YIELD, HeldTorque, drift_under_held_torque
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.step import Step
from torque_safety_controller.supervisor import Order
from viability_bounds_pkg.estimate.drift import jerk_under_held_torque
from viability_bounds_pkg.state import State

DT, PERIODS = 0.002, 5


def test_the_drift_is_that_of_any_acceleration(arm):
    rng = np.random.default_rng(0)
    q, v = arm.random_state(rng)
    A, b = drift_under_held_torque(arm.model, arm.model.createData(), State(q, v))
    a = rng.uniform(-10.0, 10.0, (5, arm.n))
    many = np.tile(q, (5, 1)), np.tile(v, (5, 1))
    expected = jerk_under_held_torque(arm.model, *many, a)[1]
    np.testing.assert_allclose(a @ A.T + b, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


def test_the_rows_are_for_the_mean_of_the_time_that_a_torque_is_held(arm):
    rng = np.random.default_rng(1)
    part, robot = HeldTorque(arm.model, PERIODS * DT, DT), arm.robot(DT)
    for _ in range(5):
        state = State(*arm.random_state(rng))
        a = rng.uniform(-2.0, 2.0, arm.n)
        robot.update(state, a)
        step = Step(robot, None, Order(), DT, np.full(arm.n, np.inf), a, 20.0)
        step.bounds = AccelerationRange(np.full(arm.n, -3.0), np.full(arm.n, 4.0))
        step.disturbance = rng.uniform(-1.0, 1.0, arm.n)
        part.prepare(step)
        G, lower, upper = step.rows[part]
        held = PERIODS * DT
        mean = (arm.move(*state, robot.torque(a), held, 20)[1] - state.v) / held
        drift = mean - a
        assert np.abs(drift).max() > 0.1, "hardly anything drifts"
        # What the controller compares these accelerations with.
        known, narrowed = G @ step.disturbance, step.commanded(step.bounds)
        for limit, bound in zip((lower, upper), narrowed, strict=True):
            left = (limit - known - G @ a) / YIELD
            np.testing.assert_allclose(left, bound - mean, atol=0.05 * np.abs(drift).max())
