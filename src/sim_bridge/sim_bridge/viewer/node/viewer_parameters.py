# SPDX-License-Identifier: Apache-2.0
"""The viewer's parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

from numpy import float64
from numpy.typing import NDArray

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, limits_of
from viability_bounds_pkg.parameter import Range, redeclared, text, whole_number
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration, TaskFrames


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewerConfiguration(TaskFrames, LimitedRobotConfiguration):
    """Parameters of the viewer.

    Attributes:
        limits: of the joints.
    """

    acceleration_min: NDArray[float64] = redeclared(BoundsConfiguration, "acceleration_min")
    acceleration_max: NDArray[float64] = redeclared(BoundsConfiguration, "acceleration_max")
    ft_frame: str = text("link that is a force/torque sensor; none if empty", default="")
    viewer_host: str = text("address that the page is served on", default="127.0.0.1")
    viewer_port: int = whole_number(
        "port that the page is served on; the next free one if it is taken",
        Range(1024, 65535),
        default=8080,
    )
    limits: JointLimits = field(init=False)

    def __post_init__(self) -> None:
        """Make the limits."""
        super().__post_init__()
        object.__setattr__(self, "limits", limits_of(self))
