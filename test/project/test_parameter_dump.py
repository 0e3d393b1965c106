# SPDX-License-Identifier: Apache-2.0
"""Parameters through a node's services, as ``ros2 param dump`` reads them."""

import dataclasses

import numpy as np
import pytest
import rclpy
import yaml
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.signals import SignalHandlerOptions

from sim_bridge.node.bullet_node import BulletNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.parameter import parameter_table, read
from viability_bounds_pkg.parameter_files import remember_arguments
from viability_bounds_pkg.testing.ros_harness import overrides, private_domain, read_config

RATES = [1e3, 1e9, 1e-9, 1.0, 2.0, 3.0, 4.0]
EXTRA = {
    BoundsNode: {"method": "naive", "bounds_dt_factor": 3},
    ControllerNode: {"pose_kd": 1e-7, "safety_filter": True, "torque_rate_max": RATES},
    BulletNode: {"start_paused": True},
}
"""More values for the Panda: whole numbers, very large and very small ones."""


def read_all(ros, node):
    """Return all parameters of a node, as its services tell them."""
    listed = ros.call(ListParameters, f"{node}/list_parameters", ListParameters.Request())
    names = sorted(listed.result.names)
    answer = ros.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=names))
    return dict(zip(names, map(parameter_value_to_python, answer.values), strict=True))


def dump(node, values):
    """Return the text that ``ros2 param dump`` prints."""
    nested = {}
    for name, value in values.items():
        inner, *names = nested, *name.split(".")
        for part in names[:-1]:
            inner = inner.setdefault(part, {})
        inner[names[-1]] = value
    return yaml.dump({node: {"ros__parameters": nested}}, default_flow_style=False)


@pytest.mark.parametrize("kind", EXTRA, ids=lambda kind: kind.NAME)
def test_a_node_starts_from_its_own_dump_with_the_same_configuration(ros, tmp_path, kind):
    known = {row.name for row in parameter_table(kind.PARAMETERS)}
    given = read_config("panda", kind.NAME) | EXTRA[kind]
    given = {name: value for name, value in given.items() if name in known}
    ros.add(kind(context=ros.context, parameter_overrides=overrides(given), namespace="left"))
    values = read_all(ros, f"/left/{kind.NAME}")
    file = tmp_path / "dump.yaml"
    file.write_text(dump(f"/left/{kind.NAME}", values))
    assert "locked_joints: null" in file.read_text()  # not given, and there is no default
    arguments = ["--ros-args", "-r", "__ns:=/left", "--params-file", str(file)]
    context = rclpy.Context()
    with private_domain() as domain:
        rclpy.init(
            args=arguments,
            context=context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        remember_arguments(context, arguments)
        try:
            again = kind(context=context)
            told = {name: again.get_parameter(name).value for name in values}
            again.destroy_node()
        finally:
            rclpy.shutdown(context=context)
    own = sorted(known & set(told))
    before, after = (
        read(kind.PARAMETERS, {name: each[name] for name in own if each[name] is not None})
        for each in (given | {name: values[name] for name in own}, told)
    )
    np.testing.assert_equal(dataclasses.asdict(after), dataclasses.asdict(before))
    np.testing.assert_equal(
        *({name: np.array(each[name]) for name in values} for each in (told, values))
    )
