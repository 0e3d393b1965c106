# SPDX-License-Identifier: Apache-2.0
"""Exact joint acceleration bounds that keep position and velocity limits for ever.

The public names are found here; `docs/start/without_ros.md` lists their modules.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

_MODULES = {
    "JointLimits": "joint_limits",
    "AccelerationBounds": "viability",
    "BoundsSolver": "viability",
    "acceleration_bounds": "viability",
    "viable_velocity_range": "viability",
    "naive_bounds": "baselines",
    "decre_bounds": "baselines",
    "rubrecht_bounds": "baselines",
    "estimate_acceleration_limits": "acceleration_limits",
    "CoordinatedStop": "stop",
    "State": "state",
    "ArmSafetyError": "exceptions",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: what it needs takes a second to load."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
