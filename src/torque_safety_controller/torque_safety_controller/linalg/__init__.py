# SPDX-License-Identifier: Apache-2.0
"""Small dense linear algebra for the control step."""

from torque_safety_controller.linalg.cholesky import factorise, solve
from torque_safety_controller.linalg.generalized_inverse import dynamically_consistent_inverse

__all__ = [
    "dynamically_consistent_inverse",
    "factorise",
    "solve",
]
