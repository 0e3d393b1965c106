# SPDX-License-Identifier: Apache-2.0
"""Safety filter of the whole arm: a braking plan that keeps every limit is always known."""

from viability_bounds_pkg.whole_arm.safety_filter import SafetyFilter

__all__ = ["SafetyFilter"]
