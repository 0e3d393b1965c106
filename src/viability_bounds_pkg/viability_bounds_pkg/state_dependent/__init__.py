# SPDX-License-Identifier: Apache-2.0
"""Acceleration limits from the torque available in the present state."""

from viability_bounds_pkg.state_dependent.certificate import BrakingCertificate, Reach
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds

__all__ = ["BrakingCertificate", "Reach", "StateDependentBounds"]
