# SPDX-License-Identifier: Apache-2.0
"""Arms of robot descriptions, and descriptions rewritten for PyBullet."""

from sim_bridge.urdf.preparation import FramePlacement, PreparedUrdf, prepare_urdf

__all__ = ["FramePlacement", "PreparedUrdf", "prepare_urdf"]
