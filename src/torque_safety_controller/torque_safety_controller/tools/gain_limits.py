# SPDX-License-Identifier: Apache-2.0
"""Command line tool that prints gains beside the largest that a robot allows.

Reads a robot's parameter files: delay, bandwidth of the motors and resolution of the encoders, as
declared for bounds_node, and the gains of controller_node.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torque_safety_controller.loop_margins.gain_check import (
    LIMIT_MARGIN,
    MARGIN,
    TORQUE_STEP,
    GainCheck,
)
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import CONTROLLER, NODE
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter_files import read_files


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="gain_limits",
        description="Print a robot's gains beside the largest that its delay, its motors and the "
        "resolution of its encoders permit.",
        epilog=f"The loop of a joint keeps a modulus margin of {MARGIN:g}, that of a joint at its "
        f"limit {LIMIT_MARGIN:g}; at rest a step of the encoders changes no torque by more than "
        f"{TORQUE_STEP:.0%} of torque_max a period. docs/gains.md derives both. Exit code 1: a "
        "gain is beyond its limit.",
    )
    parser.add_parameter_files()
    return parser.parse_args(arguments)


def gain_check(files: Sequence[Path]) -> GainCheck:
    """Return the check of the gains in a robot's parameter files."""
    config = read_files(ControllerConfiguration, files, CONTROLLER)
    return GainCheck(config, read_files(BoundsConfiguration, files, NODE))


def _run(options: argparse.Namespace) -> int:
    limits = list(gain_check(options.params_file).limits())
    print(f"{'':18}{'given':>10}{'by margin':>14}{'by resolution':>16}")
    for limit in limits:
        sign = ">=" if limit.smallest else "<="
        margin, resolution = (
            f"{sign} {value:.4g}" if np.isfinite(value) and value > 0.0 else "-"
            for value in (limit.by_margin, limit.by_resolution)
        )
        verdict = "  exceeded" if limit.exceeded else ""
        print(f"{limit.name:18}{limit.value:10.4g}{margin:>14}{resolution:>16}{verdict}")
    return int(any(limit.exceeded for limit in limits))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 if a gain is beyond its limit, or for an error."""
    options = _parse(arguments)
    return run_tool("gain_limits", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
