# SPDX-License-Identifier: Apache-2.0
"""The state in which a command will act: velocities estimated, delay and motor lag predicted."""

from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.freeze_check import Expected
from viability_bounds_pkg.state_estimation.observer import ObserverDesign, design_observer
from viability_bounds_pkg.state_estimation.state_check import StateCheck

__all__ = [
    "Expected",
    "ObserverDesign",
    "StateCheck",
    "StateEstimator",
    "design_observer",
]
