# SPDX-License-Identifier: Apache-2.0
"""Keeps links apart from each other and from obstacles."""

from __future__ import annotations

from typing import Any

from torque_safety_controller.collision.avoidance import CollisionAvoidance
from torque_safety_controller.step import Part, Step

_SLIGHT = 1e-3  # m; violations of the margin below this are not reported


class Collision(Part):
    """Adds the rows of collision avoidance to a step.

    Args:
        avoidance: finds the rows.
    """

    def __init__(self, avoidance: CollisionAvoidance) -> None:
        self.avoidance = avoidance
        self._relaxed_steps = self._not_viable_steps = 0
        self._trouble = ""

    def prepare(self, step: Step) -> None:
        """Add rows that keep distances for ever; a disturbance makes them only stricter."""
        d = step.disturbance
        rows = self.avoidance.constraint(step.robot, step.commanded(step.bounds), d)
        if rows is not None and len(rows.G):
            step.rows[self] = rows._replace(lower=rows.lower + rows.G @ d)

    def learn(self, step: Step) -> None:
        """Count steps whose distances gave way, or cannot be kept for ever."""
        avoidance = self.avoidance
        relaxed = step.relaxation_of(self)
        self._relaxed_steps += relaxed is not None and bool(relaxed.any())
        self._not_viable_steps += not avoidance.viable
        distance, pair = avoidance.closest()
        if distance < avoidance.settings.margin - _SLIGHT:
            self._trouble = f"{pair}: nearer than {avoidance.settings.margin:g} m, moving out"
        elif distance >= avoidance.settings.margin:
            self._trouble = ""

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        distance, pair = self.avoidance.closest()
        return {
            "closest_distance_m": distance,
            "closest_pair": pair or "none",
            "collision_pairs": len(self.avoidance.model.names),
            "collision_rows": self.avoidance.count,
            "collision_viable": self.avoidance.viable,
            "collision_not_viable_steps": self._not_viable_steps,
            "collision_relaxed_steps": self._relaxed_steps,
        }

    @property
    def trouble(self) -> str:
        """Which pair is nearer than the margin."""
        return self._trouble
