# SPDX-License-Identifier: Apache-2.0
"""The viability kernel: one joint's bounds, in continuous and in discrete time."""

from viability_bounds_pkg.kernel.bounds_kernel import AccelerationBounds, joint_bounds, solve
from viability_bounds_pkg.kernel.discrete_kernel import StoppingCurve, stopping_curves
from viability_bounds_pkg.kernel.discrete_time_condition import discrete_time_condition
from viability_bounds_pkg.kernel.one_sided_limit import (
    CURVE_POINT,
    ONE_SIDED_LIMIT,
    JointTable,
    make_table,
)

__all__ = [
    "CURVE_POINT",
    "ONE_SIDED_LIMIT",
    "AccelerationBounds",
    "JointTable",
    "StoppingCurve",
    "discrete_time_condition",
    "joint_bounds",
    "make_table",
    "solve",
    "stopping_curves",
]
