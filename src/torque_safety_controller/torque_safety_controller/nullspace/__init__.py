# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance: stiff in a task, free in its null space."""

from torque_safety_controller.nullspace.compliance import NullspaceCompliance, PrintedCompliance

__all__ = ["NullspaceCompliance", "PrintedCompliance"]
