# SPDX-License-Identifier: Apache-2.0
"""Declare, check and update a node's parameters in one place.

Each node lists its parameters as `Parameter` rows and turns their values into one frozen
dataclass, its configuration, in a function that raises `SettingError` for what it cannot
accept. A row says which values are allowed; the function checks only what concerns several
parameters. The same checks judge the values at start, where an error ends the node with one
line, and those set while it runs, where an error refuses the change and the old value stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node

from viability_bounds_pkg.exceptions import SettingError

Configuration = TypeVar("Configuration")

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


@dataclass(frozen=True)
class Parameter:
    """One row of a node's parameter table.

    Attributes:
        name: ROS name.
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
        note: what else must be known about allowed values, in words.
    """

    name: str
    kind: Any
    description: str
    default: Any = REQUIRED
    live: bool = False
    within: Range | None = field(default=None, kw_only=True)
    choices: tuple[str, ...] = field(default=(), kw_only=True)
    length: int | None = field(default=None, kw_only=True)
    per_joint: bool = field(default=False, kw_only=True)
    note: str = field(default="", kw_only=True)

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
        return "a list of numbers" if self.kind == list[float] else "a list of strings"


_SCALARS = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}


def _is_sequence(value: Any) -> bool:
    return not isinstance(value, str | bytes) and hasattr(value, "__len__")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def read_values(table: Sequence[Parameter], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of each parameter of a table, by name, and check it.

    Args:
        table: the parameters.
        given: their values, as from YAML; those that are missing or None have their default.

    Raises:
        SettingError: a value is missing, of another type, or not allowed.
    """
    values = {row.name: row.coerce(given.get(row.name)) for row in table}
    _check_joints(table, values)
    return values


def _check_joints(table: Sequence[Parameter], values: Mapping[str, Any]) -> None:
    rows = [row for row in table if row.per_joint]
    if not rows:
        return
    joints = joint_names(values)
    for row in rows:
        if not row.optional or len(values[row.name]):
            per_joint(values, row.name, joints)


class NodeParameters(Generic[Configuration]):
    """A node's parameters: declared once, checked together, changed together.

    Args:
        node: the node that declares them.
        table: its parameters.
        make: turns the values by name into the node's configuration; raises `SettingError`.
        on_change: called with the new configuration after live parameters changed.

    Attributes:
        values: by name, as they are now.
        configuration: what `make` made of them.

    Raises:
        SettingError: a value is missing, of another type, or not allowed.
    """

    def __init__(
        self,
        node: Node,
        table: Sequence[Parameter],
        make: Callable[[Mapping[str, Any]], Configuration],
        on_change: Callable[[Configuration], None] | None = None,
    ) -> None:
        self._table = {row.name: row for row in table}
        self._make = make
        self._on_change = on_change
        self.values = read_values(table, {row.name: _declare(node, row) for row in table})
        self.configuration = make(self.values)
        for row in table:
            node.set_descriptor(row.name, describe(row))
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _merged(self, parameters: Sequence[Any]) -> dict[str, Any]:
        changed = {p.name: p.value for p in parameters if p.name in self._table}
        return read_values(list(self._table.values()), self.values | changed)

    def _judge(self, parameters: Sequence[Any]) -> SetParametersResult:
        try:
            self._make(self._merged(parameters))
        except SettingError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Any]) -> None:
        if not any(p.name in self._table for p in parameters):
            return
        self.values = self._merged(parameters)
        self.configuration = self._make(self.values)
        if self._on_change is not None:
            self._on_change(self.configuration)


def _declare(node: Node, row: Parameter) -> Any:
    """Declare a parameter; return the value that it was given or its default.

    Its range follows when the value has been checked: rclpy's own check does not tell the value.
    """
    descriptor = ParameterDescriptor(dynamic_typing=True)
    return node.declare_parameter(row.name, _ros_default(row), descriptor).value


def _ros_default(row: Parameter) -> Any:
    if row.default is REQUIRED or row.optional:
        return None  # an empty list has no ROS type: lists that default to it stay unset
    return list(row.default) if _is_sequence(row.default) else row.default


def describe(row: Parameter) -> ParameterDescriptor:
    """Return what ``ros2 param describe`` shows of a parameter."""
    descriptor = ParameterDescriptor(
        name=row.name,
        description=row.description,
        additional_constraints=row.constraints,
        read_only=not row.live,
        # Types are checked by Parameter.coerce, which takes 1 for 1.0 and says what is wrong.
        dynamic_typing=True,
    )
    if row.within is not None and row.kind in (float, int):
        low, high, special = row.within.low, row.within.high, row.within.special
        ends = [low, high] if special is None else [min(low, special), max(high, special)]
        if row.kind is float:
            of = FloatingPointRange(from_value=float(ends[0]), to_value=float(ends[1]))
            descriptor.floating_point_range = [of]
        else:
            of = IntegerRange(from_value=int(ends[0]), to_value=int(ends[1]))
            descriptor.integer_range = [of]
    return descriptor


def per_joint(values: Mapping[str, Any], name: str, joints: Sequence[str]) -> NDArray[np.float64]:
    """Return parameter `name` as an array of shape (n,), one number a joint.

    Raises:
        SettingError: another length, or a NaN.
    """
    value: NDArray[np.float64] = values[name]
    if len(value) != len(joints):
        raise SettingError(name, value, f"{len(joints)} numbers, one for each of 'joints'")
    if np.isnan(value).any():
        raise SettingError(name, value, "numbers, not NaN")
    return value


def given_or(
    values: Mapping[str, Any], name: str, default: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the numbers of parameter `name`, or `default` where there are none."""
    value: NDArray[np.float64] = values[name]
    return value if len(value) else default


def joint_names(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parameter ``joints``: at least one name, none twice.

    Raises:
        SettingError: it is empty or names a joint twice.
    """
    joints = values["joints"]
    if not joints or len(set(joints)) != len(joints) or "" in joints:
        raise SettingError("joints", list(joints), "at least one joint name, each once")
    return joints
