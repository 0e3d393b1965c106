# SPDX-License-Identifier: Apache-2.0
"""The installed executables: what stops them at start, and how they end."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from sim_bridge.node import bullet_node
from torque_safety_controller.node import controller_node
from viability_bounds_pkg.node import bounds_node, estimator_node
from viability_bounds_pkg.testing.executables import as_child

ROOT = Path(__file__).resolve().parents[2]
DEADLINE = 90.0  # s
PACKAGES = {
    "bounds_node": "viability_bounds_pkg",
    "controller_node": "torque_safety_controller",
    "bullet_node": "sim_bridge",
    "simulated_stack": "sim_bridge",
}


@pytest.mark.parametrize("node", [bounds_node, estimator_node, controller_node, bullet_node])
def test_a_missing_parameter_is_named(capfd, node):
    assert node.main([node.__name__, "--ros-args", "--log-level", "warn"]) == 1
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert "not set" in lines[0]


# Both signals take the same way in every program.
@pytest.mark.parametrize(
    ("node", "sent", "options"),
    [
        pytest.param("bounds_node", signal.SIGINT, (), marks=pytest.mark.long),
        pytest.param("controller_node", signal.SIGTERM, (), marks=pytest.mark.long),
        pytest.param("bullet_node", signal.SIGTERM, ("clock:=lockstep",), marks=pytest.mark.long),
        ("simulated_stack", signal.SIGINT, ("clock:=real_time",)),
    ],
)
def test_a_program_ends_when_told_to(ros, node, sent, options):
    path = ROOT / "install" / PACKAGES[node] / "lib" / PACKAGES[node] / node
    options = [word for each in options for word in ("-p", each)]
    process = subprocess.Popen(
        [path, "--ros-args", "--log-level", "warn", *options]
        + ["--params-file", ROOT / "config" / "panda.yaml"],
        env=os.environ | {"ROS_DOMAIN_ID": str(ros.domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    )
    try:
        # It spins when its first timer has run.
        ros.wait_until(lambda: ros.diagnostics or process.poll() is not None, timeout=DEADLINE)
        process.send_signal(sent)
        _, errors = process.communicate(timeout=DEADLINE)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert not {word for word in ("Traceback", "Exception", "Error") if word in errors}, errors
