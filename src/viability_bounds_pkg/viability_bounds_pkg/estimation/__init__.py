# SPDX-License-Identifier: Apache-2.0
"""Worst-case acceleration limits from torque limits, and the zero-order hold error."""

from viability_bounds_pkg.estimation.discretisation_margin import (
    ZeroOrderHoldError,
    discretisation_margin,
)
from viability_bounds_pkg.estimation.state_space import LimitEstimateError, StateSpace
from viability_bounds_pkg.estimation.velocity_scale import VelocityScale, largest_velocity_scale
from viability_bounds_pkg.estimation.worst_case_search import (
    WorstCases,
    search_by_sampling,
    search_refined,
)

__all__ = [
    "LimitEstimateError",
    "StateSpace",
    "VelocityScale",
    "WorstCases",
    "ZeroOrderHoldError",
    "discretisation_margin",
    "largest_velocity_scale",
    "search_by_sampling",
    "search_refined",
]
