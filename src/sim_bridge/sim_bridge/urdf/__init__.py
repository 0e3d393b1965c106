# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions rewritten for PyBullet."""

from sim_bridge.urdf.preparation import FramePlacement, PreparedUrdf, prepare_urdf

__all__ = ["FramePlacement", "PreparedUrdf", "prepare_urdf"]
