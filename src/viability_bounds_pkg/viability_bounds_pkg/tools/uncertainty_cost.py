# SPDX-License-Identifier: Apache-2.0
"""Command line tool: what the declared uncertainty of a robot costs.

Reads the robot's parameter files as the nodes do, and prints for each joint horizon and margins
of the bounds, and the speed and range that they cost; and what each declaration costs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import NODE
from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter_files import read_files
from viability_bounds_pkg.uncertainty import DeclaredUncertainty, Loop

NAME = "uncertainty_cost"

Array = NDArray[np.float64]


class Reach(NamedTuple):
    """What the bounds leave to n joints whose states are reported without errors.

    Attributes:
        braking: deceleration that the bounds count on, towards the upper and the lower limit,
            shape (n, 2), rad/s^2.
        speed: highest speed that is kept, shape (n,), rad/s.
        rest: distance at which joints come to rest before the upper and the lower limit, shape
            (n, 2), rad; 0 without a limit.
    """

    braking: Array
    speed: Array
    rest: Array


def reach_of(loop: Loop, declared: DeclaredUncertainty) -> Reach:
    """Return what the bounds leave to n joints.

    Raises:
        JointLimitsError: there are no bounds.
    """
    margins, solver = loop.margins(declared), loop.bounds(declared)
    w = loop.torque_margins.acceleration + declared.acceleration_disturbance
    # Speed that the errors may make of rest, or of the speed kept, by the end of a step.
    gained = margins.velocity_error + solver.steps * w
    rest = (gained**2)[:, None] / (2.0 * solver.braking)
    away = margins.position_error + 0.5 * solver.steps * (margins.velocity_error + gained)
    rest += (away + loop.torque_margins.position)[:, None]
    rest[~np.isfinite(solver.table["position"])] = 0.0
    return Reach(solver.braking, solver.limits.v_max - gained, rest)


def _print_joints(config: BoundsConfiguration, ideal: Reach, reach: Reach) -> None:
    source = "as reported"
    if config.use_estimated_states:
        source = "estimated" if config.velocity_estimation else "predicted"
    margins = config.uncertainty
    print(
        f"{len(config.joints)} joints at {config.rate_hz:g} Hz, states {source}; the bounds look "
        f"{1e3 * margins.horizon:.3g} ms ahead, {1e3 * config.bounds_dt_factor * config.dt:.3g} "
        "ms without what is declared"
    )
    width = max(map(len, config.joints))
    print(f"\n{'':{width}}      E_q      E_v  braking    speed kept    rest before     range")
    print(f"{'':{width}}     mrad    rad/s  rad/s^2         rad/s    limits, mrad   lost, %")
    lost = (reach.rest - ideal.rest).sum(axis=1) / (config.limits.q_max - config.limits.q_min)
    for j, name in enumerate(config.joints):
        print(
            f"{name:{width}} {1e3 * margins.position_error[j]:8.3g} "
            f"{margins.velocity_error[j]:8.3g} {reach.braking[j].min():8.3g} "
            f"{ideal.speed[j]:6.3f} {reach.speed[j]:6.3f} "
            f"{1e3 * ideal.rest[j].max():7.3g} {1e3 * reach.rest[j].max():7.3g} "
            f"{100.0 * lost[j]:9.3g}"
        )
    print("two numbers: without what is declared, and with it")


def _print_declarations(config: BoundsConfiguration, reach: Reach) -> None:
    names = config.declared.names
    if not names:
        print("\nnothing is declared")
        return
    print("\nwhat each declaration costs while the others stay, at the joint that loses most:")
    for name in names:
        less = reach_of(config.loop, config.declared.without(name))
        speed, rest = less.speed - reach.speed, (reach.rest - less.rest).sum(axis=1)
        # Nothing of the range of a continuous joint.
        weight = speed / config.limits.v_max + rest / (config.limits.q_max - config.limits.q_min)
        j = int(np.argmax(weight))
        print(
            f"{name:{max(map(len, names))}}  {speed[j]:6.3f} rad/s, {1e3 * rest[j]:.3g} mrad of "
            f"the range ({config.joints[j]})"
        )


def _run(options: argparse.Namespace) -> int:
    config = read_files(BoundsConfiguration, options.params_file, NODE)
    loop, declared = config.loop, config.declared
    try:
        reach = reach_of(loop, declared)
    except JointLimitsError as error:
        raise loop.refusal(declared, error) from error
    _print_joints(config, reach_of(loop, declared.without(*declared.names)), reach)
    _print_declarations(config, reach)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    parser = Parser(
        prog=NAME,
        description="Print what the declared uncertainty of a robot costs: speed and range.",
        epilog="E_q and E_v are the largest errors of position and velocity for which the bounds "
        "hold, at the instant when a command begins to act; docs/uncertainty.md derives them.",
    )
    parser.add_parameter_files()
    options = parser.parse_args(arguments)
    return run_tool(NAME, lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
