# SPDX-License-Identifier: Apache-2.0
"""What users declare to be uncertain, and the margins that the bounds keep for it."""

from viability_bounds_pkg.uncertainty.declared import DeclaredUncertainty, VelocityEstimation
from viability_bounds_pkg.uncertainty.margins import UncertaintyMargins, uncertainty_margins

__all__ = [
    "DeclaredUncertainty",
    "UncertaintyMargins",
    "VelocityEstimation",
    "uncertainty_margins",
]
