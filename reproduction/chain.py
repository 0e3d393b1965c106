# SPDX-License-Identifier: Apache-2.0
"""The real nodes in one process, in lockstep, from a scenario to a recording."""

from __future__ import annotations

import gc
import os
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from rclpy.parameter import Parameter

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode, play
from sim_bridge.scenario.report import RecordedRun
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.parameter_files import YamlError, read_yaml, remember_arguments
from viability_bounds_pkg.ros.arm_node import connect

ROOT = Path(__file__).resolve().parent.parent
NODES = {
    "bounds_node": BoundsNode,
    "controller_node": ControllerNode,
    "estimator_node": EstimatorNode,
    "bullet_node": BulletNode,
    "scenario_node": ScenarioNode,
}


@dataclass(frozen=True)
class ChainResult:
    """A finished run.

    Attributes:
        run: states, bounds and torques by control period.
        robot: the robot's last diagnostics, by key: it saw every physics step.
        q: the true positions at the end, shape (n,), rad.
        refused: how many joint states any node refused.
    """

    run: RecordedRun
    robot: dict[str, str]
    q: np.ndarray
    refused: int

    def vector(self, key: str) -> np.ndarray:
        """Return a per-joint value of the robot's diagnostics."""
        return np.array([float(item) for item in self.robot[key].split()])


def load_values(robot: str) -> dict[str, Any]:
    """Return the parameters of all nodes in a robot's file, by name."""
    content = yaml.safe_load((ROOT / "config" / f"{robot}.yaml").read_text())
    return {k: v for part in content.values() for k, v in part["ros__parameters"].items()}


def load_node_values(robot: str, *overlays: str) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node, by its name, as it gets them from files.

    Args:
        robot: name of a file in ``config/``.
        overlays: of further files there, whose values count more.

    Raises:
        YamlError: a file that is missing or wrong.
    """
    values: dict[str, dict[str, Any]] = {name: {} for name in NODES}
    for each in (robot, *overlays):
        path = ROOT / "config" / f"{each}.yaml"
        content = read_yaml(path)
        if not isinstance(content, dict):
            raise YamlError(f"{path}: it has no parameters of nodes")
        for name, own in values.items():
            for section in ("/**", f"/**/{name}"):
                own |= content.get(section, {}).get("ros__parameters", {})
    return values


@contextmanager
def _context():
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    gc.collect()  # a run that failed leaves its participants to the garbage collector
    rclpy.init(args=["--ros-args", "--log-level", "error"])
    try:
        yield
    finally:
        rclpy.try_shutdown()


def run_chain(
    values: dict[str, Any],
    scenario: dict[str, Any],
    per_node: dict[str, dict[str, Any]],
    not_recorded: tuple[str, ...] = (),
    declared: bool = False,
) -> ChainResult:
    """Play a scenario through bounds, controller and robot node, in lockstep.

    Args:
        values: parameters of all nodes, by name.
        scenario: content of a scenario file.
        per_node: parameters that differ for one node, by node name; with ``estimator_node`` among
            them this node runs too.
        not_recorded: topics whose values are not needed: NaN; each costs 4% of a period to record.
        declared: whether other nodes know the parameters of the bounds node, as from a file.
    """
    lockstep = {
        "clock": "lockstep",
        "start_paused": True,
        "bounds_timeout": 5.0,
        "state_timeout": 10.0,
    }
    with tempfile.TemporaryDirectory() as directory, _context():
        path = Path(directory) / "scenario.yaml"
        path.write_text(yaml.safe_dump(scenario))
        if declared:
            own = values | per_node["bounds_node"]
            known = Path(directory) / "bounds.yaml"
            known.write_text(yaml.safe_dump({"/**/bounds_node": {"ros__parameters": own}}))
            remember_arguments(rclpy.get_default_context(), ("--params-file", str(known)))
        nodes: dict[str, Any] = {}
        try:
            for name, kind in NODES.items():
                if name == "estimator_node" and name not in per_node:
                    continue
                own = values | lockstep | {"scenario": str(path)} | per_node.get(name, {})
                given = [Parameter(key, value=value) for key, value in own.items() if value != []]
                nodes[name] = kind(parameter_overrides=given)
            player = nodes["scenario_node"]
            for each in list(player.inputs):
                if each.topic_name.removeprefix("/") in not_recorded:
                    each.unsubscribe()
                    player.inputs.remove(each)
            connect(list(nodes.values()))
            play(
                player, others=[each for each in nodes.values() if each is not player], quiet=True
            )
            readers = [nodes["controller_node"]._states]
            if "estimator_node" in nodes:
                readers.append(nodes["estimator_node"]._reader)
            return ChainResult(
                player.recorded_run(),
                player.robot,
                nodes["bullet_node"].true_positions,
                sum(reader.refused.total() for reader in readers),
            )
        finally:
            for node in nodes.values():
                node.destroy_node()
