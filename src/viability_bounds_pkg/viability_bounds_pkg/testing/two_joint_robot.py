# SPDX-License-Identifier: Apache-2.0
"""A robot of two joints in files, for tests of executables."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

LIMITS = 'lower="-1" upper="2" effort="30" velocity="4"'
LIMIT = f"<limit {LIMITS}/>"
URDF = """
<robot name="arm"><link name="base"/>
<joint name="shoulder" type="{type}"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/>{limit}</joint>
<link name="arm"><inertial><origin xyz="0 0 -0.5"/><mass value="{mass}"/>
<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/>
<origin xyz="0 0 -0.5"/><axis xyz="0 1 0"/><limit {limits}/></joint>
<link name="hand"><inertial><origin xyz="0 0 -0.1"/><mass value="{hand_mass}"/>
<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>
"""
ROBOT = """\
# A comment.
/**:
  ros__parameters:
    robot_description: {urdf}
    joints: [shoulder, wrist]
{more}
/**/bounds_node:
  ros__parameters:
    acceleration_min: [-1.0, -1.0]
"""


@pytest.fixture
def write_robot(tmp_path: Path) -> Callable[..., Path]:
    """Writes a robot's URDF and parameter file; returns the latter's path."""

    def write(
        limit: str = LIMIT,
        type: str = "revolute",
        mass: float = 2.0,
        hand_mass: float = 0.5,
        parameters: str = "",
        text: str = ROBOT,
    ) -> Path:
        urdf = tmp_path / "arm.urdf"
        urdf.write_text(
            URDF.format(limit=limit, type=type, mass=mass, hand_mass=hand_mass, limits=LIMITS)
        )
        path = tmp_path / "robot.yaml"
        path.write_text(text.format(urdf=urdf, more=parameters))
        return path

    return write


def parameters_in(text: str) -> dict[str, Any]:
    """Return the parameters of the bounds node in a file."""
    parameters: dict[str, Any] = yaml.safe_load(text)["/**/bounds_node"]["ros__parameters"]
    return parameters
