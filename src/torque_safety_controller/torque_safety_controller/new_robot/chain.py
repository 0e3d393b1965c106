# SPDX-License-Identifier: Apache-2.0
"""The moving joints between a base and the tips of an arm, or what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.estimate.worst_case import NO_INERTIA
from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.robot.description import build_model, kinematic_order

Array = NDArray[np.float64]

_MOVING = ("revolute", "continuous", "prismatic")


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
        continuous: whether a joint turns without end, shape (n,).
        locked: the movable joints that are none of these.
        model: Pinocchio's, n joints.
    """

    name: str
    root: str
    tips: tuple[str, ...]
    joints: tuple[str, ...]
    q_min: Array
    q_max: Array
    v_max: Array
    tau_max: Array
    continuous: NDArray[np.bool_]
    locked: tuple[str, ...]
    model: pin.Model


def find_chain(urdf: str, tips: Sequence[str], base: str = "") -> Chain:
    """Return the chain of moving joints from `base` to `tips`.

    Args:
        urdf: text of a URDF that is well-formed.
        tips: links at the ends of one or several arms.
        base: joints before this link are locked; none if empty.

    Raises:
        NewRobotError: an unknown link, a closed loop, a joint that mimics or that others mimic, a
            planar or floating one, one without limits, or that moves no inertia.
        RobotDescriptionError: the URDF does not load.
    """
    root = ElementTree.fromstring(urdf)
    above = _joints_above(root)
    links = [each.get("name", "") for each in root.findall("link")]
    for link in (*tips, *filter(None, [base])):
        if link not in links:
            parents = {_link(joint, "parent") for joint in root.findall("joint")}
            ends = ", ".join(link for link in links if link not in parents)
            hint = did_you_mean(link, links) or f"; links at the ends: {ends}"
            raise NewRobotError(f"the URDF has no link '{link}'{hint}")
    moving: dict[str, Element] = {}
    for tip in tips:
        way = _way(above, tip, base)
        _check_kinds(root, way)
        moving |= {name: each for name, each in way.items() if each.get("type") in _MOVING}
    if not moving:
        raise NewRobotError(
            f"no joint moves between '{base or 'the root'}' and {', '.join(tips)}; the tip must "
            "be a link behind the arm's last joint"
        )
    limits = np.array([_limits(name, each) for name, each in moving.items()]).T
    order = kinematic_order(urdf, tuple(moving))
    q_min, q_max, v_max, tau_max = limits[:, [list(moving).index(name) for name in order]]
    model = build_model(urdf, order)
    _check_inertias(model)
    others = (each for each in root.findall("joint") if each.get("type") in _MOVING)
    return Chain(
        name=_file_name(root.get("name", "robot")),
        root=next(link for link in links if link not in above),
        tips=tuple(tips),
        joints=order,
        q_min=q_min,
        q_max=q_max,
        v_max=v_max,
        tau_max=tau_max,
        continuous=np.isinf(q_max),
        locked=tuple(name for each in others if (name := each.get("name", "")) not in moving),
        model=model,
    )


def _link(joint: Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _joints_above(root: Element) -> dict[str, Element]:
    """Return the joint that carries each link; there may be one only."""
    above: dict[str, Element] = {}
    for joint in root.findall("joint"):
        child = _link(joint, "child")
        if child in above:
            names = f"'{above[child].get('name')}' and '{joint.get('name')}'"
            raise NewRobotError(
                f"link '{child}' hangs on {names}: a closed loop, whose motion a tree of joints "
                "does not have; cut it in the URDF where it carries least"
            )
        above[child] = joint
    return above


def _way(above: Mapping[str, Element], tip: str, base: str) -> dict[str, Element]:
    """Return the joints from `base` to `tip` by name."""
    way: list[Element] = []
    link = tip
    while link in above and link != base:
        if len(way) > len(above):
            raise NewRobotError(
                f"the joints above '{tip}' go round in a circle; cut it in the URDF"
            )
        way.append(above[link])
        link = _link(above[link], "parent")
    if base and link != base:
        raise NewRobotError(
            f"link '{tip}' does not hang on '{base}'; --base must be on the way from "
            f"'{link}' to the tip"
        )
    return {each.get("name", ""): each for each in reversed(way)}


def _check_kinds(root: Element, way: Mapping[str, Element]) -> None:
    """Refuse joints without a motor of their own, and grippers."""
    followers = {
        mimic.get("joint", ""): joint.get("name", "")
        for joint in root.findall("joint")
        if (mimic := joint.find("mimic")) is not None
    }
    moving = [name for name, joint in way.items() if joint.get("type") in _MOVING]
    for name, joint in reversed(list(way.items())):
        kind = joint.get("type")
        if kind in ("floating", "planar"):
            raise NewRobotError(
                f"joint '{name}' is {kind}, which no motor moves; --base {_link(joint, 'child')} "
                "leaves it out"
            )
        if joint.find("mimic") is not None and kind in _MOVING:
            why = "mimics another"
        elif name in followers:
            why = f"is one that '{followers[name]}' mimics"
        elif kind == "prismatic" and len(moving) > 1 and name == moving[-1]:
            why = "is the last and slides"
        else:
            continue
        raise NewRobotError(
            f"joint '{name}' {why}, as in a gripper; end the arm before it, with the tip "
            f"{_link(joint, 'parent')}"
        )


def _limits(name: str, joint: Element) -> tuple[float, float, float, float]:
    """Return position limits, speed and effort of a joint."""
    limit = joint.find("limit")
    given = {} if limit is None else limit.attrib
    try:
        values = {
            key: float(given.get(key, "nan")) for key in ("lower", "upper", "velocity", "effort")
        }
    except ValueError as error:
        raise NewRobotError(
            f"joint '{name}': {error}, not a number; correct its <limit> in the URDF"
        ) from None
    for key, what in (("effort", "torque"), ("velocity", "speed")):
        if not (math.isfinite(values[key]) and values[key] > 0.0):
            found = "no" if math.isnan(values[key]) else f"{values[key]:g} as"
            raise NewRobotError(
                f"joint '{name}' has {found} {key} limit: nothing is known of its {what}; write "
                f'{key}="..." into its <limit> in the URDF, from the data sheet'
            )
    low, high = values["lower"], values["upper"]
    if joint.get("type") == "continuous":
        low, high = -math.inf, math.inf
    if not low < high:
        raise NewRobotError(
            f"joint '{name}' has no room between its position limits, {low:g} and {high:g}; write "
            'lower="..." and upper="..." into its <limit>, or make it continuous'
        )
    return low, high, values["velocity"], values["effort"]


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
