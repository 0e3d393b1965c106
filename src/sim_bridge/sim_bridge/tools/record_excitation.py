# SPDX-License-Identifier: Apache-2.0
"""Command line tool: records a motion of the simulated robot for friction identification.

The drives of the robot in a parameter file follow a motion from which the friction of every joint
can be identified, independent of masses; the reported positions, velocities and motor torques are
written as a recording. All joints move at once, in parts of whole periods of cosines,

    q_i(t) = q_start_i + (A_i / 2) (1 - cos(2 pi k_i t / T)),

which begin and end at rest. Each part is symmetric in time: every configuration is passed with a
velocity and its opposite, at the same acceleration. The torques of rigid-body dynamics are then
equal, those of friction opposite.
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
from sim_bridge.node.bullet_parameters import (
    BulletConfiguration,
    make_robot,
)
from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import check_writable, write_whole
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.parameter_files import ParameterFileError, read_files
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration
from viability_bounds_pkg.robot.urdf_joints import units_of

Array = NDArray[np.float64]

PARTS = ((10.0, 0.04, np.inf), (16.0, 0.15, np.inf), (10.0, np.inf, 1.0))
"""Duration T, s; greatest speed, rad/s; and greatest frequency, 1/s."""

ROOM = 0.9
"""Share of the distance to a position limit that is used."""


class ExcitationError(ArmSafetyError, ValueError):
    """The motion does not fit into the limits of the joints."""


def excitation(
    arm: LimitedRobotConfiguration,
    q_start: Array,
    dt: float,
    amplitude: float = 0.6,
    speed: float = 0.5,
    units: Sequence[str] = (),
) -> tuple[Array, Array]:
    """Return positions and velocities, shape (N, n), rad and rad/s, at the period `dt`, s.

    Each joint moves to the side on which it has more room.

    Args:
        arm: its n joints and their limits; position limits may be infinite.
        q_start: positions at start and end, shape (n,), rad.
        dt: period, s.
        amplitude: greatest A, rad.
        speed: greatest share of the velocity limits.
        units: of the joints' positions; rad if not given.

    Raises:
        ExcitationError: a joint starts outside its limits or too near to both.
    """
    q_min, q_max, v_max = arm.position_min, arm.position_max, arm.velocity_max
    room = np.maximum(q_max - q_start, q_start - q_min)
    units = units or ["rad"] * len(arm.joints)
    for joint, unit, q, low, high, most in zip(
        arm.joints, units, q_start, q_min, q_max, room, strict=True
    ):
        if not low <= q <= high:
            raise ExcitationError(f"joint {joint} starts at {q:g}, outside its limits")
        if ROOM * most < 0.05:
            raise ExcitationError(f"joint {joint} has {most:.3g} {unit} of room only")
    side = np.where(q_max - q_start >= q_start - q_min, 1.0, -1.0)
    largest = np.minimum(amplitude, ROOM * room)
    q, v = [], []
    for duration, speed_max, frequency in PARTS:
        peak = np.minimum(speed_max, speed * v_max)
        # A cosine of k periods is as fast as pi k A / T.
        periods = np.clip(np.floor(peak * duration / (np.pi * largest)), 1, duration * frequency)
        reach = side * np.minimum(largest, peak * duration / (np.pi * periods))
        omega = 2.0 * np.pi * periods / duration
        phase = np.outer(dt * np.arange(round(duration / dt)), omega)
        q.append(q_start + 0.5 * reach * (1.0 - np.cos(phase)))
        v.append(0.5 * reach * omega * np.sin(phase))
    return np.vstack(q), np.vstack(v)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="record_excitation",
        description="Move the joints of the simulated robot, slowly and fast, each way, under "
        "position control by its drives, and record it for identify_friction.",
    )
    parser.add_argument("parameters", type=Path, help="the robot's parameter file (ROS 2 YAML)")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="recording to write (.npz)"
    )
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    check_writable(options.output)
    if options.output.resolve() == options.parameters.resolve():
        raise ParameterFileError(f"{options.output} is read, and cannot be written too")
    config = read_files(BulletConfiguration, [options.parameters], "/**/bullet_node")
    units = units_of(config.urdf, config.joints)
    motion = excitation(config, config.start_positions, config.dt, units=units)
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
    monitor = LimitMonitor.of(config)
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
