# SPDX-License-Identifier: Apache-2.0
"""Robot descriptions rewritten for PyBullet."""

from sim_bridge.urdf.payload import PayloadError, payload_inertia
from sim_bridge.urdf.preparation import FramePlacement, PreparedUrdf, prepare_urdf

__all__ = [
    "FramePlacement",
    "PayloadError",
    "PreparedUrdf",
    "payload_inertia",
    "prepare_urdf",
]
