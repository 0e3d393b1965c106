# SPDX-License-Identifier: Apache-2.0
"""Command line tool: records a motion of the simulated robot for friction identification.

The drives of the robot in a parameter file follow the motion of `excitation`; the reported
positions, velocities and motor torques are written as a recording.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.nodes.bullet_parameters import (
    BulletConfiguration,
    make_robot,
)
from sim_bridge.tools.excitation import ExcitationError, excitation
from viability_bounds_pkg.cli.command_line import Parser, positive, run_tool
from viability_bounds_pkg.cli.limits_file import check_writable, write_whole
from viability_bounds_pkg.parameter_files import ParameterFileError, read_files

Array = NDArray[np.float64]


def _share(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"must be above 0 and at most 1, is {text}")
    return value


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="record_excitation",
        description="Move the joints of the simulated robot, slowly and fast, each way, under "
        "position control by its drives, and record it for identify_friction.",
    )
    add = parser.add_argument
    add("parameters", type=Path, help="the robot's parameter file (ROS 2 YAML)")
    add("-o", "--output", type=Path, required=True, help="recording to write (.npz)")
    add(
        "--amplitude",
        type=positive,
        default=0.6,
        metavar="RAD",
        help="how far a joint moves at most (default: %(default)s)",
    )
    add(
        "--speed",
        type=_share,
        default=0.5,
        metavar="SHARE",
        help="how fast, in velocity limits, at most (default: %(default)s)",
    )
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    check_writable(options.output)
    if options.output.resolve() == options.parameters.resolve():
        raise ParameterFileError(f"{options.output} is read, and cannot be written too")
    config = read_files(BulletConfiguration, [options.parameters], "/**/bullet_node")
    motion = excitation(
        config, config.start_positions, config.dt, options.amplitude, options.speed
    )
    with closing(make_robot(config)) as robot:
        recorded, monitor = record(robot, config, *motion)
    broken = np.flatnonzero(
        (monitor.max_position_violation > 0.0) | (monitor.max_velocity_violation > 0.0)
    )
    if broken.size:
        names = ", ".join(config.joints[j] for j in broken)
        raise ExcitationError(
            f"limits were broken by {names}: move less far or less fast; nothing written"
        )
    file = io.BytesIO()
    np.savez_compressed(file, joints=np.array(config.joints), **recorded)
    write_whole(options.output, file.getvalue())
    print(
        f"{recorded['t'][-1]:.0f} s of motion written to {options.output}; torque at most "
        f"{monitor.max_torque_ratio.max():.2f} of its limits"
    )
    return 0


def record(
    robot: BulletRobot, config: BulletConfiguration, q: Array, v: Array
) -> tuple[dict[str, Any], LimitMonitor]:
    """Let the drives follow a motion; return the recording and its limit monitor.

    Args:
        robot: of `config`.
        config: of the robot.
        q: positions after each control period, shape (N, n), rad.
        v: velocities there, shape (N, n), rad/s.
    """
    monitor = LimitMonitor(
        config.position_min, config.position_max, config.velocity_max, config.torque_max
    )
    robot.monitor = monitor
    robot.reset(q[0], np.zeros(q.shape[1]))
    states = []
    # With no terminal to draw on there is no bar.
    for q_des, v_des in tqdm(zip(q, v, strict=True), total=len(q), unit=" periods", disable=None):
        robot.move(q_des, v_des, config.torque_max, config.velocity_max, config.substeps)
        states.append(robot.state())
    recorded = {
        "t": config.dt * np.arange(1, len(q) + 1),
        "q": np.array([state.q for state in states]),
        "v": np.array([state.v for state in states]),
        "tau": np.array([state.motor_torque for state in states]),
    }
    return recorded, monitor


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool("record_excitation", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
