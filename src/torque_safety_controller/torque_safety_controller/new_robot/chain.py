# SPDX-License-Identifier: Apache-2.0
"""The moving joints between a base and the tips of an arm, or what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.estimate.worst_case import NO_INERTIA
from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.robot.description import build_model, kinematic_order
from viability_bounds_pkg.robot.mistakes import (
    MOVING,
    SPEED_LIMITS,
    about,
    end_of,
    inertial_mistakes,
    inertial_oddities,
    speed_limit,
    urdf_mistakes,
)

Array = NDArray[np.float64]


FASTEST = 100.0
"""Speed limit, rad/s or m/s, above which it stands for none: no arm's joint is as fast."""


class NewRobotError(ArmSafetyError, ValueError):
    """A robot of which no parameters can be made; the message ends with a remedy."""


@dataclass(frozen=True, eq=False)
class Chain:
    """An arm, or two: the joints that move, and the limits that its URDF gives.

    Attributes:
        name: of the robot, fit for a file.
        root: link that all others hang on.
        tips: links at the ends; the first is the end effector.
        joints: n moving joints, base to tip.
        q_min: lower position limits, shape (n,), rad; infinite for continuous joints.
        q_max: upper position limits, shape (n,), rad.
        v_max: speed limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
        velocity_offset: of speed limits that depend on position, shape (n,), rad/s; 0 for none.
        deceleration_limit: of the same, shape (n,), rad/s^2; inf for none.
        continuous: whether a joint turns without end, shape (n,).
        slides: whether a joint is prismatic, shape (n,): its units are m, m/s and N.
        locked: the movable joints that are none of these.
        model: Pinocchio's, n joints.
        slowed: whether speed limits are not those of the URDF.
        odd: what is odd about the links' inertias, a line each.
    """

    name: str
    root: str
    tips: tuple[str, ...]
    joints: tuple[str, ...]
    q_min: Array
    q_max: Array
    v_max: Array
    tau_max: Array
    velocity_offset: Array
    deceleration_limit: Array
    continuous: NDArray[np.bool_]
    slides: NDArray[np.bool_]
    locked: tuple[str, ...]
    model: pin.Model
    slowed: bool
    odd: tuple[str, ...]

    def remarks(self) -> list[str]:
        """Return what looks as if the URDF did not have it from a data sheet, a line each."""
        lines = list(self.odd)
        if len(self.joints) > 2 and len(set(self.tau_max.tolist())) == 1:
            lines.append(
                f"the effort limits are {self.tau_max[0]:g} everywhere: if this is a placeholder, "
                "write those of the motors into the URDF"
            )
        return lines

    def units(self, joint: int) -> tuple[str, str]:
        """Return the units of a joint's position and of its torque, or force."""
        return ("m", "N") if self.slides[joint] else ("rad", "N m")


def find_chain(
    urdf: str, tips: Sequence[str], base: str = "", velocity_max: float = math.inf
) -> Chain:
    """Return the chain of moving joints from `base` to `tips`.

    Args:
        urdf: text of a URDF that is well-formed.
        tips: links at the ends of one or several arms.
        base: joints before this link are locked; none if empty.
        velocity_max: largest speed limit, in place of larger ones or of none, rad/s or m/s.

    Raises:
        NewRobotError: what is wrong, all of it, a line each: with the URDF, such as a closed
            loop; an unknown link; a joint that mimics or that others mimic, a planar or floating
            one, one without limits; a link that moves without an inertia.
        RobotDescriptionError: the URDF does not load.
    """
    root = ElementTree.fromstring(urdf)
    wrong = urdf_mistakes(root)
    try:
        ways = _ways(root, tips, base)
    except NewRobotError as error:
        raise NewRobotError("\n".join(wrong or [str(error)])) from None
    kinds = [list(_of_kinds(root, way)) for way in ways]
    unfit = dict(pair for each in kinds for pair in each[:1])
    moving = {
        name: each
        for way in ways
        for name, each in way.items()
        if each.get("type") in MOVING and name not in unfit
    }
    limits, lacking = _limits(moving, velocity_max)
    if len(moving) == 1 and not wrong and not unfit:
        wrong.append(f"only joint '{next(iter(moving))}' moves; the controller is for two or more")
    wrong += [*unfit.values(), *lacking, *inertial_mistakes(root, moving)]
    if wrong:
        raise NewRobotError("\n".join(wrong))
    order = kinematic_order(urdf, tuple(moving))
    q_min, q_max, v_max, tau_max, c, d = np.array([limits[name] for name in order]).T
    model = build_model(urdf, order)
    _check_inertias(model)
    others = (each for each in root.findall("joint") if each.get("type") in MOVING)
    return Chain(
        name=_file_name(root.get("name", "robot")),
        root=_root(root),
        tips=tuple(tips),
        joints=order,
        q_min=q_min,
        q_max=q_max,
        v_max=v_max,
        tau_max=tau_max,
        velocity_offset=c,
        deceleration_limit=d,
        continuous=np.isinf(q_max),
        slides=np.array([moving[name].get("type") == "prismatic" for name in order]),
        locked=tuple(name for each in others if (name := each.get("name", "")) not in moving),
        model=model,
        slowed=velocity_max < math.inf,
        odd=tuple(inertial_oddities(root, moving)),
    )


def _root(root: Element) -> str:
    """Return the link that all others hang on."""
    carried = {end_of(joint, "child") for joint in root.findall("joint")}
    return next(name for name in _links(root) if name not in carried)


def _links(root: Element) -> list[str]:
    return [each.get("name", "") for each in root.findall("link")]


def _ways(root: Element, tips: Sequence[str], base: str) -> list[dict[str, Element]]:
    """Return the joints from `base` to each tip by name, at least one of which moves."""
    links, joints = _links(root), root.findall("joint")
    for link in (*tips, *filter(None, [base])):
        if link not in links:
            parents = {end_of(joint, "parent") for joint in joints}
            ends = ", ".join(link for link in links if link not in parents)
            hint = did_you_mean(link, links) or f"; links at the ends: {ends}"
            raise NewRobotError(f"the URDF has no link '{link}'{hint}")
    above = {end_of(joint, "child"): joint for joint in joints}
    ways = [_way(above, tip, base) for tip in tips]
    if not any(each.get("type") not in (None, "fixed") for way in ways for each in way.values()):
        raise NewRobotError(
            f"no joint moves between '{base or 'the root'}' and {', '.join(tips)}; the tip must "
            "be a link behind the arm's last joint"
        )
    return ways


def _way(above: Mapping[str, Element], tip: str, base: str) -> dict[str, Element]:
    """Return the joints from `base` to `tip` by name."""
    way: list[Element] = []
    link = tip
    while link in above and link != base and above[link] not in way:
        way.append(above[link])
        link = end_of(above[link], "parent")
    if base and link != base:
        raise NewRobotError(
            f"link '{tip}' does not hang on '{base}'; --base must be on the way from "
            f"'{link}' to the tip"
        )
    return {each.get("name", ""): each for each in reversed(way)}


def _of_kinds(root: Element, way: Mapping[str, Element]) -> Iterator[tuple[str, str]]:
    """Yield joints without a motor of their own, and of grippers, and why not, tip first."""
    joints = root.findall("joint")
    followers = {
        mimic.get("joint", ""): joint.get("name", "")
        for joint in joints
        if (mimic := joint.find("mimic")) is not None
    }
    moving = [name for name, joint in way.items() if joint.get("type") in MOVING]
    for name, joint in reversed(list(way.items())):
        kind, parent = joint.get("type"), end_of(joint, "parent")
        fingers = [
            each.get("name", "")
            for each in joints
            if each.get("type") == "prismatic" and end_of(each, "parent") == parent
        ]
        if kind in ("floating", "planar"):
            line = (
                f"joint '{name}' is {kind}, which no motor moves; --base {end_of(joint, 'child')} "
                "leaves it out"
            )
            yield name, line
            continue
        if joint.find("mimic") is not None and kind in MOVING:
            why = "mimics another"
        elif name in followers:
            why = f"is one that '{followers[name]}' mimics"
        elif [name] == moving[-1:] and name in fingers and len(fingers) > 1:
            why = f"is one of the fingers {' and '.join(fingers)}"
        else:
            continue
        line = (
            f"joint '{name}' {why}, as in a gripper; end the arm before it, with the tip {parent}"
        )
        yield name, line


def _limits(
    moving: Mapping[str, Element], velocity_max: float
) -> tuple[dict[str, list[float]], list[str]]:
    """Return limits of joints by name, and what is wrong with them.

    They are lower and upper position, speed, effort, velocity offset and deceleration limit.
    """
    limits, wrong = {}, []
    lacking: dict[str, list[str]] = {}
    for name, joint in moving.items():
        limit = joint.find("limit")
        given = {} if limit is None else limit.attrib
        keys = ("lower", "upper", "velocity", "effort")
        try:
            low, high, velocity, effort = (float(given.get(key, "nan")) for key in keys)
        except ValueError as error:
            wrong.append(f"joint '{name}': {error}, not a number; correct its <limit> in the URDF")
            continue
        if velocity_max < math.inf:
            velocity = min(velocity, velocity_max) if velocity > 0.0 else velocity_max
        elif FASTEST < velocity < math.inf:
            wrong.append(
                f"joint '{name}' has {velocity:g} as velocity limit, which is no limit: give "
                "--velocity-max, from the data sheet"
            )
        for key, what, value in (("effort", "torque", effort), ("velocity", "speed", velocity)):
            if not (math.isfinite(value) and value > 0.0):
                found = "no" if math.isnan(value) else f"{value:g} as"
                why = (
                    f"{found} {key} limit: nothing is known of the {what}; "
                    f'write {key}="..." into <limit> in the URDF, from the data sheet'
                )
                lacking.setdefault(why, []).append(name)
        if joint.get("type") == "continuous":
            low, high = -math.inf, math.inf
        if not low < high:
            why = (
                f"no room between position limits, {low:g} and {high:g}; "
                'write lower="..." and upper="..." into <limit>, or make it continuous'
            )
            lacking.setdefault(why, []).append(name)
        c, d = 0.0, math.inf
        try:
            c, d = speed_limit(joint)
            if 0.0 < high - low <= c * c / d:
                raise ValueError(
                    f"<{SPEED_LIMITS}> leaves no place to move: velocity_offset^2 / "
                    f"deceleration_limit is {c * c / d:.3g}, the range {high - low:.3g}"
                )
        except ValueError as error:
            wrong.append(f"joint '{name}': {error}; correct it in the URDF, from the data sheet")
        limits[name] = [low, high, velocity, effort, c, d]
    wrong += [f"{about('joint', each, 'has', 'have')} {why}" for why, each in lacking.items()]
    return limits, wrong


def _check_inertias(model: pin.Model) -> None:
    inertia = np.diag(pin.crba(model, model.createData(), np.zeros(model.nq)))
    for index in np.flatnonzero(~(inertia > NO_INERTIA)).tolist():
        raise NewRobotError(
            f"joint '{model.names[1 + index]}' moves no inertia: the links beyond it have no "
            "<inertial>; write mass and moments of inertia into the URDF, or end the arm before it"
        )


def _file_name(name: str) -> str:
    kept = "".join(letter if letter.isalnum() else "_" for letter in name.lower()).strip("_")
    return kept or "robot"
