# SPDX-License-Identifier: Apache-2.0
"""Command line tool that makes the parameter files of an arm from its URDF.

Finds joints, limits, a start posture, and gains; estimates acceleration limits, drift and margins;
writes the robot's file, one of an imperfect robot, and a scenario that drives it into its limits.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.loop_margins.gain_check import (
    HORIZON,
    OBSERVER,
    GainLimit,
)
from torque_safety_controller.new_robot.chain import Chain, NewRobotError, find_chain
from torque_safety_controller.new_robot.estimates import Estimates, estimate
from torque_safety_controller.new_robot.files import (
    imperfect_file,
    parameter_file,
    scenario_file,
)
from torque_safety_controller.new_robot.hardware import (
    GRADES,
    Grade,
    acceleration_errors,
    with_rotors,
)
from torque_safety_controller.new_robot.postures import SelfCollisions, find_postures
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.tools.fit_capsules import with_capsules
from torque_safety_controller.tools.gain_limits import gain_check
from viability_bounds_pkg.cli.command_line import Parser, positive, run_tool
from viability_bounds_pkg.cli.limits_file import CONTROLLER, NODE, check_writable, write_whole
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter_files import read_files
from viability_bounds_pkg.robot.description import (
    check_urdf,
    package_directories,
    read_urdf,
    resolve_uri,
)

Array = NDArray[np.float64]
Gains = dict[str, float]

GAINS = {
    "pose_kp": 30.0,
    "pose_kd": -1.0,
    "pose_weight": 1.0,
    "posture_kp": 10.0,
    "posture_kd": -1.0,
    "posture_weight": 0.001,
    "hold_kd": 20.0,
}
"""Of the controller, to begin with: those of config/panda.yaml."""

OBSERVER_PERIODS = 2.5
"""Time constant of the disturbance observer, control periods, as of the shipped Panda."""

IMPERFECT_GAINS = {"integral_lambda": 30.0, "disturbance_time": 0.012}
"""To begin with: those of config/imperfect/panda.yaml."""

_ROUNDS = 8
_INSIDE = 0.9  # of what a gain may be at most


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="new_robot",
        description="Make the parameter files of an arm from its URDF.",
        epilog="scripts/new_robot.sh runs it, and then the arm. docs/new_robot.md tells what is "
        "found and how.",
    )
    add = parser.add_argument
    add("urdf", nargs="?", help="URDF or xacro file, or package:// URI")
    add("tip", help="link at the end of the arm, of two arms both: LEFT,RIGHT")
    add("--topic", action="store_true", help="take the URDF from the topic robot_description")
    add("--base", default="", metavar="LINK", help="lock the joints before this link")
    add("--name", default="", help="of the files (default: that in the URDF)")
    add("--rate", type=positive, metavar="HZ", help="control rate (default: chosen)")
    add("--out", type=Path, default=Path("config"), help="folder to write to (default: config)")
    add("--force", action="store_true", help="replace files of this name")
    options = parser.parse_args(arguments)
    if options.topic == (options.urdf is not None):
        parser.error("either a URDF or --topic must be given, and a tip")
    if options.name and not options.name.isidentifier():
        parser.error(f"argument --name: must be letters, digits and _, is '{options.name}'")
    if options.rate is not None and options.rate > 1e4:
        parser.error(f"argument --rate: must be at most 10000, is {options.rate:g}")
    return options


def _read(options: argparse.Namespace) -> tuple[str, str, Path | None]:
    """Return the text of the URDF, its source, empty if it must be kept, and its folder."""
    if options.topic:
        return _from_topic(), "", None
    path = resolve_uri(options.urdf).resolve()
    # What xacro has made may have calls of it left in comments.
    text = re.sub("<!--.*?-->", "", path.read_text(errors="replace"), flags=re.DOTALL)
    if path.suffix == ".xacro" or "<xacro:" in text:
        return _through_xacro(path), "", path.parent
    return read_urdf(str(path)), _uri(path), path.parent


def _from_topic() -> str:
    import rclpy

    from viability_bounds_pkg.ros.robot_urdf import urdf_from_topic

    rclpy.init(args=[])
    try:
        node = rclpy.create_node("new_robot")
        return urdf_from_topic(node)
    finally:
        rclpy.try_shutdown()


def _through_xacro(path: Path) -> str:
    try:
        import xacro
    except ImportError as error:
        raise NewRobotError(
            f"{path} is for xacro, which is not installed; pip install xacro, or apt install "
            "ros-jazzy-xacro"
        ) from error
    try:
        urdf: str = xacro.process_file(str(path)).toprettyxml(indent="  ")
    except Exception as error:  # of many kinds: of its own, of XML, of Python in the file
        raise NewRobotError(f"xacro {path} fails: {error}; give it what it asks for") from error
    check_urdf(urdf, str(path))
    return urdf


def _uri(path: Path) -> str:
    """Return a file as a ``package://`` URI where packages are looked up there."""
    for directory in package_directories():
        if directory.is_dir() and path.is_relative_to(directory.resolve()):
            return f"package://{path.relative_to(directory.resolve())}"
    return str(path)


def _run(options: argparse.Namespace) -> int:
    urdf, source, folder = _read(options)
    chain = find_chain(urdf, options.tip.split(","), options.base)
    chain = replace(chain, name=options.name or chain.name)
    out: Path = options.out
    files = {
        "robot": out / f"{chain.name}.yaml",
        "scenario": out / "scenarios" / f"{chain.name}_demo.yaml",
        "imperfect": out / "imperfect" / f"{chain.name}.yaml",
    }
    if not source:
        files["urdf"] = out / f"{chain.name}.urdf"
        source = str(files["urdf"].resolve())
    for path in files.values():
        if path.exists() and not options.force:
            raise NewRobotError(f"{path} exists; --force replaces it, --name gives another name")
        path.parent.mkdir(parents=True, exist_ok=True)
        check_writable(path)
    _tell_chain(chain)
    print("estimating acceleration limits ...", flush=True)
    estimates = estimate(chain, options.rate)
    _tell_estimates(chain, estimates)
    touches = SelfCollisions(chain, urdf, folder)
    postures = find_postures(chain, touches)
    if touches.trouble:
        print(f"collisions of the arm with itself are not looked at: {touches.trouble}")
    bounded = ~chain.continuous
    print(
        f"scenario: {len(postures.goals)} goals, with {int(postures.reached[bounded].sum())} of "
        f"the {2 * int(bounded.sum())} position limits, and back"
    )
    if "urdf" in files:
        write_whole(files["urdf"], urdf)

    def robot_text(gains: Gains) -> str:
        return parameter_file(
            chain, estimates, postures, touches, source=source, base=options.base, gains=gains
        )

    begin = GAINS | {OBSERVER: OBSERVER_PERIODS / estimates.rate_hz}
    text, gains = _with_gains_that_suit(robot_text, begin, [])
    if touches.capsules:
        text = with_capsules(text, touches.capsules)
    write_whole(files["robot"], text)
    write_whole(files["scenario"], scenario_file(chain, estimates, postures))
    write_whole(files["imperfect"], _imperfect(chain, estimates, gains, files["robot"]))
    for name, path in files.items():
        print(f"written: {path} ({name})")
    return 0


def _imperfect(chain: Chain, ideal: Estimates, gains: Gains, robot: Path) -> str:
    """Return the file of the imperfect robot, with the first grade of hardware that leaves bounds.

    Args:
        chain: the arm.
        ideal: its limits, without rotors and imperfections.
        gains: in its own file.
        robot: that file.

    Raises:
        NewRobotError: no hardware leaves bounds.
    """
    real = with_rotors(chain)
    estimates = estimate(real, ideal.rate_hz)
    reason = ""
    for grade in GRADES:
        disturbance = acceleration_errors(real, estimates, grade)

        def text(own: Gains, grade: Grade = grade, disturbance: Array = disturbance) -> str:
            longer = replace(grade, horizon=own[HORIZON])
            changed: dict[str, Any] = {"integral_action": "joints"} | {
                name: value
                for name, value in own.items()
                if name != HORIZON and gains.get(name) != value
            }
            return imperfect_file(real, ideal, estimates, longer, disturbance, changed)

        try:
            begin = {**gains, **IMPERFECT_GAINS, HORIZON: grade.horizon}
            return _with_gains_that_suit(text, begin, [robot])[0]
        except ArmSafetyError as error:  # it leaves no bounds, or no gains suit
            reason = str(error).partition(": ")[2]
    raise NewRobotError(
        f"no assumed hardware leaves this arm bounds at {ideal.rate_hz:g} Hz: {reason}; a higher "
        "--rate, or a file of your own like those in config/imperfect"
    )


def _with_gains_that_suit(
    make: Callable[[Gains], str], gains: Gains, before: Sequence[Path]
) -> tuple[str, Gains]:
    """Return a parameter file, and gains in it that the robot bears: lowered until it does.

    Args:
        make: returns the file with gains.
        gains: to begin with.
        before: files that are given before it.

    Raises:
        ArmSafetyError: the files leave no bounds, or no gains suit.
    """
    for _ in range(_ROUNDS):
        text = make(gains)
        with tempfile.NamedTemporaryFile("w", suffix=".yaml") as trial:
            trial.write(text)
            trial.flush()
            beyond = _exceeded([*before, Path(trial.name)])
        if not beyond:
            return text, gains
        gains = _lowered(gains, beyond)
    worst = beyond[0]
    raise NewRobotError(
        f"no gains suit this rate: '{worst.name}' is {worst.value:.4g}, beyond its limit "
        f"{worst.limit:.3g}; a higher --rate"
    )


def _exceeded(paths: Sequence[Path]) -> list[GainLimit]:
    """Return the gains of parameter files that are too large for the robot.

    Raises:
        ArmSafetyError: the files leave no bounds.
    """
    config = read_files(ControllerConfiguration, paths, CONTROLLER)
    robot = read_files(BoundsConfiguration, paths, NODE)
    make_bounds(robot)
    return [each for each in gain_check(config, robot).limits() if each.exceeded]


def _lowered(gains: Gains, beyond: Sequence[GainLimit]) -> Gains:
    """Return gains, with those that are beyond their limits brought inside."""
    changed = dict(gains)
    for each in beyond:
        task, _, kind = each.name.rpartition("_")
        share = _INSIDE * each.limit / each.value if each.value else 0.0
        if each.name == HORIZON and HORIZON in gains and np.isfinite(each.limit):
            changed[HORIZON] = float(np.ceil(each.limit / _INSIDE))
        elif each.name == OBSERVER:
            changed[OBSERVER] = float(f"{each.limit / _INSIDE:.3g}")
        elif kind == "kd" and f"{task}_kp" in gains:
            changed[f"{task}_kp"] = float(f"{gains[f'{task}_kp'] * share**2:.3g}")
        elif each.name in gains and each.name != HORIZON:
            changed[each.name] = float(f"{gains[each.name] * share:.3g}")
    return changed


def _tell_chain(chain: Chain) -> None:
    print(f"{chain.name}: {len(chain.joints)} joints, {len(chain.locked)} others locked at 0")
    for j, name in enumerate(chain.joints):
        ends = f"{chain.q_min[j]:8.3f} to {chain.q_max[j]:7.3f} rad"
        if chain.continuous[j]:
            ends = "  turns without end    "
        print(f"  {name:28} {ends}, {chain.v_max[j]:6.3f} rad/s, {chain.tau_max[j]:7.2f} N m")


def _tell_estimates(chain: Chain, estimates: Estimates) -> None:
    print(estimates.why)
    for j, name in enumerate(chain.joints):
        print(
            f"  {name:28} {estimates.a_min[j]:7.2f} to {estimates.a_max[j]:6.2f} rad/s^2, "
            f"drift {estimates.drift[j]:7.0f} rad/s^3"
        )
    print(f"control rate: {estimates.rate_hz:g} Hz", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 for an error, 2 for usage, 130 for an interrupt."""
    options = _parse(arguments)
    return run_tool("new_robot", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
