# SPDX-License-Identifier: Apache-2.0
"""The arm as a whole: steps after which a plan is known that keeps every limit for ever."""

from viability_bounds_pkg.whole_arm.braking_plan import JointLimitsOfPlans
from viability_bounds_pkg.whole_arm.plan_torques import PlanTorques
from viability_bounds_pkg.whole_arm.safety_filter import SafetyFilter

__all__ = [
    "JointLimitsOfPlans",
    "PlanTorques",
    "SafetyFilter",
]
