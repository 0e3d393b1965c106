# SPDX-License-Identifier: Apache-2.0
"""Entry points of the package's programs, which import nothing heavy themselves."""

from __future__ import annotations

from viability_bounds_pkg.cli.ros_program import run_with_ros


def bullet_node() -> int:
    """Run the robot node."""
    return run_with_ros("bullet_node", "sim_bridge.nodes.bullet_node")


def record_excitation() -> int:
    """Run the recording of a motion that excites joint friction."""
    return run_with_ros("record_excitation", "sim_bridge.tools.record_excitation")


def scenario_node() -> int:
    """Run the scenario node."""
    return run_with_ros("scenario_node", "sim_bridge.nodes.scenario_node")


def simulated_stack() -> int:
    """Run the simulated robot and the nodes that control it in one process."""
    return run_with_ros("simulated_stack", "sim_bridge.nodes.simulated_stack")


def viewer_node() -> int:
    """Run the node that shows the arm in a browser."""
    libraries = {name: f"pip install {name}" for name in ("viser", "trimesh")}
    return run_with_ros("viewer_node", "sim_bridge.viewer.node.viewer_node", libraries)
