# SPDX-License-Identifier: Apache-2.0
"""Command line tool: acceleration limits of a robot from its torque limits.

Reads a robot's parameter file, searches for the worst states (Algorithm 4 of [DelPrete2018], or
the refined search), reports what it found, and writes a parameter file with the limits.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from decimal import ROUND_DOWN, ROUND_UP
from pathlib import Path

import numpy as np

from viability_bounds_pkg.acceleration_limits import (
    DEFAULT_SAMPLES,
    SEARCHES,
    AccelerationLimits,
    limits_from_worst_cases,
    limits_in_share,
    unavailable_share,
)
from viability_bounds_pkg.cli.command_line import Parser, number, positive, run_tool
from viability_bounds_pkg.cli.limits_file import (
    CONTROLLER,
    Robot,
    check_writable,
    overlay,
    read_robot,
    rounded,
    write_whole,
)
from viability_bounds_pkg.estimate.drift import acceleration_drift, jerk_limits
from viability_bounds_pkg.estimate.worst_case import (
    Array,
    LimitEstimateError,
    StateSpace,
    WorstCases,
)
from viability_bounds_pkg.parameter_files import ParameterFileError
from viability_bounds_pkg.robot.urdf_joints import list_units


def _count(text: str) -> int:
    value = number(text)
    if not 1.0 <= value < np.inf:
        raise argparse.ArgumentTypeError(f"must be at least 1, is {text}")
    return int(value)


def _fraction(text: str) -> float:
    value = number(text)
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 0 and less than 1, is {text}")
    return value


def _rates(text: str) -> list[float]:
    return [positive(each) for each in text.split(",")]


def _override(text: str) -> tuple[str, tuple[float, float]]:
    joint, _, values = text.partition("=")
    low, _, high = values.partition(",")
    try:
        return joint, (float(low), float(high))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must read JOINT=MIN,MAX, is {text!r}") from error


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="estimate_acceleration_limits",
        description="Estimate the joint accelerations that the torque limits always allow.",
        epilog="The limits found are the worst of the states searched, never surely the worst of "
        "all; the refined method comes much closer than sampling.",
    )
    add = parser.add_argument
    add("parameters", type=Path, help="the robot's parameter file (ROS 2 YAML)")
    add(
        "-o", "--output", type=Path, help="parameter file to write, to be passed after the robot's"
    )
    add("--method", choices=tuple(SEARCHES), default="refined", help="default: %(default)s")
    add(
        "--samples",
        type=_count,
        metavar="N",
        help="evaluations of the dynamics (default: "
        + ", ".join(f"{n} for {method}" for method, n in DEFAULT_SAMPLES.items())
        + ")",
    )
    add("--seed", type=int, default=0, help="of the random generator (default: %(default)s)")
    add(
        "--torque-reserve",
        type=_fraction,
        default=0.0,
        metavar="FRACTION",
        help="part of the torque limits to keep back, as for an integral term",
    )
    add(
        "--override",
        type=_override,
        action="append",
        default=[],
        metavar="JOINT=MIN,MAX",
        help="limits of a joint to use instead of what is found, rad/s^2; repeatable",
    )
    add(
        "--share",
        type=_fraction,
        default=0.0,
        metavar="FRACTION",
        help="for joints with no limits in all states, those that torque allows in this share of "
        "random states; only with the controller's safety_filter",
    )
    add(
        "--cap",
        type=positive,
        default=np.inf,
        metavar="VALUE",
        help="greatest limit of all joints, rad/s^2 or m/s^2",
    )
    add(
        "--drift",
        action="store_true",
        help="also find how fast accelerations drift while a torque is held",
    )
    add(
        "--torque-rate",
        type=_rates,
        default=[],
        metavar="RATES",
        help="largest rates of the torques, N m/s, one number for all joints or one for each, "
        "separated by commas; also find the jerk that they allow",
    )
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error(f"argument --seed: must be at least 0, is {options.seed}")
    if options.samples is None:
        options.samples = DEFAULT_SAMPLES[options.method]
    return options


def _in_share(
    robot: Robot, space: StateSpace, worst: WorstCases, share: float
) -> dict[str, tuple[float, float]]:
    """Return limits of the joints that have none in all states, by name, rad/s^2."""
    usual = limits_in_share(robot.model, space, share).tolist()
    found = (worst.a_min < 0.0) & (worst.a_max > 0.0)
    joints = zip(list(robot.model.names)[1:], found.tolist(), usual, strict=True)
    return {name: (-each, each) for name, any_state, each in joints if not any_state and each > 0}


def _run(options: argparse.Namespace) -> int:
    if options.output is not None:
        check_writable(options.output)
        if options.output.resolve() == options.parameters.resolve():
            raise ParameterFileError(
                f"{options.output} is the robot's parameter file; the limits go to another one, "
                "which is passed after it"
            )
    robot = read_robot(options.parameters)
    names = list(robot.model.names)[1:]
    if len(options.torque_rate) not in (0, 1, len(names)):
        raise LimitEstimateError(f"--torque-rate must be one number, or {len(names)}")
    overrides = dict(options.override)
    torque = (1.0 - options.torque_reserve) * robot.tau_max
    space = StateSpace.of(robot.model, robot.q_min, robot.q_max, robot.v_max, torque)
    search = SEARCHES[options.method]
    worst = search(robot.model, space, options.samples, options.seed, _show)
    _show(1.0)
    _report_search(names, robot.units, worst)
    if options.share > 0.0:
        overrides = _in_share(robot, space, worst, options.share) | overrides
    limits = limits_from_worst_cases(robot.model, space, worst, overrides, options.cap)
    _report_limits(limits, robot.units, unavailable_share(robot.model, space, limits))
    drift = None
    if options.drift:
        print("searching for the worst drift of a held torque ...", flush=True)
        drift = acceleration_drift(
            robot.model, space, limits.a_min, limits.a_max, seed=options.seed
        )
    jerk = None
    if options.torque_rate:
        print("searching for the least jerk that the torque rates allow ...", flush=True)
        jerk = jerk_limits(
            robot.model,
            space,
            limits.a_min,
            limits.a_max,
            np.broadcast_to(options.torque_rate, len(names)),
            seed=options.seed,
        )
    origin = [
        "Limits written by estimate_acceleration_limits, to be passed as a parameter file after "
        f"{options.parameters.name}",
        f"method {options.method}, {worst.evaluations} evaluations, seed {options.seed}, "
        f"torque reserve {options.torque_reserve:g}",
        f"{list_units(robot.units, '/s^2')}, drift in {list_units(robot.units, '/s^3')}",
    ]
    text = overlay_text(limits, drift, origin, jerk)
    if options.output is None:
        print("\n" + text, end="")
        return 0
    try:
        write_whole(options.output, text)
    except OSError:
        # The search may have taken long: what it found must not be lost.
        print("\n" + text, end="", flush=True)
        raise
    print(f"\nwritten to {options.output}")
    return 0


def _show(share: float) -> None:
    """Show on a terminal how much of the search is done, and nothing when all is."""
    if sys.stderr.isatty():
        bar = f"searching [{'#' * int(30 * share):30}] {share:.0%}" if share < 1.0 else ""
        print(f"\r\033[K{bar}", end="", file=sys.stderr, flush=True)


def _report_search(names: Sequence[str], units: Sequence[str], worst: WorstCases) -> None:
    """Print the worst states of each joint."""
    for j, (name, unit) in enumerate(zip(names, units, strict=True)):
        print(f"{name}: torque leaves [{worst.a_min[j]:.4g}, {worst.a_max[j]:.4g}] {unit}/s^2")
        for side, limit in ((1, "a_min"), (0, "a_max")):
            q, v = worst.q[side, j], worst.v[side, j]
            print(f"  worst {limit} at q = {_vector(q)}, v = {_vector(v)}")
    print(f"{worst.evaluations} evaluations of the dynamics\n")


def _report_limits(limits: AccelerationLimits, units: Sequence[str], unavailable: Array) -> None:
    """Print the limits to use, and where each comes from.

    Args:
        limits: what to use.
        units: of the joints' positions.
        unavailable: share of states in which torque does not allow them, shape (n,).
    """
    found = limits.worst
    for j, (name, unit) in enumerate(zip(limits.names, units, strict=True)):
        low, high = limits.a_min[j], limits.a_max[j]
        if name in limits.overridden:
            origin = "override"
            if found.a_min[j] > low or found.a_max[j] < high:
                origin += f", NOT available in {100.0 * unavailable[j]:.2g} % of random states"
        else:
            origin = "found" if (low, high) == (found.a_min[j], found.a_max[j]) else "capped"
        print(f"{name}: a in [{low:.4g}, {high:.4g}] {unit}/s^2 ({origin})")


def _vector(values: Array) -> str:
    return "[" + ", ".join(f"{value:.3f}" for value in values) + "]"


def overlay_text(
    limits: AccelerationLimits,
    drift: Array | None,
    origin: Sequence[str],
    jerk: Array | None = None,
) -> str:
    """Return the parameter file with the limits, rounded to the safe side.

    Args:
        limits: what to write.
        drift: ``acceleration_drift``, shape (n,), rad/s^3, if it was searched.
        origin: lines of comment that say where the limits come from, and their units.
        jerk: ``jerk_max``, shape (n,), rad/s^3, if it was searched.
    """
    notes = [*origin]
    if limits.overridden:
        notes.append(f"set by hand: {', '.join(sorted(limits.overridden))}")
    found = {
        "acceleration_min": rounded(limits.a_min, ROUND_DOWN),
        "acceleration_max": rounded(limits.a_max, ROUND_DOWN),
    }
    more = {} if drift is None else {"acceleration_drift": rounded(drift, ROUND_UP)}
    if jerk is not None:
        more["jerk_max"] = rounded(jerk, ROUND_DOWN)
    # Not for all nodes at once: a file that names the node would win over that.
    joints = limits.names
    return overlay(joints, found | more, notes) + "\n" + overlay(joints, found, [], CONTROLLER)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool("estimate_acceleration_limits", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
