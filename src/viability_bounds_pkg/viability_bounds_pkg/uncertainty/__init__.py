# SPDX-License-Identifier: Apache-2.0
"""What users declare to be uncertain, and the margins that the bounds keep for it."""

from viability_bounds_pkg.uncertainty.declared import DeclaredUncertainty

__all__ = ["DeclaredUncertainty"]
