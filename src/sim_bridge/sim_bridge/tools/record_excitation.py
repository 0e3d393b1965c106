"""Command line tool: a simulated robot's joints move so that their friction can be identified.

The drives of the robot in a parameter file follow the motion of `excitation`; what the robot
reports of it, position, velocity and motor torque, is written as a recording.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.nodes.bullet_parameters import (
    TABLE,
    BulletConfiguration,
    make_configuration,
    make_robot,
)
from sim_bridge.tools.excitation import ExcitationError, excitation
from viability_bounds_pkg.cli.command_line import Parser, positive, run_tool
from viability_bounds_pkg.cli.limits_file import (
    ParameterFileError,
    check_writable,
    node_parameters,
    write_whole,
)
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import read_values


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
    given = node_parameters(options.parameters, "/**/bullet_node")
    values = read_values(TABLE, given)
    config = make_configuration(values)
    motion = excitation(
        config.joints,
        config.q_start,
        config.q_min,
        config.q_max,
        config.v_max,
        config.dt,
        options.amplitude,
        options.speed,
    )
    with closing(make_robot(config, values)) as robot:
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
    robot: BulletRobot, config: BulletConfiguration, q: np.ndarray, v: np.ndarray
) -> tuple[dict[str, np.ndarray], LimitMonitor]:
    """Let the drives follow a motion; return what the robot reported, and the judge of it.

    Args:
        robot: of `config`.
        config: of the robot.
        q: where to be after each control period, shape (N, n), rad.
        v: how fast, shape (N, n), rad/s.
    """
    monitor = LimitMonitor(config.q_min, config.q_max, config.v_max, config.tau_max)
    robot.monitor = monitor
    robot.reset(q[0], np.zeros(q.shape[1]))
    states = []
    # With no terminal to draw on there is no bar.
    for target in tqdm(zip(q, v, strict=True), total=len(q), unit=" periods", disable=None):
        robot.move(*target, config.tau_max, config.v_max, config.substeps)
        states.append(robot.state())
    columns = {"q": "q", "v": "v", "tau": "motor_torque"}
    recorded = {
        key: np.array([getattr(state, name) for state in states]) for key, name in columns.items()
    }
    return {"t": config.dt * np.arange(1, len(q) + 1)} | recorded, monitor


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    errors = (ParameterFileError, SettingError, ExcitationError)
    return run_tool("record_excitation", lambda: _run(options), errors)


if __name__ == "__main__":
    sys.exit(main())
