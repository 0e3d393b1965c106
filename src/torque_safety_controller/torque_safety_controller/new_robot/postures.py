# SPDX-License-Identifier: Apache-2.0
"""Postures of a new robot: where it starts, and where a first scenario drives it to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.new_robot.chain import Chain, NewRobotError
from viability_bounds_pkg.robot.description import frame_id

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

    Neighbours, which touch at their joint, are left out, and pairs of shapes that overlap nearly
    anywhere, as those of a wrist often do.

    Args:
        chain: the arm.
        geometry: collision shapes of its links; perhaps none.

    Attributes:
        pairs: how many pairs of shapes are checked.
    """

    def __init__(self, chain: Chain, geometry: pin.GeometryModel) -> None:
        self._model, self._data = chain.model, chain.model.createData()
        self._geometry = geometry
        parents = list(chain.model.parents)
        joints = [shape.parentJoint for shape in geometry.geometryObjects]
        moving = [
            pin.CollisionPair(i, j)
            for i, j in combinations(range(len(joints)), 2)
            if joints[i] != joints[j]
            and joints[i] != parents[joints[j]]
            and joints[j] != parents[joints[i]]
        ]
        self._check(moving)
        random = np.random.default_rng(_SEED)
        postures = _middle_postures(chain, random.random((40, len(chain.joints))))
        touching = np.zeros(len(moving))
        for q in postures:
            self._collide(q, stop_at_first=False)
            touching += [each.isCollision() for each in self._found.collisionResults]
        often = _ALWAYS * len(postures)
        self._check([pair for pair, n in zip(moving, touching, strict=True) if n < often])
        self.pairs = len(geometry.collisionPairs)

    def __call__(self, q: Array) -> bool:
        """Return whether anything touches in a posture, shape (n,), rad."""
        return self.pairs > 0 and self._collide(q, stop_at_first=True)

    def _check(self, pairs: Sequence[pin.CollisionPair]) -> None:
        self._geometry.removeAllCollisionPairs()
        for pair in pairs:
            self._geometry.addCollisionPair(pair)
        self._found = self._geometry.createData()

    def _collide(self, q: Array, stop_at_first: bool) -> bool:
        geometry, found = self._geometry, self._found
        return bool(
            pin.computeCollisions(self._model, self._data, geometry, found, q, stop_at_first)
        )


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


def _middle_postures(chain: Chain, unit: Array) -> Array:
    """Return postures in the middle of the ranges by numbers from 0 to 1, shape (k, n).

    Continuous joints, and those of wider ranges, are kept within a turn.
    """
    low, high = np.maximum(chain.q_min, -1e3), np.minimum(chain.q_max, 1e3)
    middle = np.where(chain.continuous, 0.0, 0.5 * (low + high))
    half = np.minimum(0.5 * (high - low), np.pi)
    return np.asarray(middle + _MIDDLE * (2.0 * unit - 1.0) * half)


def _held(chain: Chain, q: Array) -> float:
    """Return the largest share of a torque limit that holds the arm in a posture."""
    gravity = pin.computeGeneralizedGravity(chain.model, chain.model.createData(), q)
    return float(np.max(np.abs(gravity) / chain.tau_max))


def _start(chain: Chain, touches: SelfCollisions, random: np.random.Generator) -> Array:
    """Return the posture with the best mix of bent joints, middle of ranges and little torque."""
    data, frame = chain.model.createData(), frame_id(chain.model, chain.tips[0])
    unit = random.random((_STARTS, len(chain.joints)))
    ranked = []
    for q, part in zip(_middle_postures(chain, unit), unit, strict=True):
        held = _held(chain, q)
        J = pin.computeFrameJacobian(chain.model, data, q, frame)
        # A hand that can move in all directions: its least singular value.
        agile = np.linalg.svd(J, compute_uv=False).min()
        off_middle = _MIDDLE * float(np.mean(np.abs(part - 0.5)))
        ranked.append((held + off_middle - 2.0 * min(agile, 0.2), held, q))
    for _, held, q in sorted(ranked, key=lambda each: each[0]):
        if held <= _HELD_AT_START and not touches(q):
            return np.round(q, 3)
    least = min(ranked, key=lambda each: each[1])
    if least[1] > _HELD_AT_START:
        gravity = pin.computeGeneralizedGravity(chain.model, data, least[2])
        joint = chain.joints[int(np.argmax(np.abs(gravity) / chain.tau_max))]
        raise NewRobotError(
            f"joint '{joint}': to hold the arm takes at least {least[1]:.0%} of its effort limit "
            f"in {_STARTS} postures; is that what the motor can do? If so, --base with the link "
            "behind it leaves it out"
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
