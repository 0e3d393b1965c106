# SPDX-License-Identifier: Apache-2.0
"""An arm of a parameter file with its stop, and its motion under held torques."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
from true_arm import runge_kutta

from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.stop import CoordinatedStop
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config
from viability_bounds_pkg.viability import BoundsSolver

H = 1e-3  # s
FEW_STEPS = 6 * H
W = 0.05  # largest error of accelerations, in the limits, docs/theory/whole_arm.md


class Arm:
    """A robot of a parameter file, its stop, and random states.

    With `curve` its speed limits depend on position: those are offset and deceleration limit as
    shares of speed and braking.
    """

    def __init__(self, robot, curve=None):
        values = read_config(robot, "bullet_node")
        self.model = read_robot(config_folder() / f"{robot}.yaml").model
        self.data = self.model.createData()
        keys = ("position_min", "position_max", "velocity_max")
        keys = (*keys, "acceleration_min", "acceleration_max")
        self.limits = JointLimits(values["joints"], *(np.array(values[key]) for key in keys))
        self.margin = W * np.minimum(-self.limits.a_min, self.limits.a_max)
        if curve is not None:
            c, d = curve[0] * self.limits.v_max, curve[1] * self.margin / W
            self.limits = replace(self.limits, velocity_offset=c, deceleration_limit=d)
        self.tau_max = np.array(values["torque_max"])
        self.n = len(self.limits)
        self.solver = BoundsSolver(self.limits, H, self.margin)

    def stop(self, **options):
        return CoordinatedStop(self.model, self.limits, self.tau_max, H, **options)

    def edge(self, rng):
        """A state on the edge of the kernel, most joints as fast as they may be."""
        low, high = self.limits.q_min, self.limits.q_max
        near = rng.uniform(0.0, 0.2, self.n)
        places = [rng.uniform(low, high), low + near, high - near]
        q = np.clip(np.choose(rng.choice(3, self.n, p=[0.6, 0.2, 0.2]), places), low, high)
        slowest, fastest = self.solver.velocity_range(q)
        share = np.where(rng.random(self.n) < 0.7, 1.0, rng.random(self.n))
        return q, share * np.where(rng.random(self.n) < 0.5, slowest, fastest)

    def inside(self, rng):
        """A state from which no limit is near."""
        middle = 0.5 * (self.limits.q_min + self.limits.q_max)
        return middle, rng.uniform(-0.1, 0.1, self.n) * self.limits.v_max

    def move(self, q, v, tau):
        """The state after a step under a held torque."""
        return runge_kutta(lambda t, q, v: pin.aba(self.model, self.data, q, v, tau), (q, v), H)

    def braking(self, v):
        """The hardest braking within the acceleration limits."""
        return np.where(v > 0.0, -self.limits.a_min, self.limits.a_max)

    def beyond(self, q):
        return np.maximum(np.maximum(q - self.limits.q_max, self.limits.q_min - q), 0.0)
