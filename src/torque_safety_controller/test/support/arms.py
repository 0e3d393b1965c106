# SPDX-License-Identifier: Apache-2.0
"""The configured arms as the controller sees them, for tests that need a real one."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import read_config

ROBOTS = ("baxter_left_arm", "panda")


class Arm(NamedTuple):
    """One arm of ``config/``; arrays of shape (n,), rad, s and N m."""

    model: pin.Model
    frame: str
    dt: float
    q_min: np.ndarray
    q_max: np.ndarray
    v_max: np.ndarray
    tau_max: np.ndarray
    q_start: np.ndarray

    @property
    def n(self) -> int:
        return self.model.nv

    def robot(self, dt: float | None = None) -> RobotModel:
        """Return a fresh model of the controller."""
        return RobotModel(self.model, self.frame, self.dt if dt is None else dt)

    def random_state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return q and v inside the limits."""
        return rng.uniform(self.q_min, self.q_max), rng.uniform(-self.v_max, self.v_max)

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return what a torque does: forward dynamics."""
        return pin.aba(self.model, self.model.createData(), q, v, tau)

    def move(
        self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, dt: float, steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after dt under a constant torque, by Runge and Kutta's method."""
        h = dt / steps
        for _ in range(steps):
            k1 = self.acceleration(q, v, tau)
            k2 = self.acceleration(q + 0.5 * h * v, v + 0.5 * h * k1, tau)
            k3 = self.acceleration(q + 0.5 * h * (v + 0.5 * h * k1), v + 0.5 * h * k2, tau)
            k4 = self.acceleration(q + h * (v + 0.5 * h * k2), v + h * k3, tau)
            q = q + h * v + h * h * (k1 + k2 + k3) / 6.0
            v = v + h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
        return q, v


@cache
def load_arm(robot: str) -> Arm:
    """Return the arm that ``config/<robot>.yaml`` describes."""
    config = read_config(robot, "controller_node")
    arrays = {
        key: np.array(config.get(key) or read_config(robot, "bullet_node")[key])
        for key in (
            "position_min",
            "position_max",
            "velocity_max",
            "torque_max",
            "start_positions",
        )
    }
    return Arm(
        build_model(read_urdf(config["robot_description"]), config["joints"]),
        config["end_effector_frame"],
        1.0 / config["rate_hz"],
        arrays["position_min"],
        arrays["position_max"],
        arrays["velocity_max"],
        arrays["torque_max"],
        arrays["start_positions"],
    )


@pytest.fixture(params=ROBOTS)
def arm(request) -> Arm:
    """Each configured arm in turn."""
    return load_arm(request.param)
