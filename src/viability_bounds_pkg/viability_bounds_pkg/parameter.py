# SPDX-License-Identifier: Apache-2.0
"""Parameters, each declared once: as a field of a frozen dataclass, its configuration.

`number`, `text`, `joint_numbers` and the others return the field of a parameter, with the values
that are allowed; the name of the field is that of the parameter. `read` checks values, as from
YAML, and makes the dataclass of them. Only conditions between several parameters are written by
hand, in its ``__post_init__``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError, did_you_mean

Array = NDArray[np.float64]
Configuration = TypeVar("Configuration")

LARGEST = 1e12
"""No parameter of a robot has a larger finite number; computing with such numbers overflows."""

MOST_PERIODS = 100
"""Longest delay and row of missed deadlines, control periods."""

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


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """What is known about a parameter.

    Attributes:
        name: ROS name; that of the field.
        kind: `float`, `int`, `bool`, `str`, `list[float]` or `list[str]`. Whole numbers are
            taken where floats are wanted, because YAML writers leave the point out.
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
        """Return `value` as `kind`.

        Raises:
            SettingError: the value is missing, of another type, or not allowed.
        """
        if value is None:
            if self.default is REQUIRED:
                raise SettingError(self.name, None, self._kind_name())
            return np.array(self.default) if self.kind == list[float] else self.default
        converted = self._convert(value)
        if self.kind in (float, list[float]) and _is_absurd(converted):
            raise SettingError(self.name, value, f"numbers up to {LARGEST:g} in size")
        if not self._allows(converted):
            hint = did_you_mean(value, self.choices) if self.choices else ""
            raise SettingError(self.name, value, self.constraints + hint)
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
        elif self.kind in (float, int) and self.within is not None:
            text = f"{_SCALARS[self.kind]} {self.within}"
        elif self.kind == list[float]:
            numbers = "numbers" if self.within is None else f"finite numbers {self.within}".strip()
            if self.length is not None:
                text = f"{self.length} {numbers}"
            elif self.per_joint:
                text = f"{numbers}, one for each of 'joints'"
            elif self.within is not None:
                text = numbers
            text += ", or none" if text and self.optional else ""
        return "; ".join(filter(None, (text, self.note)))

    def _convert(self, value: Any) -> Any:
        if self.kind == list[float] and _is_sequence(value) and all(map(_is_number, value)):
            return np.array(value, dtype=float)
        if (
            self.kind == list[str]
            and _is_sequence(value)
            and all(isinstance(item, str) for item in value)
        ):
            return tuple(value)
        if self.kind is float and _is_number(value):
            return float(value)
        if self.kind in (int, bool, str) and type(value) is self.kind:
            return value
        raise SettingError(self.name, value, self._kind_name())

    def _allows(self, value: Any) -> bool:
        if self.choices:
            return value in self.choices
        if not _is_sequence(value):
            return self.within is None or value in self.within
        if not len(value) and self.optional:
            return True
        if self.length is not None and len(value) != self.length:
            return False
        return self.within is None or all(item in self.within for item in value)

    def _kind_name(self) -> str:
        if self.kind in (float, int, bool, str):
            return _SCALARS[self.kind]
        if self.length is not None:
            return self.constraints
        return "a list of numbers" if self.kind == list[float] else "a list of strings"


_SCALARS = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}


def _is_absurd(value: float | Array) -> bool:
    """Return whether there is a finite number that is larger than any should be."""
    size = np.abs(value)
    return bool(((size > LARGEST) & (size < np.inf)).any())


def _is_sequence(value: Any) -> bool:
    return not isinstance(value, str | bytes) and hasattr(value, "__len__")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def number(description: str, within: Range | None = None, **more: Any) -> Any:
    """Return the field of a float; `more` as in `Parameter`."""
    return _field(kind=float, description=description, within=within, **more)


def whole_number(description: str, within: Range | None = None, **more: Any) -> Any:
    """Return the field of an int; `more` as in `Parameter`."""
    return _field(kind=int, description=description, within=within, **more)


def switch(description: str, **more: Any) -> Any:
    """Return the field of a bool; `more` as in `Parameter`."""
    return _field(kind=bool, description=description, **more)


def text(description: str, **more: Any) -> Any:
    """Return the field of a string; `more` as in `Parameter`."""
    return _field(kind=str, description=description, **more)


def texts(description: str, **more: Any) -> Any:
    """Return the field of a list of strings, a tuple; `more` as in `Parameter`."""
    return _field(kind=list[str], description=description, **more)


def numbers(description: str, within: Range | None = None, **more: Any) -> Any:
    """Return the field of a list of numbers, an array; `more` as in `Parameter`.

    With `if_empty` the list may be left out.
    """
    if "if_empty" in more:
        more["default"] = ()
    return _field(kind=list[float], description=description, within=within, **more)


def joint_numbers(description: str, within: Range | None = None, **more: Any) -> Any:
    """Return the field of an array with one number a joint; `more` as for `numbers`."""
    return numbers(description, within, per_joint=True, **more)


def joint_amounts(description: str, **more: Any) -> Any:
    """Return the field of an array of numbers >= 0, one a joint; all 0 if it is left out."""
    return joint_numbers(description, NOT_NEGATIVE, if_empty=0.0, **more)


def periods(description: str) -> Any:
    """Return the field of a number of control periods, 0 if it is left out."""
    return whole_number(description, Range(0, MOST_PERIODS), default=0)


def timeout(description: str, default: float) -> Any:
    """Return the field of a time, s, that something is waited for or lasts at most."""
    return number(description, above(0.0, 3600.0), default=default)


def group(kind: type, prefix: str = "") -> Any:
    """Return the field of a dataclass of parameters, whose names begin with `prefix`."""
    return field(metadata={_GROUP: (kind, prefix)})


_PARAMETER, _GROUP = "parameter", "group"


def _field(**row: Any) -> Any:
    parameter = Parameter(**row)
    metadata = {_PARAMETER: parameter}
    if parameter.default is REQUIRED:
        return field(metadata=metadata)
    if parameter.kind == list[float]:
        return field(metadata=metadata, default_factory=lambda: parameter.coerce(None))
    return field(metadata=metadata, default=parameter.default)


_TABLES: dict[tuple[type, str], tuple[Parameter, ...]] = {}
"""Made so far: a running node needs its own for each parameter that is set."""


def parameter_table(kind: type, prefix: str = "") -> tuple[Parameter, ...]:
    """Return the parameters that a dataclass and its groups declare, in their order.

    Args:
        kind: the dataclass.
        prefix: of the names, as in `group`.
    """
    if (kind, prefix) in _TABLES:
        return _TABLES[kind, prefix]
    rows: list[Parameter] = []
    for each in fields(kind):
        if _PARAMETER in each.metadata:
            rows.append(replace(each.metadata[_PARAMETER], name=prefix + each.name))
        elif _GROUP in each.metadata:
            rows += parameter_table(*each.metadata[_GROUP])
    _TABLES[kind, prefix] = table = tuple(rows)
    return table


def redeclared(kind: type, name: str, **changes: Any) -> Any:
    """Return the field of a parameter that the dataclass `kind` declares, with changes."""
    (row,) = (row for row in parameter_table(kind) if row.name == name)
    return _field(**vars(replace(row, **changes)))


def read(kind: type[Configuration], given: Mapping[str, Any]) -> Configuration:
    """Return a dataclass of parameters with the values given.

    Args:
        kind: the dataclass.
        given: values by name, as from YAML; those that are missing or None have their default.

    Raises:
        SettingError: a value is missing, of another type, or not allowed.
    """
    return make(kind, checked_values(kind, given))


def checked_values(
    kind: type, given: Mapping[str, Any], before: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the values of all parameters of a dataclass by name, each checked by itself.

    Args:
        kind: the dataclass.
        given: values by name; None is the default.
        before: what this returned for values of which only the given ones have changed; without
            it, those that are missing have their default.

    Raises:
        SettingError: a value is missing, of another type, or not allowed.
    """
    table = parameter_table(kind)
    if before is not None and "joints" not in given:
        table = tuple(row for row in table if row.name in given)
    else:
        before = {}
    values = {row.name: row.coerce(given.get(row.name)) for row in table}
    joints = values.get("joints", before.get("joints", ()))
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
    return {**before, **values}


def make(
    kind: type[Configuration],
    values: Mapping[str, Any],
    before: Configuration | None = None,
    changed: Collection[str] = (),
    prefix: str = "",
) -> Configuration:
    """Return a dataclass of parameters.

    Args:
        kind: the dataclass.
        values: of `checked_values`.
        before: what this returned before the values of `changed` changed: its groups without any
            of them are kept. None makes all anew.
        changed: names.
        prefix: of the names, as in `group`.

    Raises:
        SettingError: values that do not fit each other.
    """
    made: dict[str, Any] = {}
    for each in fields(kind):  # type: ignore[arg-type]
        if _PARAMETER in each.metadata:
            made[each.name] = values[prefix + each.name]
        elif _GROUP in each.metadata:
            of, its_prefix = each.metadata[_GROUP]
            kept = None if before is None else getattr(before, each.name)
            if kept is None or any(row.name in changed for row in parameter_table(of, its_prefix)):
                kept = make(of, values, kept, changed, its_prefix)
            made[each.name] = kept
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
