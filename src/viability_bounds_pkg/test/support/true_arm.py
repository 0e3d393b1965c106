# SPDX-License-Identifier: Apache-2.0
"""An arm whose motion is integrated in small steps, and what coarse hardware makes of it."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pinocchio as pin

from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config


@cache
def model(robot: str = "panda") -> pin.Model:
    """Return the model of a shipped robot."""
    given = read_config(robot)
    locked = dict(
        zip(given.get("locked_joints", ()), given.get("locked_positions", ()), strict=True)
    )
    return build_model(
        read_urdf(given["robot_description"]), given["joints"], locked, given.get("rotor_inertia")
    )


SUBSTEP = 2.5e-4
"""Of the integration, s: off by less than 1e-6 rad and rad/s, also for a step of 20 N m through a
lag of 1.6 ms."""


class TrueArm:
    """An arm under held commands, its motors with a first-order lag or without.

    Args:
        model: n joints.
        dt: control period, s.
        state: at the beginning.
        tau: torque of the motors then, shape (n,), N m.
        lag: time constants of the motors, shape (n,), s; None for none.
        disturbance: acceleration that the model does not know, from the time, s.
    """

    def __init__(self, model, dt, state, tau, lag=None, disturbance=None) -> None:
        self.model, self.data, self.dt = model, model.createData(), dt
        self.state, self.tau = state, tau
        self.lag = lag
        self.disturbance = disturbance or (lambda t: 0.0)
        self.t = 0.0

    def torque(self, command, elapsed):
        """Return the torque of the motors a time after a command began to act."""
        if self.lag is None:
            return command
        return command + np.exp(-elapsed / self.lag) * (self.tau - command)

    def acceleration(self):
        """Return the present acceleration without what the model does not know."""
        return np.array(pin.aba(self.model, self.data, *self.state, self.tau))

    def step(self, command) -> None:
        """Move for a period."""

        def acceleration(t, q, v):
            tau = self.torque(command, t)
            return pin.aba(self.model, self.data, q, v, tau) + self.disturbance(self.t + t)

        # By Runge and Kutta. Where a disturbance switches within a step the arm feels a mean of
        # it, which is no larger.
        (q, v), count = self.state, math.ceil(self.dt / SUBSTEP - 1e-9)
        h = self.dt / count
        for t in (h * np.arange(count)).tolist():
            k1 = acceleration(t, q, v)
            v2 = v + 0.5 * h * k1
            k2 = acceleration(t + 0.5 * h, q + 0.5 * h * v, v2)
            v3 = v + 0.5 * h * k2
            k3 = acceleration(t + 0.5 * h, q + 0.5 * h * v2, v3)
            v4 = v + h * k3
            k4 = acceleration(t + h, q + h * v3, v4)
            q = q + h * (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
            v = v + h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
        self.state = State(q, v)
        self.tau = self.torque(command, self.dt)
        self.t += self.dt
