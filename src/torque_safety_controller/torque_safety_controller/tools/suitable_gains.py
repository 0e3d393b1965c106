# SPDX-License-Identifier: Apache-2.0
"""Gains of a new robot, lowered until its delay and its rate allow them."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from torque_safety_controller.new_robot.chain import NewRobotError
from torque_safety_controller.tools.gain_limits import HORIZON, OBSERVER, GainLimit, gain_check
from viability_bounds_pkg.cli.limits_file import NODE
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter_files import read_files

Gains = dict[str, float]

GAINS = {
    "pose_kp": 30.0,
    "pose_kd": -1.0,
    "pose_weight": 1.0,
    "posture_kp": 10.0,
    "posture_kd": -1.0,
    "posture_weight": 0.001,
    "hold_kd": 20.0,
}
"""Of the controller, to begin with: those of config/panda.yaml."""

IMPERFECT_GAINS = {"integral_lambda": 30.0, OBSERVER: 0.012}
"""Of the controller of an imperfect robot, to begin with: those of config/imperfect/panda.yaml."""

OBSERVER_PERIODS = 2.5
"""Time constant of the disturbance observer, control periods, as of the shipped Panda."""

OBSERVER_MAX = 0.1
"""The largest that its parameter takes, s."""

_ROUNDS = 8
_INSIDE = 0.9  # of what a gain may be at most


def suitable_gains(urdf: str, make: Callable[[Gains, str], Sequence[str]], gains: Gains) -> Gains:
    """Return gains, lowered until the delay and the rate of parameter files allow them.

    Args:
        urdf: text of the URDF.
        make: returns the files with gains, and with the place of a URDF.
        gains: to begin with.

    Raises:
        ArmSafetyError: the files leave no bounds, or no gains suit.
    """
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder) / "robot.urdf"
        robot.write_text(urdf, encoding="utf-8")
        for _ in range(_ROUNDS):
            trials = []
            for k, text in enumerate(make(gains, str(robot))):
                trials.append(Path(folder) / f"{k}.yaml")
                trials[-1].write_text(text, encoding="utf-8")
            beyond = _exceeded(trials)
            if not beyond:
                return gains
            gains = _lowered(gains, beyond)
    worst = beyond[0]
    raise NewRobotError(
        f"no gains suit this rate: '{worst.name}' is {worst.value:.4g}, beyond its limit "
        f"{worst.limit:.3g}; a higher --rate"
    )


def _exceeded(paths: Sequence[Path]) -> list[GainLimit]:
    """Return the gains of parameter files that are beyond their limits.

    Raises:
        ArmSafetyError: the files leave no bounds.
    """
    make_bounds(read_files(BoundsConfiguration, paths, NODE))
    return [each for each in gain_check(paths).limits() if each.exceeded]


def _lowered(gains: Gains, beyond: Sequence[GainLimit]) -> Gains:
    """Return gains, with those that are beyond their limits brought inside."""
    changed = dict(gains)
    for each in beyond:
        task, _, kind = each.name.rpartition("_")
        share = _INSIDE * each.limit / each.value if each.value else 0.0
        if each.name == HORIZON and HORIZON in gains and math.isfinite(each.limit):
            changed[HORIZON] = float(math.ceil(each.limit / _INSIDE))
        elif each.name == OBSERVER:
            changed[OBSERVER] = float(f"{each.limit / _INSIDE:.3g}")
        elif kind == "kd" and f"{task}_kp" in gains:
            changed[f"{task}_kp"] = float(f"{gains[f'{task}_kp'] * share**2:.3g}")
        elif each.name in gains and each.name != HORIZON:
            changed[each.name] = float(f"{gains[each.name] * share:.3g}")
    return changed
