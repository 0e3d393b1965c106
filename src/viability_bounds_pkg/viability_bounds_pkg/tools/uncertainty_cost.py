# SPDX-License-Identifier: Apache-2.0
"""Command line tool: what the declared uncertainty of a robot costs.

Reads the robot's parameter files as the nodes do, and prints for each joint horizon and margins
of the bounds, and the speed, range and time that they cost; and what each declaration costs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import NODE
from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.uncertainty.cost import Reach, Share, reach_of, shares_of
from viability_bounds_pkg.uncertainty.feasible import none_of, refusal
from viability_bounds_pkg.uncertainty.margins import UncertaintyMargins
from viability_bounds_pkg.user_input.parameter_files import read_files

NAME = "uncertainty_cost"


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog=NAME,
        description="Print what the declared uncertainty of a robot costs: speed, range, time.",
        epilog="E_q and E_v are the largest errors of position and velocity for which the bounds "
        "hold, at the instant when a command begins to act; docs/uncertainty.md derives them.",
    )
    parser.add_parameter_files()
    return parser.parse_args(arguments)


def _print_joints(
    config: BoundsConfiguration, margins: UncertaintyMargins, ideal: Reach, reach: Reach
) -> None:
    source = "as reported"
    if config.use_estimated_states:
        source = "estimated" if config.velocity_estimation else "predicted"
    print(
        f"{len(config.joints)} joints at {config.rate_hz:g} Hz, states {source}; the bounds look "
        f"{1e3 * margins.horizon:.3g} ms ahead, {1e3 * config.bounds_dt_factor * config.dt:.3g} "
        "ms without what is declared"
    )
    width = max(map(len, config.joints))
    print(
        f"\n{'':{width}}      E_q      E_v  braking    speed kept    rest before     range   move "
        "across half"
    )
    print(
        f"{'':{width}}     mrad    rad/s  rad/s^2         rad/s    limits, mrad   lost, %   "
        "the range, s"
    )
    lost = (reach.rest - ideal.rest).sum(axis=1) / (config.limits.q_max - config.limits.q_min)
    for j, name in enumerate(config.joints):
        print(
            f"{name:{width}} {1e3 * margins.position_error[j]:8.3g} "
            f"{margins.velocity_error[j]:8.3g} {reach.braking[j].min():8.3g} "
            f"{ideal.speed[j]:6.3f} {reach.speed[j]:6.3f} "
            f"{1e3 * ideal.rest[j].max():7.3g} {1e3 * reach.rest[j].max():7.3g} "
            f"{100.0 * lost[j]:9.3g} {ideal.move_time[j]:8.3f} {reach.move_time[j]:6.3f}"
        )
    print("two numbers: without what is declared, and with it")


def _print_shares(joints: Sequence[str], shares: Sequence[Share]) -> None:
    if not shares:
        print("\nnothing is declared")
        return
    print("\nwhat each declaration costs while the others stay, at the joint that loses most:")
    width = max(len(share.name) for share in shares)
    for share in shares:
        print(
            f"{share.name:{width}}  {share.speed:6.3f} rad/s, {1e3 * share.rest:.3g} mrad of the "
            f"range, {1e3 * share.move_time:.3g} ms of the move ({joints[share.joint]})"
        )
    print(f"most: {shares[0].name}")


def _run(options: argparse.Namespace) -> int:
    config = read_files(BoundsConfiguration, options.params_file, NODE)
    loop, declared = config.loop, config.declared
    try:
        reach = reach_of(loop, declared)
    except JointLimitsError as error:
        raise refusal(loop, declared, error) from error
    ideal = reach_of(loop, none_of(declared))
    _print_joints(config, loop.margins(declared), ideal, reach)
    _print_shares(config.joints, shares_of(loop, declared))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool(NAME, lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
