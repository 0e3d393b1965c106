# SPDX-License-Identifier: Apache-2.0
"""Parameters, each declared once: as a field of a frozen dataclass, its configuration.

`number`, `text`, `joint_numbers` and the others return the field of a parameter, with the values
that are allowed; the name of the field is that of the parameter. `read` checks values, as from
YAML, and makes the dataclass of them. Only conditions between several parameters are written by
hand, in its ``__post_init__``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError, did_you_mean

Array = NDArray[np.float64]
Configuration = TypeVar("Configuration")

LARGEST = 1e12
"""No parameter of a robot has a larger finite number; computing with such numbers overflows."""

REQUIRED = object()
"""Default of a parameter that has none: the node does not start without a value."""


@dataclass(frozen=True)
class Range:
    """Which finite numbers a parameter may have.

    Attributes:
        low, high: smallest and largest; infinite where there is no limit.
        without: `low` or `high`, if that number itself is not allowed.
        special: a number outside that is allowed too; its meaning is in the description.
    """

    low: float
    high: float
    without: float | None = None
    special: float | None = None

    def __contains__(self, value: float) -> bool:
        inside = self.low <= value <= self.high and value != self.without
        return math.isfinite(value) and (inside or value == self.special)

    def __str__(self) -> str:
        """Return the range in words, to follow "a number" or "numbers"."""
        limits = (
            ("> " if self.without == self.low else ">= ", self.low),
            ("< " if self.without == self.high else "<= ", self.high),
        )
        text = " and ".join(sign + f"{limit:g}" for sign, limit in limits if math.isfinite(limit))
        return text if self.special is None else f"{text}, or {self.special:g}"


FINITE = Range(-math.inf, math.inf)
POSITIVE = Range(0.0, math.inf, without=0.0)
NOT_NEGATIVE = Range(0.0, math.inf)
NEGATIVE = Range(-math.inf, 0.0, without=0.0)


def above(low: float, high: float, special: float | None = None) -> Range:
    """Return the numbers above `low` up to `high`, and perhaps a special one."""
    return Range(low, high, without=low, special=special)


_IN_WORDS = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a string",
    list[float]: "a list of numbers",
    list[str]: "a list of strings",
}


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """What is known about a parameter.

    Attributes:
        name: ROS name; that of the field.
        kind: `float`, `int`, `bool`, `str`, `list[float]` or `list[str]`. Whole numbers are
            accepted where floats are wanted, because YAML writers leave the point out.
        description: shown by ``ros2 param describe``; ends with the unit where there is one.
        default: value when none is given, or `REQUIRED`. An empty list means that the list may
            be left out.
        live: may change while the node runs; all others are read-only.
        within: which numbers are allowed; None for all.
        choices: which strings are allowed; empty for all.
        length: of a list; None for any.
        per_joint: whether a list has one number, none of them NaN, for each of ``joints``.
        if_empty: what a list that is left out is filled with; None leaves it empty.
        note: what else must be known about allowed values, in words.
    """

    name: str = ""
    kind: Any
    description: str
    default: Any = REQUIRED
    live: bool = False
    within: Range | None = None
    choices: tuple[str, ...] = ()
    length: int | None = None
    per_joint: bool = False
    if_empty: float | None = None
    note: str = ""

    def coerce(self, value: Any) -> Any:
        """Return `value`, or the default for None, as `kind`.

        Raises:
            SettingError: the value is missing, of another type, or not allowed.
        """
        given = self.default if value is None else value
        converted = self._convert(None if given is REQUIRED else given)
        if self.kind in (float, list[float]) and _is_absurd(converted):
            raise SettingError(self.name, value, f"numbers up to {LARGEST:g} in size")
        if self.choices and converted not in self.choices:
            hint = did_you_mean(value, self.choices)
            raise SettingError(self.name, value, self.constraints + hint)
        if not self._allows(converted):
            raise SettingError(self.name, value, self.constraints)
        return converted

    @property
    def optional(self) -> bool:
        """Whether the list may be empty."""
        return _is_sequence(self.default) and not len(self.default)

    @property
    def constraints(self) -> str:
        """Which values are allowed, in words; empty if all of the type are."""
        text = ""
        if self.choices:
            text = f"one of {', '.join(self.choices)}"
        elif self.kind == list[float]:
            text = "numbers" if self.within is None else f"finite numbers {self.within}".strip()
            if self.length is not None:
                text = f"{self.length} {text}"
            elif self.per_joint:
                text += ", one for each of 'joints'"
            elif self.within is None:
                text = ""
            text += ", or none" if text and self.optional else ""
        elif self.within is not None:
            text = f"{_IN_WORDS[self.kind]} {self.within}"
        return "; ".join(filter(None, (text, self.note)))

    def _convert(self, value: Any) -> Any:
        if self.kind == list[float] and _is_sequence(value) and all(map(_is_number, value)):
            return np.array(value, dtype=float)
        if self.kind == list[str] and _is_sequence(value) and {*map(type, value)} <= {str}:
            return tuple(value)
        if self.kind is float and _is_number(value):
            return float(value)
        if type(value) is self.kind:
            return value
        allowed = _IN_WORDS[self.kind] if self.length is None else self.constraints
        raise SettingError(self.name, value, allowed)

    def _allows(self, value: Any) -> bool:
        if not _is_sequence(value):
            return self.within is None or value in self.within
        if self.optional and not len(value):
            return True
        if self.length not in (None, len(value)):
            return False
        return self.within is None or all(item in self.within for item in value)


def _is_absurd(value: float | Array) -> bool:
    """Return whether there is a finite number that is larger than any should be."""
    size = np.abs(value)
    return bool(((size > LARGEST) & (size < np.inf)).any())


def _is_sequence(value: Any) -> bool:
    return not isinstance(value, str | bytes) and hasattr(value, "__len__")


def _is_number(value: Any) -> bool:
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) < 10**300  # which a float can hold
    return isinstance(value, float)


_PARAMETER, _GROUP = "parameter", "group"


def _field(kind: Any, description: str, within: Range | None = None, **more: Any) -> Any:
    if more.get("if_empty") is not None:
        more["default"] = ()
    parameter = Parameter(kind=kind, description=description, within=within, **more)
    metadata = {_PARAMETER: parameter}
    if parameter.default is REQUIRED:
        return field(metadata=metadata)
    return field(metadata=metadata, default_factory=lambda: parameter.coerce(None))


# Each returns the field of a parameter: its description, its range, and more as in `Parameter`.
number = partial(_field, float)
whole_number = partial(_field, int)
switch = partial(_field, bool)
text = partial(_field, str)
texts = partial(_field, list[str])  # a tuple
numbers = partial(_field, list[float])  # an array
joint_numbers = partial(numbers, per_joint=True)
joint_amounts = partial(joint_numbers, within=NOT_NEGATIVE, if_empty=0.0)
periods = partial(whole_number, within=Range(0, 100), default=0)  # control periods
timeout = partial(number, within=above(0.0, 3600.0))  # s


def group(kind: type, prefix: str = "") -> Any:
    """Return the field of a dataclass of parameters, whose names begin with `prefix`."""
    return field(metadata={_GROUP: (kind, prefix)})


def parameter_table(kind: Any, prefix: str = "") -> tuple[Parameter, ...]:
    """Return the parameters that a dataclass and its groups declare, in their order.

    Args:
        kind: the dataclass.
        prefix: of the names, as in `group`.
    """
    rows: list[Parameter] = []
    for each in fields(kind):
        if _PARAMETER in each.metadata:
            rows.append(replace(each.metadata[_PARAMETER], name=prefix + each.name))
        elif _GROUP in each.metadata:
            rows += parameter_table(*each.metadata[_GROUP])
    return tuple(rows)


def redeclared(kind: type, name: str, **changes: Any) -> Any:
    """Return the field of a parameter that the dataclass `kind` declares, with changes."""
    (row,) = (row for row in parameter_table(kind) if row.name == name)
    return _field(**{**vars(row), **changes})


def read(kind: type[Configuration], given: Mapping[str, Any]) -> Configuration:
    """Return a dataclass of parameters with the values given.

    Args:
        kind: the dataclass.
        given: values by name, as from YAML; those that are missing or None have their default.

    Raises:
        SettingError: a value is missing, of another type, not allowed, or does not fit others.
    """
    table = parameter_table(kind)
    values = {row.name: row.coerce(given.get(row.name)) for row in table}
    joints = values.get("joints", ())
    if any(row.per_joint for row in table) and (
        not joints or len(set(joints)) != len(joints) or "" in joints
    ):
        raise SettingError("joints", list(joints), "at least one joint name, each once")
    for row in table:
        length = len(joints) if row.per_joint else row.length
        if row.optional and not len(values[row.name]):
            if row.if_empty is not None and length is not None:
                values[row.name] = np.full(length, row.if_empty)
        elif row.per_joint:
            check_per_joint(row.name, values[row.name], joints)
    return _made(kind, values)


def _made(kind: type[Configuration], values: Mapping[str, Any], prefix: str = "") -> Configuration:
    made: dict[str, Any] = {}
    for each in fields(kind):  # type: ignore[arg-type]
        if _PARAMETER in each.metadata:
            made[each.name] = values[prefix + each.name]
        elif _GROUP in each.metadata:
            of, its_prefix = each.metadata[_GROUP]
            made[each.name] = _made(of, values, its_prefix)
    return kind(**made)


def check(settings: Any, prefix: str = "") -> None:
    """Check the parameters of a dataclass that was perhaps not made by `read`.

    Args:
        settings: the dataclass.
        prefix: of the parameters' names, as in `group`.

    Raises:
        SettingError: a value of another type, or not allowed.
    """
    for row in parameter_table(type(settings), prefix):
        row.coerce(getattr(settings, row.name.removeprefix(prefix)))


def check_per_joint(name: str, value: Array, joints: Sequence[str]) -> None:
    """Check that parameter `name` has one number for each of `joints`.

    Raises:
        SettingError: another length, or a NaN.
    """
    if len(value) != len(joints):
        raise SettingError(name, value, f"{len(joints)} numbers, one for each of 'joints'")
    if np.isnan(value).any():
        raise SettingError(name, value, "numbers, not NaN")
