# SPDX-License-Identifier: Apache-2.0
"""Log messages and diagnostics of the collision avoidance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torque_safety_controller.collision.avoidance import CollisionAvoidance
from torque_safety_controller.controller import ControlOutput
from torque_safety_controller.qp import Constraint

if TYPE_CHECKING:
    from rclpy.impl.rcutils_logger import RcutilsLogger

_MEANING = {
    "near at start": "as they are near each other in collision_posture",
    "near mostly": "as they are near each other in most postures",
    "near always": "as they are near each other in all postures",
}

_SLIGHT = 1e-3  # m; violations of the margin below this are not reported


class CollisionReport:
    """Monitors the distances of each step; logs at start which pairs are kept apart.

    Args:
        logger: of the node.
        constraints: of the controller; collision avoidance is reported where it is among them.

    Attributes:
        too_near: pair that is nearer than the margin now, in words; empty if none is.
    """

    def __init__(self, logger: RcutilsLogger, constraints: Sequence[Constraint]) -> None:
        self._logger = logger
        own = (each for each in constraints if isinstance(each, CollisionAvoidance))
        self._avoidance = avoidance = next(own, None)
        self._relaxed_steps = self._not_viable_steps = 0
        self.too_near = ""
        if avoidance is None:
            return
        logger.info(
            f"collision avoidance keeps {len(avoidance.model.names)} pairs of shapes "
            f"{avoidance.settings.margin:g} m apart"
        )
        for reason, meaning in _MEANING.items():
            pairs = sorted(set(avoidance.model.left_out.get(reason, ())))
            if pairs:
                logger.warning(f"not kept apart, {meaning}: {', '.join(pairs)}")

    def add(self, step: ControlOutput) -> None:
        """Count a step, and log pairs that are too near."""
        avoidance = self._avoidance
        if avoidance is None:
            return
        if step.constraint_relaxation is not None and step.constraint_relaxation.any():
            self._relaxed_steps += 1
        self._not_viable_steps += not avoidance.viable
        margin = avoidance.settings.margin
        distance, pair = avoidance.closest()
        if not self.too_near and distance < margin - _SLIGHT:
            self.too_near = f"{pair}: {distance:.3f} m apart, less than the margin"
            self._logger.warning(f"{self.too_near}; moving out")
        elif self.too_near and distance >= margin:
            self.too_near = ""
            self._logger.info(f"all pairs are {margin:g} m apart again")

    def values(self) -> dict[str, Any]:
        """Return what to report."""
        if self._avoidance is None:
            return {}
        distance, pair = self._avoidance.closest()
        return {
            "closest_distance_m": distance,
            "closest_pair": pair or "none",
            "collision_pairs": len(self._avoidance.model.names),
            "collision_rows": self._avoidance.count,
            "collision_viable": self._avoidance.viable,
            "collision_not_viable_steps": self._not_viable_steps,
            "collision_relaxed_steps": self._relaxed_steps,
        }
