# SPDX-License-Identifier: Apache-2.0
"""The state in which a command will act: velocities estimated, delay and motor lag predicted."""

from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import ObserverDesign, design_observer

__all__ = [
    "ObserverDesign",
    "StateEstimator",
    "design_observer",
]
