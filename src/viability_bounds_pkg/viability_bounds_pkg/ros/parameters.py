# SPDX-License-Identifier: Apache-2.0
"""Declares a node's parameters in ROS, and keeps its configuration when they change.

The same checks judge the values at start, where an error ends the node with one line, and those
set while it runs, where an error refuses the change and the old value stays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError, did_you_mean
from viability_bounds_pkg.parameter import (
    REQUIRED,
    Parameter,
    checked_values,
    make,
    parameter_table,
)
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.given_parameters import (
    UnknownParameterError,
    arguments_of,
    foreign_sections,
    given_parameters,
    refuse_renamed,
    why_missing,
)
from viability_bounds_pkg.user_input.known_names import unknown_parameters

Configuration = TypeVar("Configuration")


class UndeclaredParameterError(ArmSafetyError, ParameterNotDeclaredException):
    """A parameter is to be set that the node has not; rclpy's own text (7.1) names none."""

    def __init__(self, text: str) -> None:
        Exception.__init__(self, text)


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
        arguments, name = arguments_of(node.context), node.get_fully_qualified_name()
        refuse_renamed(arguments, name, node.NAME)
        for section in foreign_sections(arguments, name):
            node.get_logger().warning(
                f"the section '{section}' of a parameter file is not for this node, '{name}'; "
                f"'/**{section[section.rindex('/') :]}' is for all namespaces"
            )
        _settle(node, given_parameters(arguments, name), [row.name for row in table])
        self._values = {row.name: _declare(node, row) for row in table}
        try:
            self._checked = checked_values(kind, self._values)
            self.configuration = make(kind, self._checked)
        except SettingError as error:
            if error.value is not None:
                raise
            raise SettingError(
                error.name, None, error.allowed + why_missing(arguments, name)
            ) from error
        for row in table:
            node.set_descriptor(row.name, describe(row))
        self._node, self._judged = node, (self._checked, self.configuration)
        node.add_pre_set_parameters_callback(self._refuse_undeclared)
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _changed(self, parameters: Sequence[Any]) -> dict[str, Any]:
        return {p.name: p.value for p in parameters if p.name in self._values}

    def _refuse_undeclared(self, parameters: list[RosParameter]) -> list[RosParameter]:
        for parameter in parameters:
            if not self._node.has_parameter(parameter.name):
                declared = self._node.list_parameters([], 0).names
                name = parameter.name
                raise UndeclaredParameterError(
                    f"unknown parameter '{name}'{did_you_mean(name, declared)}"
                )
        return parameters

    def _judge(self, parameters: Sequence[Any]) -> SetParametersResult:
        changed = self._changed(parameters)
        self._judged = self._checked, self.configuration
        if not any(_differs(self._values[name], value) for name, value in changed.items()):
            return SetParametersResult(successful=True)
        try:
            # What has not changed is not read again: it would keep a control loop waiting.
            values = checked_values(self._kind, changed, self._checked)
            configuration = make(self._kind, values, self.configuration, changed)
            if self._check is not None:
                self._check(configuration)
        except ArmSafetyError as error:  # settings that contradict each other raise others
            return SetParametersResult(successful=False, reason=str(error))
        self._judged = values, configuration
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Any]) -> None:
        changed = self._changed(parameters)
        if not changed:
            return
        before = self.configuration
        self._values |= changed
        self._checked, self.configuration = self._judged
        for row in parameter_table(self._kind):
            if row.name in changed and not self._node.has_parameter(row.name):
                # `ros2 param delete` undeclares it.
                self._values[row.name] = _declare(self._node, row, ignore_override=True)
                self._node.set_descriptor(row.name, describe(row))
        if self._on_change is not None and self.configuration is not before:
            self._on_change(self.configuration)


def _settle(node: Node, given: Mapping[str, Any], known: Sequence[str]) -> None:
    """Make rclpy declare the values that were given last; refuse names that nobody knows."""
    values = node._parameter_overrides  # rclpy has no other way to tell
    for name, value in given.items():
        if value is None:
            values.pop(name, None)
        elif name not in values or _differs(values[name].value, value):
            values[name] = RosParameter(name, value=value)
    if unknown := unknown_parameters(values, known):
        raise UnknownParameterError(unknown)


def _differs(read: Any, given: Any) -> bool:
    """Return whether rcl read another value; arrays come as its own types."""
    if isinstance(given, list):
        read = read if hasattr(read, "__len__") else ()
        return len(read) != len(given) or any(map(_differs, read, given))
    return type(read) is not type(given) or (read != given and given == given)


def _declare(node: Node, row: Parameter, *, ignore_override: bool = False) -> Any:
    """Declare a parameter; return the value that it was given or its default.

    Its range follows when the value has been checked: rclpy's own check does not tell the value.
    """
    default = row.default
    if default is REQUIRED or row.optional:
        default = None  # an empty list has no ROS type: lists that default to it stay unset
    elif row.kind == list[float]:
        default = list(default)
    descriptor = ParameterDescriptor(dynamic_typing=True)
    declared = node.declare_parameter(row.name, default, descriptor, ignore_override)
    return declared.value


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
