# SPDX-License-Identifier: Apache-2.0
"""An arm whose motion is integrated with scipy, and what coarse hardware makes of it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

from viability_bounds_pkg.robot_description import build_model, read_urdf
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
        n = len(command)

        def rate(t, x):
            a = pin.aba(self.model, self.data, x[:n], x[n:], self.torque(command, t))
            return np.concatenate([x[n:], a + self.disturbance(self.t + t)])

        x = np.concatenate(self.state)
        way = solve_ivp(rate, (0.0, self.dt), x, rtol=1e-9, atol=1e-11, method="DOP853")
        self.state = State(way.y[:n, -1], way.y[n:, -1])
        self.tau = self.torque(command, self.dt)
        self.t += self.dt
