# SPDX-License-Identifier: Apache-2.0
"""The estimator node's parameters, and the estimator that it makes by them."""

from __future__ import annotations

from dataclasses import dataclass

import pinocchio as pin

from viability_bounds_pkg.parameter import group, timeout
from viability_bounds_pkg.robot.configuration import ControlRate, LimitedRobotConfiguration
from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import ObserverDesign
from viability_bounds_pkg.uncertainty import DeclaredUncertainty, VelocityEstimation


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimatorConfiguration(VelocityEstimation, ControlRate, LimitedRobotConfiguration):
    """Parameters of the estimator node."""

    declared: DeclaredUncertainty = group(DeclaredUncertainty)
    state_timeout: float = timeout(
        "silence after which older stamps are accepted again, s", default=0.5
    )

    @property
    def observers(self) -> ObserverDesign | None:
        """Observers of the velocities; None where they are not estimated."""
        return self.declared.observers(self.dt) if self.velocity_estimation else None


def make_estimator(config: EstimatorConfiguration, model: pin.Model) -> StateEstimator:
    """Return the estimator of an arm."""
    declared = config.declared
    return StateEstimator(
        model,
        config.dt,
        declared.delay,
        declared.motor_lag,
        config.observers,
        config.velocity_max,
        config.torque_max,
        declared.lasting_disturbance,
        1 + declared.missed_deadlines,
    )
