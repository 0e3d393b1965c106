# SPDX-License-Identifier: Apache-2.0
"""What the log says of the collision avoidance at start."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torque_safety_controller.parts.collision import Collision

if TYPE_CHECKING:
    from rclpy.impl.rcutils_logger import RcutilsLogger

_MEANING = {
    "near at start": "as they are near each other in collision_posture",
    "near mostly": "as they are near each other in most postures",
    "near always": "as they are near each other in all postures",
}


def log_pairs(logger: RcutilsLogger, collision: Collision) -> None:
    """Log how many pairs are kept apart, and which are not."""
    avoidance = collision.avoidance
    logger.info(
        f"collision avoidance keeps {len(avoidance.model.names)} pairs of shapes "
        f"{avoidance.settings.margin:g} m apart"
    )
    for reason, meaning in _MEANING.items():
        pairs = sorted(set(avoidance.model.left_out.get(reason, ())))
        if pairs:
            logger.warning(f"not kept apart, {meaning}: {', '.join(pairs)}")
