# SPDX-License-Identifier: Apache-2.0
"""The installed executables: what stops them at start, and how they end."""

import os
import signal
import subprocess
from pathlib import Path

import pytest
import yaml

from sim_bridge.node import bullet_node
from torque_safety_controller.node import controller_node
from viability_bounds_pkg.node import bounds_node, estimator_node
from viability_bounds_pkg.testing.executables import as_child

ROOT = Path(__file__).resolve().parents[2]
DEADLINE = 30.0  # s

BOUNDS = ("viability_bounds_pkg", "bounds_node")
ESTIMATOR = ("viability_bounds_pkg", "estimator_node")
CONTROLLER = ("torque_safety_controller", "controller_node")
ROBOT = ("sim_bridge", "bullet_node")
SIMULATED = ("sim_bridge", "simulated_stack")
MAIN = {
    BOUNDS: bounds_node.main,
    ESTIMATOR: estimator_node.main,
    CONTROLLER: controller_node.main,
    ROBOT: bullet_node.main,
}
"""What the executables call, for what needs no process of its own."""


def command(node, *arguments):
    package, executable = node
    path = ROOT / "install" / package / "lib" / package / executable
    return [path, "--ros-args", "--log-level", "warn", *map(str, arguments)]


def parameter_file(directory, robot="panda", **changes):
    """Write a robot's file with some parameters changed, wherever in it they are."""
    content = yaml.safe_load((ROOT / "config" / f"{robot}.yaml").read_text())
    for name, value in changes.items():
        sections = [part["ros__parameters"] for part in content.values()]
        holders = [section for section in sections if name in section] or sections[:1]
        for section in holders:
            section[name] = value
    path = directory / "robot.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def panda(name):
    content = yaml.safe_load((ROOT / "config" / "panda.yaml").read_text())
    return next(
        p["ros__parameters"][name] for p in content.values() if name in p["ros__parameters"]
    )


def changed(name, index, value):
    """A per-joint list with one number replaced."""
    values = list(panda(name))
    values[index] = value
    return {name: values}


@pytest.mark.parametrize(
    ("node", "changes", "names"),
    [
        # One for each node; all others are in the tests of the nodes' parameters.
        (BOUNDS, changed("position_min", 1, 9.0), "position_m"),
        (ESTIMATOR, changed("velocity_max", 0, -1.0), "velocity_max"),
        (CONTROLLER, {"joints": ["panda_joint1", "no_such_joint"]}, "position_min"),
        (ROBOT, {"physics_step_max": 0.0}, "physics_step_max"),
    ],
)
def test_a_bad_parameter_ends_a_node_with_one_line(tmp_path, capfd, node, changes, names):
    file = parameter_file(tmp_path, **changes)
    assert MAIN[node]([*map(str, command(node, "--params-file", file))]) == 1
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: parameter '")
    assert names in lines[0]
    assert "allowed" in lines[0]


@pytest.mark.parametrize("node", [BOUNDS, ESTIMATOR, CONTROLLER, ROBOT])
def test_a_missing_parameter_is_named(capfd, node):
    assert MAIN[node](list(map(str, command(node)))) == 1
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert "not set" in lines[0]


@pytest.mark.parametrize(
    "text", ["a: [", "/**:\n  ros__parameters:\n    rate_hz: [1.0, 2]\n", None]
)
def test_a_file_that_is_not_parameters_is_refused_in_one_line(tmp_path, capfd, text):
    path = tmp_path / "broken.yaml"
    if text is not None:
        path.write_text(text)
    assert MAIN[BOUNDS]([*map(str, command(BOUNDS, "--params-file", path))]) == 1
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1
    assert "broken.yaml" in lines[0]


# Both signals take the same way in every program; test_programs.py sends one each, and
# test_one_process.py ends safety_stack, and simulated_stack in lockstep.
@pytest.mark.parametrize(
    ("node", "options", "sent"),
    [
        pytest.param(BOUNDS, (), signal.SIGINT, marks=pytest.mark.long),
        (ESTIMATOR, (), signal.SIGTERM),
        (CONTROLLER, (), signal.SIGINT),
        pytest.param(ROBOT, ("-p", "clock:=real_time"), signal.SIGINT, marks=pytest.mark.long),
        (ROBOT, ("-p", "clock:=lockstep"), signal.SIGTERM),
        (SIMULATED, ("-p", "clock:=real_time"), signal.SIGINT),
    ],
    ids=[
        "bounds",
        "estimator",
        "controller",
        "robot in real time",
        "robot in lockstep",
        "all in real time",
    ],
)
def test_nodes_end_when_told_to(ros, node, options, sent):
    process = subprocess.Popen(
        command(node, "--params-file", ROOT / "config" / "panda.yaml", *options),
        env=os.environ | {"ROS_DOMAIN_ID": str(ros.domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    )
    try:
        # It spins when its first timer has run.
        ros.wait_until(
            lambda: (
                {node[1], "controller_node"} & set(ros.diagnostics) or process.poll() is not None
            ),
            timeout=DEADLINE,
        )
        process.send_signal(sent)
        _, errors = process.communicate(timeout=DEADLINE)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert not {word for word in ("Traceback", "Exception", "Error") if word in errors}, errors
