# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node that takes what MoveIt sends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from viability_bounds_pkg.parameter import above, number
from viability_bounds_pkg.robot.configuration import RobotConfiguration


@dataclass(frozen=True, eq=False, kw_only=True)
class MoveitConfiguration(RobotConfiguration):
    """Parameters of ``moveit_node``."""

    NOT_NEEDED: ClassVar[frozenset[str]] = frozenset({"torque_max"})

    trajectory_goal_tolerance: float = number(
        "tolerance of each joint at the end of a trajectory without goal_tolerance, rad",
        above(0.0, 1.0),
        default=0.01,
    )
    trajectory_goal_time: float = number(
        "time allowed after the end of a trajectory without goal_time_tolerance, s of robot time",
        above(0.0, 600.0),
        default=5.0,
    )
