"""Declare, check and update a node's parameters in one place.

Each node lists its parameters as `Parameter` rows and turns their values into one frozen
dataclass, its configuration, in a function that raises `SettingError` for what it cannot
accept. The same function judges the values at start, where an error ends the node with one
line, and those set while it runs, where an error refuses the change and the old value stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node

from viability_bounds_pkg.exceptions import SettingError

Configuration = TypeVar("Configuration")

REQUIRED = object()
"""Default of a parameter that has none: the node does not start without a value."""


@dataclass(frozen=True)
class Parameter:
    """One row of a node's parameter table.

    Attributes:
        name: ROS name.
        kind: `float`, `int`, `bool`, `str`, `list[float]` or `list[str]`. Whole numbers are
            taken where floats are wanted, because YAML writers leave the point out.
        description: shown by ``ros2 param describe``; ends with the unit where there is one.
        default: value when none is given, or `REQUIRED`.
        live: may change while the node runs; all others are read-only.
    """

    name: str
    kind: Any
    description: str
    default: Any = REQUIRED
    live: bool = False

    def coerce(self, value: Any) -> Any:
        """Return `value` as `kind`.

        Raises:
            SettingError: the value is missing or of another type.
        """
        if value is None:
            if self.default is REQUIRED:
                raise SettingError(self.name, None, self._kind_name())
            return self.default
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

    def _kind_name(self) -> str:
        if self.kind in (float, int, bool, str):
            return _SCALARS[self.kind]
        return "a list of numbers" if self.kind == list[float] else "a list of strings"


_SCALARS = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}


def _is_sequence(value: Any) -> bool:
    return not isinstance(value, str | bytes) and hasattr(value, "__len__")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


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
        SettingError: a value is missing, of another type, or refused by `make`.
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
        self.values = {row.name: row.coerce(_declare(node, row)) for row in table}
        self.configuration = make(self.values)
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _merged(self, parameters: Sequence[Any]) -> dict[str, Any]:
        ours = [p for p in parameters if p.name in self._table]
        return self.values | {p.name: self._table[p.name].coerce(p.value) for p in ours}

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
    descriptor = ParameterDescriptor(
        name=row.name,
        description=row.description,
        read_only=not row.live,
        # Types are checked by Parameter.coerce, which takes 1 for 1.0 and says what is wrong.
        dynamic_typing=True,
    )
    # An empty list has no ROS type: lists that default to it stay unset.
    default = row.default if isinstance(row.default, float | int | bool | str) else None
    return node.declare_parameter(row.name, default, descriptor).value


def per_joint(values: Mapping[str, Any], name: str, joints: Sequence[str]) -> np.ndarray:
    """Return parameter `name` as an array of shape (n,), one number a joint.

    Raises:
        SettingError: another length, or a NaN.
    """
    value = values[name]
    if len(value) != len(joints):
        raise SettingError(name, value, f"{len(joints)} numbers, one for each of 'joints'")
    if np.isnan(value).any():
        raise SettingError(name, value, "numbers, not NaN")
    return value


def positive(values: Mapping[str, Any], name: str, *, zero: bool = False) -> float:
    """Return the scalar parameter `name`, checked to be finite and positive.

    Args:
        values: parameter values by name.
        name: which of them.
        zero: whether zero is allowed too.

    Raises:
        SettingError: it is negative, zero where that is not allowed, or not finite.
    """
    value = values[name]
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise SettingError(name, value, "a finite number " + (">= 0" if zero else "> 0"))
    return value


def joint_names(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parameter ``joints``: at least one name, none twice.

    Raises:
        SettingError: it is empty or names a joint twice.
    """
    joints = values["joints"]
    if not joints or len(set(joints)) != len(joints) or "" in joints:
        raise SettingError("joints", list(joints), "at least one joint name, each once")
    return joints
