# SPDX-License-Identifier: Apache-2.0
"""Parameters of forces at the hand and other contacts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.parameters.entries import read_entries
from torque_safety_controller.parts.contact.admittance import InteractionSettings
from torque_safety_controller.parts.contact.wrench_sensor import SensorSettings
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    group,
    number,
    numbers,
    text,
    texts,
)

Array = NDArray[np.float64]

_AXES = "x, y, z and about x, y, z of the end effector's axes"

_DEFAULTS = InteractionSettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactPoint:
    """One entry of ``contacts``."""

    frame: str = text("name of the link")
    point: Array = numbers("in its axes, m", FINITE, length=3, default=(0.0, 0.0, 0.0))
    normal: Array = numbers("direction in which the environment pushes", FINITE, length=3)
    friction: float = number("Coulomb's coefficient", NOT_NEGATIVE, default=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractionConfiguration:
    """Parameters of forces.

    Attributes:
        sensor: how measurements are taken.
        points: of contacts.
        settings: what is done about forces.
    """

    ft_frame: str = text("link of the wrist's force/torque sensor; none if empty", default="")
    ft_tool: Array = numbers(
        "mass beyond the sensor, kg, and its centre in the sensor's axes, m; as the URDF says if "
        "empty",
        length=4,
        default=(),
        note="[mass, x, y, z] with mass >= 0",
    )
    sensor: SensorSettings = group(SensorSettings, "ft_")
    force_directions: Array = numbers(
        f"1 where target_wrench is exerted, 0 elsewhere: {_AXES}; nowhere if empty",
        length=6,
        if_empty=0.0,
        live=True,
        note="zeros and ones",
    )
    admittance_kp: Array = numbers(
        "gains Kp of (27) for forces, m/s^2 per N, and moments, rad/s^2 per N m",
        NOT_NEGATIVE,
        length=2,
        default=_DEFAULTS.gains.kp,
        live=True,
    )
    admittance_speed_max: Array = numbers(
        "speeds at which the hand approaches what it is to press on, m/s and rad/s",
        POSITIVE,
        length=2,
        default=(0.01, 0.05),
        live=True,
    )
    yield_threshold: Array = numbers(
        "force, N, and moment, N m, above which the hand yields; below half of both it stops, and "
        "stays where it is then; it never yields if empty",
        POSITIVE,
        length=2,
        default=(),
        live=True,
    )
    contacts: tuple[str, ...] = texts(
        "points at which the hand touches while it exerts target_wrench, on one link fixed to it "
        "and in its axes: point, m, its origin if left out; normal, direction in which the "
        "environment pushes; friction, Coulomb's coefficient, 0 if left out",
        default=(),
        note="each a YAML mapping '{frame: link, point: [x, y, z], normal: [x, y, z], "
        "friction: 0.3}'; all have the same frame, normal and friction",
    )
    points: tuple[ContactPoint, ...] = field(init=False)
    settings: InteractionSettings = field(init=False)

    def __post_init__(self) -> None:
        """Check all that does not depend on the URDF, and make the settings."""
        tool = self.ft_tool
        if len(tool) and not (np.isfinite(tool).all() and tool[0] >= 0.0):
            raise SettingError("ft_tool", tool, "4 finite numbers [mass, x, y, z] with mass >= 0")
        object.__setattr__(self, "points", _contact_points(self.contacts))
        for name in ("force_directions", "yield_threshold"):
            if np.any(getattr(self, name)) and not self.ft_frame:
                allowed = "only with a force/torque sensor, 'ft_frame'"
                raise SettingError(name, getattr(self, name), allowed)
        if not np.isin(self.force_directions, (0.0, 1.0)).all():
            raise SettingError("force_directions", self.force_directions, "zeros and ones")
        object.__setattr__(self, "settings", self._settings())

    def _settings(self) -> InteractionSettings:
        threshold = tuple(self.yield_threshold.tolist()) or None
        return InteractionSettings(
            directions=self.force_directions == 1.0,
            gains=replace(
                _DEFAULTS.gains,
                kp=tuple(self.admittance_kp.tolist()),
                speed_max=tuple(self.admittance_speed_max.tolist()),
            ),
            yield_threshold=threshold,
        )


def _contact_points(entries: tuple[str, ...]) -> tuple[ContactPoint, ...]:
    points = read_entries(ContactPoint, "contacts", entries)
    for index, point in enumerate(points):
        allowed = "the same at all points"
        if np.abs(point.normal).max() <= 1e-9:
            raise SettingError(f"contacts[{index}].normal", point.normal, "a direction, not zero")
        if not np.array_equal(points[0].normal, point.normal):
            raise SettingError(f"contacts[{index}].normal", point.normal, allowed)
        if points[0].friction != point.friction:
            raise SettingError(f"contacts[{index}].friction", point.friction, allowed)
    return points
