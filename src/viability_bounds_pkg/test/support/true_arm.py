# SPDX-License-Identifier: Apache-2.0
"""An arm under held commands whose motion is integrated in small steps."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pinocchio as pin

from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config


@cache
def model() -> pin.Model:
    """Return the model of Panda."""
    given = read_config("panda")
    urdf = read_urdf(given["robot_description"])
    return build_model(urdf, given["joints"], None, given.get("rotor_inertia"))


def runge_kutta(acceleration, state, h):
    """Return the state after a step of the classical method; `acceleration` is of (t, q, v)."""
    q, v = state
    k1 = np.array(acceleration(0.0, q, v))
    v2 = v + 0.5 * h * k1
    k2 = np.array(acceleration(0.5 * h, q + 0.5 * h * v, v2))
    v3 = v + 0.5 * h * k2
    k3 = np.array(acceleration(0.5 * h, q + 0.5 * h * v2, v3))
    v4 = v + h * k3
    k4 = np.array(acceleration(h, q + h * v3, v4))
    q = q + h * (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
    return State(q, v + h * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0)


class TrueArm:
    """An arm under held commands, its motors with a first-order lag or without.

    Args:
        dt: control period, s.
        state: at the beginning.
        tau: torque of the motors then, shape (n,), N m.
        lag: time constants of the motors, shape (n,), s; None for none.
        disturbance: acceleration that the model does not know, from the time, s.
    """

    def __init__(self, dt, state, tau, lag=None, disturbance=None) -> None:
        self.data, self.dt = model().createData(), dt
        self.state, self.tau, self.lag = state, tau, lag
        self.disturbance = disturbance or (lambda t: 0.0)
        self.t = 0.0

    def torque(self, command, elapsed):
        """Return the torque of the motors a time after a command began to act."""
        if self.lag is None:
            return command
        return command + np.exp(-elapsed / self.lag) * (self.tau - command)

    def acceleration(self):
        """Return the present acceleration without what the model does not know."""
        return np.array(pin.aba(model(), self.data, *self.state, self.tau))

    def met(self):
        """Return the state that a command meets: with a lag, that of the double integrator."""
        if self.lag is None:
            return self.state
        (q, v), a = self.state, self.acceleration() + self.disturbance(self.t)
        return State(q + self.lag * v, v + self.lag * a)

    def step(self, command) -> None:
        """Move for a period, by Runge and Kutta in steps of 0.25 ms."""

        def acceleration(t, q, v):
            tau = self.torque(command, t)
            return pin.aba(model(), self.data, q, v, tau) + self.disturbance(self.t + t)

        count = math.ceil(self.dt / 2.5e-4 - 1e-9)
        h = self.dt / count
        for start in (h * np.arange(count)).tolist():
            self.state = runge_kutta(
                lambda t, q, v, start=start: acceleration(start + t, q, v), self.state, h
            )
        self.tau = self.torque(command, self.dt)
        self.t += self.dt
