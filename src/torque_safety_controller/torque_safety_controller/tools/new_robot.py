# SPDX-License-Identifier: Apache-2.0
"""Command line tool that makes the parameter files of an arm from its URDF.

Finds joints, limits, a start posture, and gains; estimates acceleration limits, drift and margins;
writes the robot's file, one of an imperfect robot, and a scenario that drives it into its limits.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from torque_safety_controller.new_robot.capsules import capsule_entries
from torque_safety_controller.new_robot.chain import Chain, NewRobotError, find_chain
from torque_safety_controller.new_robot.estimates import Estimates, estimate
from torque_safety_controller.new_robot.files import parameter_file, scenario_file
from torque_safety_controller.new_robot.hardware import (
    ERRORS,
    QUICKEST,
    ROOM,
    Array,
    Errors,
    acceleration_errors,
    imperfect_file,
    with_rotors,
)
from torque_safety_controller.new_robot.postures import SelfCollisions, find_postures
from torque_safety_controller.new_robot.urdf import (
    shapes,
    through_xacro,
    with_tool,
    without_comments,
)
from torque_safety_controller.tools.fit_capsules import with_capsules
from torque_safety_controller.tools.gain_limits import HORIZON, OBSERVER
from torque_safety_controller.tools.suitable_gains import (
    GAINS,
    IMPERFECT_GAINS,
    OBSERVER_MAX,
    OBSERVER_PERIODS,
    Gains,
    suitable_gains,
)
from viability_bounds_pkg.cli.command_line import Parser, number, positive, run_tool, stage
from viability_bounds_pkg.cli.limits_file import check_writable, write_whole
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.robot.files import parsed_urdf, resolve_uri, urdf_text


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="new_robot",
        description="Make the parameter files of an arm from its URDF.",
        epilog="scripts/new_robot.sh runs it, and then the arm. docs/start/your_robot.md tells "
        "what is found and how. NAME:=VALUE is an argument of a xacro file.",
    )
    add = parser.add_argument
    add("urdf", nargs="?", help="URDF or xacro file, or package:// URI")
    add("tip", help="link at the end of the arm, of two arms both: LEFT,RIGHT")
    add("--topic", action="store_true", help="take the URDF from the topic robot_description")
    add("--base", default="", metavar="LINK", help="lock the joints before this link")
    add("--name", default="", help="of the files (default: that in the URDF)")
    add("--rate", type=positive, metavar="HZ", help="control rate (default: chosen)")
    add(
        "--velocity-max",
        type=positive,
        metavar="RAD_S",
        help="largest speed limit of a joint, rad/s or m/s (default: the URDF's)",
    )
    add(
        "--tool",
        type=_tool,
        metavar="KG,X,Y,Z",
        help="mass and centre, m in the axes of the tip, of a tool that the URDF does not have",
    )
    add("--out", type=Path, default=Path("config"), help="folder to write to (default: config)")
    add("--ideal", action="store_true", help="write no file of an imperfect robot")
    add("--force", action="store_true", help="replace files of this name")
    words = sys.argv[1:] if arguments is None else arguments
    mappings = [word for word in words if re.match(r"\w+:=", word)]
    options = parser.parse_args([word for word in words if word not in mappings])
    options.mappings = dict(word.split(":=", 1) for word in mappings)
    if options.topic == (options.urdf is not None):
        parser.error("either a URDF or --topic must be given, and a tip")
    if options.name and not options.name.isidentifier():
        parser.error(f"argument --name: must be letters, digits and _, is '{options.name}'")
    if options.rate is not None and options.rate > 1e4:
        parser.error(f"argument --rate: must be at most 10000, is {options.rate:g}")
    return options


def _tool(text: str) -> tuple[float, str]:
    """Return mass, kg, and centre of an argument KG,X,Y,Z."""
    mass, *centre = text.split(",")
    if len(centre) != 3:
        raise argparse.ArgumentTypeError(f"must be KG,X,Y,Z, is '{text}'")
    return positive(mass), " ".join(f"{number(each):g}" for each in centre)


def _read(options: argparse.Namespace) -> tuple[str, str, Path | None]:
    """Return the text of the URDF, its source, empty if it must be kept, and its folder."""
    if options.topic:
        urdf, source, folder = _from_topic(), "", None
    else:
        path = resolve_uri(options.urdf).resolve()
        urdf, folder = urdf_text(path, str(path)), path.parent
        if path.suffix == ".xacro" or "<xacro:" in without_comments(urdf):
            urdf, source = through_xacro(path, options.mappings), ""
        else:
            source = options.urdf if "://" in options.urdf else str(path)
    if options.mappings and (source or folder is None):
        names = ", ".join(options.mappings)
        raise NewRobotError(f"{names}: only a xacro file takes arguments")
    parsed_urdf(urdf, source or options.urdf or "robot_description")
    return urdf, source, folder


def _from_topic() -> str:
    import rclpy

    from viability_bounds_pkg.ros.robot_urdf import urdf_from_topic

    rclpy.init(args=[])
    try:
        node = rclpy.create_node("new_robot")
        return urdf_from_topic(node)
    finally:
        rclpy.try_shutdown()


def _run(options: argparse.Namespace) -> int:
    urdf, source, folder = _read(options)
    if options.tool:
        urdf, source = with_tool(urdf, options.tip.split(",")[0], *options.tool), ""
    fastest = options.velocity_max or math.inf
    chain = find_chain(urdf, options.tip.split(","), options.base, fastest)
    chain = replace(chain, name=options.name or chain.name)
    out: Path = options.out
    files = {
        "robot": out / f"{chain.name}.yaml",
        "scenario": out / "scenarios" / f"{chain.name}_demo.yaml",
    }
    if not options.ideal:
        files["imperfect"] = out / "imperfect" / f"{chain.name}.yaml"
    if not source:
        files["urdf"] = out / f"{chain.name}.urdf"
        source = str(files["urdf"].resolve())
    for path in files.values():
        if path.exists() and not options.force:
            raise NewRobotError(f"{path} exists; --force replaces it, --name gives another name")
        there = next(folder for folder in path.resolve().parents if folder.exists())
        check_writable(there / path.name)
    _tell_chain(chain)
    with stage("estimating acceleration limits"):
        estimates = estimate(chain, options.rate)
    _tell_estimates(chain, estimates)
    with stage("looking for postures"):
        geometry, trouble = shapes(urdf, folder, chain.model)
        touches = SelfCollisions(chain, geometry)
        postures = find_postures(chain, touches)
    checked = f"{touches.pairs} pairs of shapes checked"
    if trouble:
        checked = f"not checked for collisions ({trouble})"
        print(f"collisions of the arm with itself are not checked: {trouble}")
    bounded = ~chain.continuous
    print(
        f"scenario: {len(postures.goals)} goals, with {int(postures.reached[bounded].sum())} of "
        f"the {2 * int(bounded.sum())} position limits, and back"
    )

    def robot_text(gains: Gains, source: str) -> str:
        return parameter_file(
            chain, estimates, postures, checked=checked, source=source, base=options.base,
            gains=gains,
        )  # fmt: skip

    observer = min(OBSERVER_PERIODS / estimates.rate_hz, OBSERVER_MAX)
    with stage("checking gains"):
        gains = suitable_gains(urdf, lambda *of: [robot_text(*of)], GAINS | {OBSERVER: observer})
    text = robot_text(gains, source)
    with stage("fitting capsules"):
        if capsules := capsule_entries(chain.model, geometry):
            text = with_capsules(text, capsules)
    texts = {
        "robot": text,
        "scenario": scenario_file(chain, estimates, postures),
        "urdf": urdf,
    }
    if not options.ideal:
        with stage("making an imperfect robot"):
            try:
                texts["imperfect"] = _imperfect_text(chain, estimates, gains, urdf, robot_text)
            except NewRobotError as error:
                print(error)
                del files["imperfect"]
    for name, path in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, texts[name])
    for name, path in files.items():
        print(f"written: {path} ({name})")
    return 0


def _imperfect_text(
    chain: Chain,
    exact: Estimates,
    gains: Gains,
    urdf: str,
    exact_text: Callable[[Gains, str], str],
) -> str:
    """Return the file of an imperfect robot, with the largest errors that leave bounds.

    Args:
        chain: the arm.
        exact: its limits without rotors and errors.
        gains: in its own file.
        urdf: text of its URDF.
        exact_text: returns its own file, with gains and the place of the URDF.

    Raises:
        NewRobotError: no errors leave bounds.
    """
    real = with_rotors(chain, exact.v_max)
    estimates = estimate(real, exact.rate_hz)
    quickest = QUICKEST * estimates.v_max
    estimates = replace(
        estimates,
        a_min=np.maximum(estimates.a_min, -quickest),
        a_max=np.minimum(estimates.a_max, quickest),
    )
    reason = "they take too much of the acceleration limits"
    for errors in ERRORS:
        disturbance = acceleration_errors(real, estimates, errors)
        if (disturbance > ROOM * np.minimum(-estimates.a_min, estimates.a_max)).any():
            continue

        def texts(
            own: Gains, place: str, errors: Errors = errors, disturbance: Array = disturbance
        ) -> list[str]:
            changed = {name: value for name, value in own.items() if gains.get(name) != value}
            imperfect = imperfect_file(real, estimates, errors, disturbance, changed)
            return [exact_text(gains, place), imperfect]

        try:
            begin = {**gains, **IMPERFECT_GAINS, HORIZON: errors.horizon}
            return texts(suitable_gains(urdf, texts, begin), "")[1]
        except ArmSafetyError as error:  # they leave no bounds, or no gains suit
            reason = str(error)
    raise NewRobotError(
        f"no imperfect robot at {exact.rate_hz:g} Hz: with the least errors {reason}; a higher "
        "--rate, or a file of your own like those in config/imperfect"
    )


def _tell_chain(chain: Chain) -> None:
    for remark in chain.remarks():
        print(remark)
    print(f"{chain.name}: {len(chain.joints)} joints, {len(chain.locked)} others locked at 0")
    for j, name in enumerate(chain.joints):
        unit, force = chain.units(j)
        ends = f"{chain.q_min[j]:8.3f} to {chain.q_max[j]:7.3f} {unit:3}"
        if chain.continuous[j]:
            ends = "  turns without end    "
        print(
            f"  {name:28} {ends}, {chain.v_max[j]:6.3f} {unit}/s, {chain.tau_max[j]:7.2f} {force}"
        )


def _tell_estimates(chain: Chain, estimates: Estimates) -> None:
    print(estimates.why)
    for j, name in enumerate(chain.joints):
        unit, _ = chain.units(j)
        print(
            f"  {name:28} {estimates.a_min[j]:7.2f} to {estimates.a_max[j]:6.2f} {unit}/s^2, "
            f"drift {estimates.drift[j]:7.0f} {unit}/s^3"
        )
    print(f"control rate: {estimates.rate_hz:g} Hz", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool("new_robot", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
