# SPDX-License-Identifier: Apache-2.0
"""Declares a node's parameters in ROS, and keeps its configuration when they change.

The same checks judge the values at start, where an error ends the node with one line, and those
set while it runs, where an error refuses the change and the old value stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)

from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError
from viability_bounds_pkg.parameter import REQUIRED, Parameter, parameter_table, read
from viability_bounds_pkg.parameter_files import unknown_parameters
from viability_bounds_pkg.ros.arm_node import ArmNode

Configuration = TypeVar("Configuration")

_NO_FILE = "; the robot's parameter file is given by --ros-args --params-file FILE"


class UnknownParameterError(ArmSafetyError, ValueError):
    """A parameter was given that no node of this project has."""


class NodeParameters(Generic[Configuration]):
    """A node's parameters: declared once, checked together, changed together.

    Args:
        node: the node that declares them.
        kind: the dataclass that they are fields of.
        on_change: called with the new configuration after live parameters changed.
        check: raises `SettingError` for a new configuration that cannot be used after all.

    Attributes:
        configuration: their values now.

    Raises:
        UnknownParameterError: a name that no node has.
        SettingError: a value is missing, of another type, or not allowed.
    """

    def __init__(
        self,
        node: ArmNode,
        kind: type[Configuration],
        on_change: Callable[[Configuration], None] | None = None,
        check: Callable[[Configuration], Any] | None = None,
    ) -> None:
        self._kind, self._on_change, self._check = kind, on_change, check
        table = parameter_table(kind)
        if unknown := unknown_parameters(node.given, (row.name for row in table)):
            raise UnknownParameterError(unknown)
        self._values = {row.name: _declare(node, row) for row in table}
        try:
            self.configuration = read(kind, self._values)
        except SettingError as error:
            if error.value is None and not node.given:
                raise SettingError(error.name, None, error.allowed + _NO_FILE) from error
            raise
        self._judged = self._values, self.configuration
        for row in table:
            # Not before its value has been checked: rclpy does not tell the one that it refuses.
            node.set_descriptor(row.name, describe(row))
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _changed(self, parameters: Sequence[Any]) -> dict[str, Any]:
        return {each.name: each.value for each in parameters if each.name in self._values}

    def _judge(self, parameters: Sequence[Any]) -> SetParametersResult:
        changed = self._changed(parameters)
        if not changed:
            return SetParametersResult(successful=True)
        if None in changed.values():
            return SetParametersResult(reason="parameters cannot be deleted")
        values = self._values | changed
        try:
            configuration = read(self._kind, values)
            if self._check is not None:
                self._check(configuration)
        except ArmSafetyError as error:  # settings that contradict each other raise others
            return SetParametersResult(reason=str(error))
        self._judged = values, configuration
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Any]) -> None:
        if self._changed(parameters):
            self._values, self.configuration = self._judged
            if self._on_change is not None:
                self._on_change(self.configuration)


def _declare(node: ArmNode, row: Parameter) -> Any:
    """Declare a parameter; return the value that it was given, or its default.

    An empty list has no ROS type: lists that are left out stay unset.
    """
    value = node.given.get(row.name)
    if value is not None:
        row.coerce(value)  # rclpy does not know all types of YAML
    if value is None or value == []:
        value = None if row.default is REQUIRED or row.optional else row.default
    if row.kind == list[float] and value is not None:
        value = list(value)
    dynamic, ours = ParameterDescriptor(dynamic_typing=True), row.name in node.given
    return node.declare_parameter(row.name, value, dynamic, ignore_override=ours).value


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
        if special is not None:
            low, high = min(low, special), max(high, special)
        if row.kind is float:
            floats = FloatingPointRange(from_value=float(low), to_value=float(high))
            descriptor.floating_point_range = [floats]
        else:
            whole = IntegerRange(from_value=int(low), to_value=int(high))
            descriptor.integer_range = [whole]
    return descriptor
