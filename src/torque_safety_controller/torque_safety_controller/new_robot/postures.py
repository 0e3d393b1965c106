# SPDX-License-Identifier: Apache-2.0
"""Postures of a new robot: where it starts, and where a first scenario drives it to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.new_robot.capsules import capsule_entries
from torque_safety_controller.new_robot.chain import Chain, NewRobotError
from viability_bounds_pkg.robot.description import RobotDescriptionError, load_geometry

Array = NDArray[np.float64]

_STARTS = 400
_GOALS = 2  # at most
_TRIES = 8  # for each
_STEPS = 12  # of a straight way that are looked at
_ALWAYS = 0.8  # share of postures: shapes that touch in as many are no collision of the arm
_HELD_AT_START, _HELD_AT_GOAL = 0.6, 0.85  # of the torque limits, to hold the arm
_MIDDLE = 0.6  # share of a range in which the arm starts
_SEED = 0


class SelfCollisions:
    """Which postures make links of the arm touch each other or the rest of the robot.

    Args:
        chain: the arm.
        urdf: text of its URDF.
        folder: of the URDF, where relative names of meshes begin; None if it came from a topic.

    Attributes:
        trouble: why shapes are not looked at; empty if they are.
        pairs: how many pairs of shapes are looked at.
        capsules: around the links, entries of ``collision_capsules``.
    """

    def __init__(self, chain: Chain, urdf: str, folder: Path | None) -> None:
        self.trouble, self.pairs = "", 0
        self.capsules: list[str] = []
        self._model, self._data = chain.model, chain.model.createData()
        try:
            geometry = load_geometry(_with_absolute_meshes(urdf, folder), chain.model)
        except RobotDescriptionError as error:
            self.trouble = str(error).splitlines()[0]
            return
        self.capsules = capsule_entries(chain.model, geometry)
        shapes = geometry.geometryObjects
        parents = list(chain.model.parents)
        for first in range(len(shapes)):
            for second in range(first + 1, len(shapes)):
                joints = sorted((shapes[first].parentJoint, shapes[second].parentJoint))
                # Neighbours touch at their joint.
                if joints[0] != joints[1] and parents[joints[1]] != joints[0]:
                    geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._geometry = geometry
        self._drop_pairs_in_touch(chain)
        self.pairs = len(geometry.collisionPairs)
        if not shapes:
            self.trouble = "the URDF has no collision shapes"

    def __call__(self, q: Array) -> bool:
        """Return whether anything touches in a posture, shape (n,), rad."""
        if not self.pairs:
            return False
        self._update(q)
        return bool(pin.computeCollisions(self._geometry, self._found, True))

    def _update(self, q: Array) -> None:
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._found, q)

    def _drop_pairs_in_touch(self, chain: Chain) -> None:
        """Leave out pairs that overlap nearly anywhere, as shapes of a wrist often do."""
        self._found = self._geometry.createData()
        # Copies: removing one moves what Pinocchio's own refer to.
        pairs = [(each.first, each.second) for each in self._geometry.collisionPairs]
        touching = np.zeros(len(pairs))
        random = np.random.default_rng(_SEED)
        unit = 0.5 + _MIDDLE * (random.random((40, len(chain.joints))) - 0.5)
        postures = _within(chain, unit)
        for q in postures:
            self._update(q)
            pin.computeCollisions(self._geometry, self._found, False)
            touching += [each.isCollision() for each in self._found.collisionResults]
        for pair, count in zip(pairs, touching, strict=True):
            if count >= _ALWAYS * len(postures):
                self._geometry.removeCollisionPair(pin.CollisionPair(*pair))
        self._found = self._geometry.createData()


@dataclass(frozen=True, eq=False)
class Postures:
    """Where a new robot starts, and where its first scenario drives it.

    Attributes:
        start: shape (n,), rad.
        held: largest share of a torque limit that holds the arm there.
        goals: postures with joints at their limits.
        reached: whether a joint is at its lower, or upper, limit in any of them, shape (n, 2).
    """

    start: Array
    held: float
    goals: tuple[Array, ...]
    reached: NDArray[np.bool_]


def find_postures(chain: Chain, touches: SelfCollisions) -> Postures:
    """Return a start, and goals at position limits on straight ways without collisions.

    Args:
        chain: the arm.
        touches: tells its collisions with itself.

    Raises:
        NewRobotError: no posture is free of collisions that the motors can hold.
    """
    random = np.random.default_rng(_SEED)
    start = _start(chain, touches, random)
    goals: list[Array] = []
    reached = np.zeros((len(start), 2), dtype=bool)
    for _ in range(_GOALS):
        tried = [_goal(chain, touches, start, random, reached) for _ in range(_TRIES)]
        goal, at = max(tried, key=lambda each: int(each[1].sum()))
        if not at.any():
            break
        goals.append(goal)
        reached |= at
    return Postures(start, _held(chain, start), tuple(goals), reached)


def _within(chain: Chain, unit: Array) -> Array:
    """Return positions to look among, by numbers from 0 to 1; no more than a turn of them."""
    low, high = np.maximum(chain.q_min, -1e3), np.minimum(chain.q_max, 1e3)
    middle = np.where(chain.continuous, 0.0, 0.5 * (low + high))
    half = np.minimum(0.5 * (high - low), np.pi)
    low, high = middle - half, middle + half
    return np.asarray(low + unit * (high - low))


def _held(chain: Chain, q: Array) -> float:
    """Return the largest share of a torque limit that holds the arm in a posture."""
    gravity = pin.computeGeneralizedGravity(chain.model, chain.model.createData(), q)
    return float(np.max(np.abs(gravity) / chain.tau_max))


def _start(chain: Chain, touches: SelfCollisions, random: np.random.Generator) -> Array:
    """Return the posture with the best mix of bent joints, middle of ranges and little torque."""
    data, frame = chain.model.createData(), chain.model.getFrameId(chain.tips[0])
    unit = 0.5 + _MIDDLE * (random.random((_STARTS, len(chain.joints))) - 0.5)
    ranked = []
    for q, part in zip(_within(chain, unit), unit, strict=True):
        held = _held(chain, q)
        J = pin.computeFrameJacobian(chain.model, data, q, frame)
        # A hand that can move in all directions: its least singular value.
        agile = np.linalg.svd(J, compute_uv=False).min()
        ranked.append((held + float(np.mean(np.abs(part - 0.5))) - 2.0 * min(agile, 0.2), held, q))
    for _, held, q in sorted(ranked, key=lambda each: each[0]):
        if held <= _HELD_AT_START and not touches(q):
            return np.round(q, 3)
    least = min(held for _, held, _ in ranked)
    if least > _HELD_AT_START:
        raise NewRobotError(
            f"to hold the arm takes at least {least:.0%} of a torque limit in {_STARTS} postures; "
            "are the effort limits of the URDF those of the motors?"
        )
    raise NewRobotError(
        f"links touch each other in each of {_STARTS} postures; correct the <collision> shapes "
        "of the URDF"
    )


def _goal(
    chain: Chain,
    touches: SelfCollisions,
    start: Array,
    random: np.random.Generator,
    reached: NDArray[np.bool_],
) -> tuple[Array, NDArray[np.bool_]]:
    """Return a posture with joints at limits where none has been yet, and which, shape (n, 2).

    From the start one joint after the other, in random order, is brought to a limit if the arm can
    still go there straight. Continuous joints, which have no position limits, turn by half a turn
    instead.
    """
    low = np.where(chain.continuous, start - np.pi, chain.q_min)
    high = np.where(chain.continuous, start + np.pi, chain.q_max)
    q, at = start, np.zeros_like(reached)
    for joint, side in random.permutation(np.argwhere(~reached)):
        there = q.copy()
        there[joint] = (low, high)[side][joint]
        if not at[joint].any() and _leads_straight(chain, touches, start, there):
            q, at[joint, side] = there, True
    return q, at


def _leads_straight(chain: Chain, touches: SelfCollisions, start: Array, q: Array) -> bool:
    """Return whether the motors can hold the arm on the straight way, and nothing touches."""
    way = [start + share * (q - start) for share in np.linspace(1.0, 0.0, _STEPS)[:-1]]
    held = all(_held(chain, each) <= _HELD_AT_GOAL for each in way)
    return held and not any(map(touches, way))


def _with_absolute_meshes(urdf: str, folder: Path | None) -> str:
    """Return the URDF with names of meshes that are relative to it made absolute."""
    root = ElementTree.fromstring(urdf)
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if folder is not None and "://" not in name and (folder / name).is_file():
            mesh.set("filename", str(folder / name))
    return ElementTree.tostring(root, encoding="unicode")
