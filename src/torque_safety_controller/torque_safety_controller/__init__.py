# SPDX-License-Identifier: Apache-2.0
"""Torque control inside joint, acceleration and torque limits, solved as a QP.

The public names are found here; `docs/start/without_ros.md` lists their modules.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

_MODULES = {
    "Controller": "controller",
    "Part": "step",
    "Step": "step",
    "RobotModel": "robot_model",
    "AccelerationRange": "qp",
    "Goals": "parts.goals",
    "JointBounds": "parts.joint_bounds",
    "Gains": "tasks.gains",
    "scale_to_limits": "anti_windup",
    "project_to_limits": "anti_windup",
    "LeakyIntegrator": "integral_feedback",
    "Supervisor": "supervisor",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: what it needs takes a second to load."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
