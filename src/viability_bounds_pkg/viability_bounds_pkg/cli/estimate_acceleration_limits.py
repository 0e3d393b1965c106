# SPDX-License-Identifier: Apache-2.0
"""Command line tool: acceleration limits of a robot from its torque limits.

Reads a robot's parameter file, searches for the worst states (Algorithm 4 of [DelPrete2018], or
the refined search), reports what it found, and writes a parameter file with the limits.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from viability_bounds_pkg.acceleration_limits import (
    DEFAULT_SAMPLES,
    SEARCHES,
    AccelerationLimits,
    EmptyIntervalError,
    available_torque,
    check_adjustments,
    limits_from_worst_cases,
    limits_in_share,
    unavailable_share,
)
from viability_bounds_pkg.cli.command_line import INTERRUPTED, Parser, number, positive, run_tool
from viability_bounds_pkg.cli.limits_file import (
    Robot,
    check_writable,
    read_robot,
    write_whole,
)
from viability_bounds_pkg.cli.report import overlay_text, report_limits, report_search
from viability_bounds_pkg.estimation.discretisation_margin import (
    ZeroOrderHoldError,
    discretisation_margin,
)
from viability_bounds_pkg.estimation.state_space import Array, LimitEstimateError, StateSpace
from viability_bounds_pkg.estimation.worst_case_search import WorstCases
from viability_bounds_pkg.user_input.parameter_files import ParameterFileError


def _count(text: str) -> int:
    value = int(number(text))
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, is {value}")
    return value


def _fraction(text: str) -> float:
    value = number(text)
    if not 0 <= value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 0 and less than 1, is {text}")
    return value


def _override(text: str) -> tuple[str, tuple[float, float]]:
    joint, _, values = text.partition("=")
    low, _, high = values.partition(",")
    try:
        return joint, (float(low), float(high))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must read JOINT=MIN,MAX, is {text!r}") from error


def _cap(text: str) -> tuple[str, float]:
    joint, _, value = text.rpartition("=")
    return joint, positive(value)


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
        type=_cap,
        action="append",
        default=[],
        metavar="[JOINT=]VALUE",
        help="greatest limit of all joints, or of one, rad/s^2; repeatable",
    )
    add(
        "--margin-dt",
        type=positive,
        metavar="DT",
        help="also find how fast accelerations drift while a torque is held for DT seconds",
    )
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error(f"argument --seed: must be at least 0, is {options.seed}")
    if options.samples is None:
        options.samples = DEFAULT_SAMPLES[options.method]
    return options


def _caps(options: argparse.Namespace, names: Sequence[str]) -> Array:
    """Return the cap of each joint, shape (n,), rad/s^2; one for the joint beats one for all."""
    caps = np.full(len(names), dict(options.cap).get("", np.inf))
    for joint, value in options.cap:
        if joint and joint not in names:
            raise LimitEstimateError(
                f"cap of unknown joint {joint!r}; there are: {', '.join(names)}"
            )
        if joint:
            caps[names.index(joint)] = value
    return caps


def _search(
    robot: Robot, space: StateSpace, options: argparse.Namespace
) -> tuple[WorstCases | None, bool]:
    """Return what the search found, None if nothing, and whether it was interrupted."""
    worst = None
    try:
        # With no terminal to draw on there is no bar.
        with tqdm(total=options.samples, unit=" evaluations", disable=None) as bar:
            search = SEARCHES[options.method]
            for worst in search(robot.model, space, options.samples, options.seed):
                bar.update(worst.evaluations - bar.n)
    except KeyboardInterrupt:
        return worst, True
    return worst, False


def _in_share(
    robot: Robot, space: StateSpace, worst: WorstCases, share: float
) -> dict[str, tuple[float, float]]:
    """Return limits of the joints that have none in all states, by name, rad/s^2."""
    usual = limits_in_share(robot.model, space, share).tolist()
    found = (worst.a_min < 0.0) & (worst.a_max > 0.0)
    joints = zip(list(robot.model.names)[1:], found.tolist(), usual, strict=True)
    return {name: (-each, each) for name, any_state, each in joints if not any_state and each > 0}


def _margin(
    robot: Robot, space: StateSpace, limits: AccelerationLimits, options: argparse.Namespace
) -> tuple[ZeroOrderHoldError | None, bool]:
    """Return the margin, None if interrupted, and whether it was interrupted."""
    try:
        print("searching for the worst drift of a held torque ...", flush=True)
        margin = discretisation_margin(
            robot.model,
            robot.q_min,
            robot.q_max,
            robot.v_max,
            limits.a_min,
            limits.a_max,
            space.tau_max,
            options.margin_dt,
            seed=options.seed,
        )
    except KeyboardInterrupt:
        print("interrupted: acceleration_drift is left out", file=sys.stderr)
        return None, True
    return margin, False


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
    caps, overrides = _caps(options, names), dict(options.override)
    check_adjustments(robot.model, overrides, caps)
    torque = available_torque(robot.tau_max, options.torque_reserve * robot.tau_max)
    space = StateSpace.of(robot.model, robot.q_min, robot.q_max, robot.v_max, torque)
    worst, interrupted = _search(robot, space, options)
    if worst is None:
        raise KeyboardInterrupt
    report_search(names, worst)
    if options.share > 0.0:
        overrides = _in_share(robot, space, worst, options.share) | overrides
    if interrupted:
        print(
            f"interrupted after {worst.evaluations} of {options.samples} evaluations: the limits "
            "are those found so far, too large rather than too small",
            file=sys.stderr,
        )
    try:
        limits = limits_from_worst_cases(robot.model, space, worst, overrides, caps)
    except EmptyIntervalError as error:
        if not interrupted:
            raise
        print(error, file=sys.stderr)
        return INTERRUPTED
    margin = None
    if options.margin_dt is not None and not interrupted:
        margin, interrupted = _margin(robot, space, limits, options)
    report_limits(limits, unavailable_share(robot.model, space, limits), margin)
    text = overlay_text(limits, margin, _origin(options, worst, interrupted))
    if options.output is None:
        print("\n" + text, end="")
    else:
        try:
            write_whole(options.output, text)
        except OSError:
            # The search may have taken long: what it found must not be lost.
            print("\n" + text, end="", flush=True)
            raise
        print(f"\nwritten to {options.output}")
    return INTERRUPTED if interrupted else 0


def _origin(options: argparse.Namespace, worst: WorstCases, interrupted: bool) -> list[str]:
    """Return the lines that say where the limits come from."""
    lines = [
        "Limits written by estimate_acceleration_limits, to be passed as a parameter file after "
        f"{options.parameters.name}",
        f"method {options.method}, {worst.evaluations} evaluations, seed {options.seed}, "
        f"torque reserve {options.torque_reserve:g}",
    ]
    if interrupted:
        lines.append("INTERRUPTED: not all that was asked for was searched")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool("estimate_acceleration_limits", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
