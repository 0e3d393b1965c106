# SPDX-License-Identifier: Apache-2.0
"""A robot that stops by itself, from states to which its bounds may have led."""

from dataclasses import replace

import numpy as np

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot, make_stop
from viability_bounds_pkg.bounds.torque_margin import tightened
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.viability import viable_velocity_range


class Stopped:
    """A robot of parameter files, with its friction and masses, and its stop."""

    def __init__(self, *files, **changes):
        given = {"bullet_node": {}, "bounds_node": {}}
        for node, values in given.items():
            for file in files:
                values |= read_config(file, node)
            values |= changes
        self.config = read(BulletConfiguration, given["bullet_node"])
        bounds = read(BoundsConfiguration, given["bounds_node"])
        kernel, margin = tightened(bounds.limits, bounds.margins), bounds.margins.acceleration
        self.kernel = replace(kernel, a_min=kernel.a_min + margin, a_max=kernel.a_max - margin)
        config = self.config
        self.robot = make_robot(config)
        self.law = make_stop(config)
        self.robot.monitor = LimitMonitor.of(config)
        self.n = len(config.joints)
        self.dt = config.dt / config.substeps

    def edge(self, rng):
        """A state to which the bounds may have led, most joints as fast as they may be."""
        low, high = self.kernel.q_min, self.kernel.q_max
        near = rng.uniform(0.0, 0.1, self.n)
        places = [rng.uniform(low, high), low + near, high - near]
        q = np.clip(np.choose(rng.choice(3, self.n, p=[0.6, 0.2, 0.2]), places), low, high)
        slowest, fastest = viable_velocity_range(q, self.kernel)
        share = np.where(rng.random(self.n) < 0.7, 1.0, rng.random(self.n))
        return q, share * np.where(rng.random(self.n) < 0.5, slowest, fastest)

    def play(self, q, v, duration, brake=False):
        """Stop or brake from a state; return the violations of position and speed."""
        self.robot.reset(q, v)
        self.robot.monitor.reset()
        steps = round(duration / self.dt)
        if brake:
            self.robot.brake(steps, self.config.torque_max)
        else:
            self.robot.stop(self.law, steps)
        monitor = self.robot.monitor
        assert monitor.max_torque_ratio.max() <= 1.0
        return monitor.max_position_violation.max(), monitor.max_velocity_violation.max()
