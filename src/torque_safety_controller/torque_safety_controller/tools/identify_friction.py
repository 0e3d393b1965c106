# SPDX-License-Identifier: Apache-2.0
"""Command line tool that identifies the joint friction of a robot from a recorded motion.

Reads the robot's parameter file and a recording, prints the identified coefficients with standard
errors, and writes a parameter file for the controller.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from torque_safety_controller.friction.identification import JointFit, friction_model, identify
from torque_safety_controller.friction.joint_recording import RecordingError, load_recording
from torque_safety_controller.friction.settings import COEFFICIENTS
from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import (
    Array,
    Robot,
    check_writable,
    overlay,
    read_robot,
    write_whole,
)
from viability_bounds_pkg.parameter_files import ParameterFileError
from viability_bounds_pkg.robot.gravity import gravity_beyond

NODE = "/**/controller_node"
"""Node that the written parameters are for."""

_UNITS = {
    "rad": ("N m", "N m", "N m s/rad", "rad/s"),
    "m": ("N", "N", "N s/m", "m/s"),
}
"""Of the coefficients, by that of the joint's position."""


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="identify_friction",
        description="Identify the friction of a robot's joints from a recording of its motion.",
        epilog="The recording holds arrays t (N,) in s, and q, v, tau (N, n) in rad, rad/s and "
        "N m of the motors, as in joint_states; perhaps joints, their names. Every joint is to "
        "pass the same positions both ways, slowly and fast; record_excitation makes one in "
        "simulation. Coefficients that cannot be identified are left at zero, and reported.",
    )
    add = parser.add_argument
    add("parameters", type=Path, help="the robot's parameter file (ROS 2 YAML)")
    add("recording", type=Path, help="the recording (.npz)")
    add(
        "-o", "--output", type=Path, help="parameter file to write, to be passed after the robot's"
    )
    add(
        "--add-gravity",
        action="store_true",
        help="the recorded torques lack what holds the arm against gravity",
    )
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    if options.output is not None:
        check_writable(options.output)
        for path in (options.parameters, options.recording):
            if options.output.resolve() == path.resolve():
                raise ParameterFileError(f"{options.output} is read, and cannot be written too")
    robot = read_robot(options.parameters)
    model = robot.model
    names = list(model.names)[1:]
    recording = load_recording(options.recording, names)
    _check_positions(options.recording, names, recording.q, robot)
    if options.add_gravity and (gravity := gravity_beyond(model, included=False)):
        tau = recording.tau + [gravity(q) for q in recording.q]
        recording = replace(recording, tau=tau)
    if recording.lost:
        samples = len(recording.t) + recording.lost
        print(f"{recording.lost} of {samples} samples lack numbers, and are left out")
    # With no terminal to draw on there is no bar.
    bar = tqdm(identify(model, recording), total=len(names), unit=" joints", disable=None)
    try:
        fits = list(bar)
    except RecordingError as error:
        raise RecordingError(f"{options.recording}: {error}") from error
    report(names, fits, robot.units)
    if not any(fit.static > 0.0 or fit.viscous > 0.0 for fit in fits):
        raise RecordingError(f"{options.recording} tells nothing about friction: see above")
    text = overlay_text(names, fits, robot.units, options)
    if options.output is None:
        print("\n" + text, end="")
    else:
        write_whole(options.output, text)
        print(f"\nwritten to {options.output}")
    return 0


def _check_positions(path: Path, names: Sequence[str], q: Array, robot: Robot) -> None:
    """Refuse positions that the joints cannot have, shape (N, n), rad."""
    low, high, width = robot.q_min, robot.q_max, robot.q_max - robot.q_min
    limits = low - width, high + width, robot.units
    for name, column, least, most, unit in zip(names, q.T, *limits, strict=True):
        for value in (column.min(), column.max()):
            if not least <= value <= most:
                raise RecordingError(
                    f"{path}: {name} is at {value:.3g} {unit}, beyond its limits by more than its "
                    "range: degrees, or another robot?"
                )


def report(names: Sequence[str], fits: Sequence[JointFit], kinds: Sequence[str]) -> None:
    """Print the identified coefficients with standard errors, and the notes.

    Args:
        names: of the joints.
        fits: of these.
        kinds: units of their positions.
    """
    for name, fit, kind in zip(names, fits, kinds, strict=True):
        units = _UNITS[kind]
        print(
            f"{name}: {fit.blocks} blocks, {fit.speeds[0]:.2g} to {fit.speeds[1]:.2g} {units[3]}, "
            f"residual {fit.residual:.2g} {units[0]}"
        )
        for what, error, unit in zip(COEFFICIENTS, fit.errors, units, strict=True):
            if np.isfinite(error):
                print(f"  {what:18}{getattr(fit, what):10.4g} +- {error:.2g} {unit}")
        for note in fit.notes:
            print(f"  {note}")


def overlay_text(
    names: Sequence[str],
    fits: Sequence[JointFit],
    kinds: Sequence[str],
    options: argparse.Namespace,
) -> str:
    """Return the text of the parameter file; it does not switch the compensation on or off."""
    notes = [
        f"Friction found by identify_friction in {options.recording.name}, to be passed as a "
        f"parameter file after {options.parameters.name}",
        "; of slides ".join(", ".join(dict.fromkeys(_UNITS[k])) for k in _UNITS if k in kinds),
    ]
    notes += [
        f"{name}: {note}" for name, fit in zip(names, fits, strict=True) for note in fit.notes
    ]
    model = friction_model(fits)
    found = {
        f"friction_model_{name}": np.array([float(f"{x:.4g}") for x in getattr(model, name)])
        for name in COEFFICIENTS
    }
    return overlay(names, found, notes, NODE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool("identify_friction", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
