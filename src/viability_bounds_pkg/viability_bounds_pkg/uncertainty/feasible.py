# SPDX-License-Identifier: Apache-2.0
"""Declarations that leave no bounds: which one, of which joint, and how much there may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError
from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.uncertainty.declared import DeclaredUncertainty
from viability_bounds_pkg.uncertainty.margins import Loop

_HALVINGS = 40


def joint_of(declared: DeclaredUncertainty, j: int) -> DeclaredUncertainty:
    """Return what is declared of joint j alone, arrays of shape (1,)."""
    own: dict[str, Any] = {
        name: value[j : j + 1]
        for name, value in vars(declared).items()
        if isinstance(value, np.ndarray)
    }
    return replace(declared, **own)


def without(declared: DeclaredUncertainty, name: str) -> DeclaredUncertainty:
    """Return the same with one of the declarations left out."""
    return replace(declared, **{name: 0 * getattr(declared, name)})


def none_of(declared: DeclaredUncertainty) -> DeclaredUncertainty:
    """Return the same with nothing declared."""
    return replace(declared, **{name: 0 * value for name, value in vars(declared).items()})


def declared_names(declared: DeclaredUncertainty) -> list[str]:
    """Return which declarations are not zero."""
    return [each.name for each in fields(declared) if np.any(getattr(declared, each.name))]


def refusal(loop: Loop, declared: DeclaredUncertainty, error: JointLimitsError) -> ArmSafetyError:
    """Return the error for declarations that leave a joint no bounds.

    It names the first declaration that is too large while the others are as they are, and the
    largest value that will do, rounded to the safe side.

    Args:
        loop: of n joints.
        declared: of these joints.
        error: what the bounds say; returned where nothing declared is the cause.
    """
    if error.joint is None:
        return error
    j = loop.limits.names.index(error.joint)
    loop, declared = loop.of_joint(j), joint_of(declared, j)
    names = declared_names(declared)
    place = f"for '{error.joint}' at {1.0 / loop.dt:g} Hz"

    def leaves_bounds(other: DeclaredUncertainty) -> bool:
        try:
            loop.bounds(other)
        except JointLimitsError:
            return False
        return True

    for name in names:
        if leaves_bounds(without(declared, name)):
            rest = ", ".join(f"{each} {_shown(declared, each)}" for each in names if each != name)
            allowed = f"{_limit(declared, name, leaves_bounds)} {place}"
            return SettingError(
                name, _number(declared, name), allowed + (f", with {rest}" if rest else "")
            )
    if not names or not leaves_bounds(none_of(declared)):
        return error
    most, *others = names
    allowed = f"less {place}, and less of {', '.join(others)}"
    return SettingError(most, _number(declared, most), allowed)


def _limit(
    declared: DeclaredUncertainty,
    name: str,
    leaves_bounds: Callable[[DeclaredUncertainty], bool],
) -> str:
    """Return in words what value of a declaration leaves bounds."""
    value = getattr(declared, name)

    def leaves(other: Any) -> bool:
        changed: dict[str, Any] = {name: other}
        return leaves_bounds(replace(declared, **changed))

    if isinstance(value, int):
        return f"at most {max(filter(leaves, range(value)))}"
    # A bandwidth is the reciprocal of what costs.
    slower = name == "motor_bandwidth"
    good, bad = np.finfo(float).tiny, 1.0
    for _ in range(_HALVINGS):
        share = 0.5 * (good + bad)
        tried = value / share if slower else value * share
        if leaves(tried):
            good = share
        else:
            bad = share
    number = _number(declared, name)
    found = number / good if slower else number * good
    unit = 10.0 ** (np.floor(np.log10(found)) - 2.0)
    rounded = np.ceil(found / unit) * unit if slower else np.floor(found / unit) * unit
    return f"{'at least' if slower else 'at most'} {rounded:.3g}"


def _number(declared: DeclaredUncertainty, name: str) -> float:
    """Return what is declared of a single joint."""
    value = getattr(declared, name)
    return value if isinstance(value, int) else float(value[0])


def _shown(declared: DeclaredUncertainty, name: str) -> str:
    return f"{_number(declared, name):g}"
