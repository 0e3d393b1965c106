# SPDX-License-Identifier: Apache-2.0
"""Brings an arm to rest within its limits when commands stop, and holds it there."""

from viability_bounds_pkg.stopping.coordinated_stop import CoordinatedStop
from viability_bounds_pkg.stopping.torque_limits import within_torque_limits

__all__ = ["CoordinatedStop", "within_torque_limits"]
