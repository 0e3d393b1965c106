# SPDX-License-Identifier: Apache-2.0
"""Parameters through a node's services, as ``ros2 param describe`` and ``dump`` read them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.signals import SignalHandlerOptions

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.ros.given_parameters import remember_arguments
from viability_bounds_pkg.testing.ros_harness import overrides, private_domain, read_config

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config"

NODES = {node.NAME: node for node in (BoundsNode, ControllerNode, BulletNode, ScenarioNode)}
EXTRA = {
    "bounds_node": {"method": "naive", "bounds_dt_factor": 3},
    "controller_node": {
        "pose_kd": 1e-7,
        "safety_filter": True,
        "torque_rate_max": [1e3, 1e9, 1e-9, 1.0, 2.0, 3.0, 4.0],
    },
    "bullet_node": {"start_paused": True},
    "scenario_node": {"ready_timeout": 1e3},
}
"""More values for the Panda: whole numbers, very large and very small ones."""


def start(ros, kind, robot):
    """Start a node with the parameters of a robot in the namespace ``left``."""
    known = {row.name for row in parameter_table(kind.PARAMETERS)}
    values = read_config(robot, kind.NAME)
    values |= EXTRA[kind.NAME] if robot == "panda" else {}
    values = {name: value for name, value in values.items() if name in known}
    if kind is ScenarioNode:
        values["scenario"] = str(CONFIG / "scenarios" / f"{robot}_demo.yaml")
    return ros.add(
        kind(context=ros.context, parameter_overrides=overrides(values), namespace="left")
    )


def configuration_of(node):
    """Return what a node has made of its parameters."""
    return node.config if isinstance(node, ScenarioNode) else node._node_parameters.configuration


def read_all(ros, node):
    """Return all parameters of a node, as its services tell them."""
    listed = ros.call(ListParameters, f"{node}/list_parameters", ListParameters.Request())
    names = sorted(listed.result.names)
    answer = ros.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=names))
    values = map(parameter_value_to_python, answer.values)
    return dict(zip(names, values, strict=True))


def dump(node, values):
    """Return the text that ``ros2 param dump`` prints."""
    nested = {}
    for name, value in values.items():
        inner, *names = nested, *name.split(".")
        for part in names[:-1]:
            inner = inner.setdefault(part, {})
        inner[names[-1]] = value
    return yaml.dump({node: {"ros__parameters": nested}}, default_flow_style=False)


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
@pytest.mark.parametrize("name", NODES)
def test_a_node_starts_from_its_own_dump_with_the_same_configuration(ros, tmp_path, name, robot):
    first = start(ros, NODES[name], robot)
    values = read_all(ros, f"/left/{name}")
    file = tmp_path / "dump.yaml"
    file.write_text(dump(f"/left/{name}", values))
    if robot == "panda":  # which gives none, and there is no default
        assert "locked_joints: null" in file.read_text()
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
            again = NODES[name](context=context)
            assert again.get_fully_qualified_name() == f"/left/{name}"
            told = {key: again.get_parameter(key).value for key in values}
            configuration = configuration_of(again)
            again.destroy_node()
        finally:
            rclpy.shutdown(context=context)
    np.testing.assert_equal(
        {key: np.array(value) for key, value in told.items()},
        {key: np.array(value) for key, value in values.items()},
    )
    np.testing.assert_equal(
        dataclasses.asdict(configuration),
        dataclasses.asdict(configuration_of(first)),
    )


@pytest.mark.parametrize("name", NODES)
def test_every_number_is_described_with_its_range(ros, name):
    start(ros, NODES[name], "panda")
    table = {row.name: row for row in parameter_table(NODES[name].PARAMETERS)}
    answer = ros.call(
        DescribeParameters,
        f"/left/{name}/describe_parameters",
        DescribeParameters.Request(names=list(table)),
    )
    for shown, row in zip(answer.descriptors, table.values(), strict=True):
        assert shown.description == row.description
        ranges = [*shown.floating_point_range, *shown.integer_range]
        assert len(ranges) == (row.kind in (float, int)), row.name
