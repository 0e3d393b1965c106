# SPDX-License-Identifier: Apache-2.0
"""Command line tool that makes the parameter files of an arm from its URDF.

Finds joints, limits, a start posture, and gains; estimates acceleration limits, drift and margins;
writes the robot's file, and a scenario that drives it into its limits.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pinocchio as pin

from torque_safety_controller.new_robot.capsules import capsule_entries
from torque_safety_controller.new_robot.chain import Chain, NewRobotError, find_chain
from torque_safety_controller.new_robot.estimates import Estimates, estimate
from torque_safety_controller.new_robot.files import parameter_file, scenario_file
from torque_safety_controller.new_robot.postures import SelfCollisions, find_postures
from torque_safety_controller.tools.fit_capsules import with_capsules
from torque_safety_controller.tools.gain_limits import OBSERVER, GainLimit, gain_check
from viability_bounds_pkg.cli.command_line import Parser, number, positive, run_tool
from viability_bounds_pkg.cli.limits_file import NODE, check_writable, write_whole
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter_files import read_files
from viability_bounds_pkg.robot.description import load_geometry
from viability_bounds_pkg.robot.files import (
    RobotDescriptionError,
    package_folder,
    parsed_urdf,
    resolve_uri,
    urdf_text,
    with_own_package,
)

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

OBSERVER_MAX = 0.1
"""The largest that its parameter takes, s."""

_ROUNDS = 8
_INSIDE = 0.9  # of what a gain may be at most


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


def _with_tool(urdf: str, tip: str, mass: float, centre: str) -> str:
    """Return a URDF with a mass fixed to a link; unchanged if it has no such link."""
    root = ElementTree.fromstring(urdf)
    if tip not in [link.get("name") for link in root.findall("link")]:
        return urdf
    name = f"{tip}_tool"
    inertial = ElementTree.SubElement(ElementTree.SubElement(root, "link", name=name), "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=centre)
    ElementTree.SubElement(inertial, "mass", value=f"{mass:g}")
    moments = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
    ElementTree.SubElement(inertial, "inertia", moments)
    joint = ElementTree.SubElement(root, "joint", name=name, type="fixed")
    ElementTree.SubElement(joint, "parent", link=tip)
    ElementTree.SubElement(joint, "child", link=name)
    return ElementTree.tostring(root, encoding="unicode")


def _read(options: argparse.Namespace) -> tuple[str, str, Path | None]:
    """Return the text of the URDF, its source, empty if it must be kept, and its folder."""
    if options.topic:
        urdf, source, folder = _from_topic(), "", None
    else:
        path = resolve_uri(options.urdf).resolve()
        urdf, folder = urdf_text(path, str(path)), path.parent
        # What xacro has made may have calls of it left in comments.
        bare = re.sub("<!--.*?-->", "", urdf, flags=re.DOTALL)
        if path.suffix == ".xacro" or "<xacro:" in bare:
            urdf, source = _through_xacro(path, options.mappings), ""
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


def _through_xacro(path: Path, mappings: Mapping[str, str]) -> str:
    """Return the URDF that a xacro file and its arguments make."""
    try:
        import xacro
        from xacro import substitution_args
    except ImportError as error:
        raise NewRobotError(
            f"{path} is for xacro, which is not installed; pip install xacro, or apt install "
            "ros-jazzy-xacro"
        ) from error

    def find(package: str) -> str:
        """Return the folder of a package; xacro itself looks at AMENT_PREFIX_PATH only."""
        return str(package_folder(package, path))

    substitution_args._eval_find = find
    try:
        urdf: str = xacro.process_file(str(path), mappings=dict(mappings)).toprettyxml(indent="  ")
    except Exception as error:  # of many kinds: of its own, of XML, of Python in the file
        cause: Any = error
        while isinstance(inner := getattr(cause, "exc", None), Exception):
            cause = inner
        why = " ".join(str(cause).split())
        remedy = "give it what it asks for"
        if isinstance(cause, substitution_args.ArgException):
            why, remedy = f"it has no argument '{cause}'", f"give {cause}:=VALUE"
        elif isinstance(cause, RobotDescriptionError):
            remedy = "set ROS_PACKAGE_PATH to the folder with it"
        raise NewRobotError(f"xacro {path} fails: {why}; {remedy}") from error
    return with_own_package(urdf, path)


def _run(options: argparse.Namespace) -> int:
    urdf, source, folder = _read(options)
    if options.tool:
        urdf, source = _with_tool(urdf, options.tip.split(",")[0], *options.tool), ""
    fastest = options.velocity_max or math.inf
    chain = find_chain(urdf, options.tip.split(","), options.base, fastest)
    chain = replace(chain, name=options.name or chain.name)
    out: Path = options.out
    files = {
        "robot": out / f"{chain.name}.yaml",
        "scenario": out / "scenarios" / f"{chain.name}_demo.yaml",
    }
    if not source:
        files["urdf"] = out / f"{chain.name}.urdf"
        source = str(files["urdf"].resolve())
    for path in files.values():
        if path.exists() and not options.force:
            raise NewRobotError(f"{path} exists; --force replaces it, --name gives another name")
        there = next(folder for folder in path.resolve().parents if folder.exists())
        check_writable(there / path.name)
    _tell_chain(chain)
    print("estimating acceleration limits ...", flush=True)
    estimates = estimate(chain, options.rate)
    _tell_estimates(chain, estimates)
    geometry, trouble = _shapes(urdf, folder, chain.model)
    touches = SelfCollisions(chain, geometry)
    checked = f"{touches.pairs} pairs of shapes checked"
    if trouble:
        checked = f"not checked for collisions ({trouble})"
        print(f"collisions of the arm with itself are not checked: {trouble}")
    postures = find_postures(chain, touches)
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
    gains = _suitable_gains(urdf, robot_text, GAINS | {OBSERVER: observer})
    text = robot_text(gains, source)
    if capsules := capsule_entries(chain.model, geometry):
        text = with_capsules(text, capsules)
    texts = {
        "robot": text,
        "scenario": scenario_file(chain, estimates, postures),
        "urdf": urdf,
    }
    for name, path in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, texts[name])
    for name, path in files.items():
        print(f"written: {path} ({name})")
    return 0


def _shapes(urdf: str, folder: Path | None, model: pin.Model) -> tuple[pin.GeometryModel, str]:
    """Return the collision shapes of a robot; without them, why.

    Args:
        urdf: text of its URDF.
        folder: of the URDF, where relative names of meshes begin; None if it came from a topic.
        model: of its joints.
    """
    root = ElementTree.fromstring(urdf)
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if folder is not None and "://" not in name and (folder / name).is_file():
            mesh.set("filename", str(folder / name))
    try:
        geometry = load_geometry(ElementTree.tostring(root, encoding="unicode"), model)
    except RobotDescriptionError as error:
        return pin.GeometryModel(), str(error).splitlines()[0]
    return geometry, "" if geometry.ngeoms else "the URDF has no collision shapes"


def _suitable_gains(urdf: str, make: Callable[[Gains, str], str], gains: Gains) -> Gains:
    """Return gains, lowered until the delay and the rate of a parameter file allow them.

    Args:
        urdf: text of the URDF.
        make: returns the file with gains, and with the place of a URDF.
        gains: to begin with.

    Raises:
        ArmSafetyError: the file leaves no bounds, or no gains suit.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial, robot = Path(folder) / "trial.yaml", Path(folder) / "robot.urdf"
        robot.write_text(urdf, encoding="utf-8")
        for _ in range(_ROUNDS):
            trial.write_text(make(gains, str(robot)), encoding="utf-8")
            beyond = _exceeded(trial)
            if not beyond:
                return gains
            gains = _lowered(gains, beyond)
    worst = beyond[0]
    raise NewRobotError(
        f"no gains suit this rate: '{worst.name}' is {worst.value:.4g}, beyond its limit "
        f"{worst.limit:.3g}; a higher --rate"
    )


def _exceeded(path: Path) -> list[GainLimit]:
    """Return the gains of a parameter file that are beyond their limits.

    Raises:
        ArmSafetyError: the file leaves no bounds.
    """
    make_bounds(read_files(BoundsConfiguration, [path], NODE))
    return [each for each in gain_check([path]).limits() if each.exceeded]


def _lowered(gains: Gains, beyond: Sequence[GainLimit]) -> Gains:
    """Return gains, with those that are beyond their limits brought inside."""
    changed = dict(gains)
    for each in beyond:
        task, _, kind = each.name.rpartition("_")
        share = _INSIDE * each.limit / each.value if each.value else 0.0
        if each.name == OBSERVER:
            changed[OBSERVER] = float(f"{each.limit / _INSIDE:.3g}")
        elif kind == "kd" and f"{task}_kp" in gains:
            changed[f"{task}_kp"] = float(f"{gains[f'{task}_kp'] * share**2:.3g}")
        elif each.name in gains:
            changed[each.name] = float(f"{gains[each.name] * share:.3g}")
    return changed


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
