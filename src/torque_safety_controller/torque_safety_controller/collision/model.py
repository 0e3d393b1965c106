# SPDX-License-Identifier: Apache-2.0
"""What may collide with what: capsules around an arm's links, obstacles, and pairs of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.collision.bodies import CollisionBody, capsule
from torque_safety_controller.collision.capsule_fit import Capsule, capsules_around
from torque_safety_controller.collision.distances import Pairs, pair_distances
from torque_safety_controller.collision.geometry import link_shapes
from torque_safety_controller.collision.motion import Bodies, Kinematics
from viability_bounds_pkg.compiled import bound
from viability_bounds_pkg.exceptions import SettingError, did_you_mean

Array = NDArray[np.float64]

_MOSTLY = 0.5  # pairs that are near each other in more than this share of the samples are left out


@dataclass(frozen=True)
class CollisionModel:
    """Shapes of an arm and its surroundings, and the pairs to be kept apart.

    Attributes:
        arm: the arm's joints.
        bodies: all shapes.
        pairs: of them.
        names: of the two bodies of each pair, ``link - link`` or ``link - obstacle``.
        capsules: of each link, in the axes of the joint that moves it.
        left_out: pairs that were pruned, by reason: ``far``, ``near at start``,
            ``near mostly``; with obstacles ``near always``, as what the arm is mounted on.
    """

    arm: pin.Model
    bodies: Bodies
    pairs: Pairs
    names: tuple[str, ...]
    capsules: dict[str, list[Capsule]]
    left_out: dict[str, list[str]]


def build_collision_model(
    model: pin.Model,
    geometry: pin.GeometryModel,
    q_start: ArrayLike,
    obstacles: Sequence[CollisionBody] = (),
    pairs: Sequence[tuple[str, str]] | None = None,
    base_frame: str | None = None,
    near: float = 0.05,
    clearance: float = 0.025,
    samples: int = 20_000,
) -> CollisionModel:
    """Return the collision model of an arm.

    Args:
        model: n joints with one coordinate each.
        geometry: of `robot_description.load_geometry`.
        q_start: a configuration free of collisions, shape (n,), rad: of the pairs chosen
            automatically, those that are near each other there are left out.
        obstacles: that every link is kept away from which can move.
        pairs: of links to be kept apart; None chooses them automatically: all that are not
            neighbours, less those left out by the next three.
        base_frame: that obstacles are given in; None: the URDF's root. Fixed to the base.
        near: pairs that never come nearer than this are left out, m.
        clearance: pairs that are nearer than this at the start, or in most samples, are left
            out, m: more than the margin to be kept. Their capsules, not the links, are in each
            other's way. So are obstacles that a link cannot get away from.
        samples: random configurations within the position limits; +-pi where there are none.

    Raises:
        SettingError: an unknown link, a frame that moves, names that are not different, a
            start of the wrong size, or nothing to keep apart in a pair asked for; named as the
            node's parameters.
    """
    q_start = np.asarray(q_start, dtype=np.float64)
    if q_start.shape != (model.nq,) or not np.isfinite(q_start).all():
        raise SettingError("collision_posture", q_start, f"{model.nq} finite numbers")
    capsules: dict[str, list[Capsule]] = {}
    links: list[CollisionBody] = []
    for shape in link_shapes(model, geometry):
        around = shape.capsules + capsules_around(shape.vertices, shape.triangles)
        capsules[shape.link] = around
        links += [replace(capsule(shape.link, *each), joint=shape.joint) for each in around]
    for index, obstacle in enumerate(obstacles):
        if obstacle.name in capsules or obstacle.name in (o.name for o in obstacles[:index]):
            allowed = "what no other obstacle and no link is called"
            raise SettingError("obstacle_names", obstacle.name, allowed)
    base = _base_placement(model, base_frame)
    every = links + [replace(body, placement=base * body.placement) for body in obstacles]
    chosen = _link_pairs(model, links, pairs)
    own = len(chosen)
    chosen += [
        (i, j)
        for j in range(len(links), len(every))
        for i, body in enumerate(links)
        if body.joint > 0
    ]
    bodies = _pack(every)
    candidates = _pairs(model, every, chosen)
    at_start, _ = _survey(model, bodies, candidates, near, clearance, q_start[None])
    low = np.where(np.isfinite(model.lowerPositionLimit), model.lowerPositionLimit, -np.pi)
    high = np.where(np.isfinite(model.upperPositionLimit), model.upperPositionLimit, np.pi)
    q = np.random.default_rng(0).uniform(low, high, size=(samples, model.nq))
    short, least = _survey(model, bodies, candidates, near, clearance, q)
    kept, names = [], []
    left_out: dict[str, list[str]] = {}
    for k, (i, j) in enumerate(chosen):
        name, reason = f"{every[i].name} - {every[j].name}", ""
        if k >= own and short[k] == samples:
            reason = "near always"
        elif k < own and pairs is None and at_start[k]:
            reason = "near at start"
        elif k < own and pairs is None and short[k] > _MOSTLY * samples:
            reason = "near mostly"
        if least[k] > near and (k >= own or pairs is None):
            reason = "far"
        if reason:
            left_out.setdefault(reason, []).append(name)
        else:
            kept.append(k)
            names.append(name)
    remaining = Pairs._make(array[kept] for array in candidates)
    return CollisionModel(model, bodies, remaining, tuple(names), capsules, left_out)


def _pack(bodies: Sequence[CollisionBody]) -> Bodies:
    """Return bodies as arrays, with their parts."""
    parts = [_parts(body) for body in bodies]
    flat = np.array([part for each in parts for part in each]).reshape(-1, 2, 3)
    return Bodies(
        joint=np.array([body.joint for body in bodies], dtype=np.int64),
        rotation=np.array([body.placement.rotation for body in bodies]).reshape(-1, 3, 3),
        centre=np.array([body.placement.translation for body in bodies]).reshape(-1, 3),
        radius=np.array([body.radius for body in bodies]),
        plane=np.array([body.plane for body in bodies], dtype=bool),
        first=np.cumsum([0, *map(len, parts)]),
        offset=flat[:, 0].copy(),
        half=flat[:, 1].copy(),
    )


def _parts(body: CollisionBody) -> list[tuple[Array, Array]]:
    """Return middle and half lengths of a body, and of the ends or edges that count apart."""
    half, point = body.half, np.zeros(3)
    parts = [(point, half)]
    if body.plane or not half.any():
        return parts
    if not half.all():  # a segment
        return [*parts, (-half, point), (half, point)]
    for axis, signs in product(np.eye(3), product((-1.0, 1.0), repeat=2)):
        corner = np.zeros(3)
        corner[axis == 0.0] = signs
        parts.append((corner * half, axis * half))
    return parts


def _pairs(
    model: pin.Model, bodies: Sequence[CollisionBody], chosen: Sequence[tuple[int, int]]
) -> Pairs:
    """Return pairs as arrays."""
    moved_by = np.zeros((len(bodies), model.njoints))
    for row, body in zip(moved_by, bodies, strict=True):
        row[list(model.supports[body.joint])] = 1.0
    first, second = np.array(chosen, dtype=np.int64).reshape(-1, 2).T.copy()
    return Pairs(first, second, (moved_by[first] - moved_by[second])[:, 1:].copy())


def _base_placement(model: pin.Model, base_frame: str | None) -> pin.SE3:
    if base_frame is None:
        return pin.SE3.Identity()
    if not model.existFrame(base_frame):
        raise SettingError("base_frame", base_frame, "a frame of the URDF")
    frame = model.frames[model.getFrameId(base_frame)]
    if frame.parentJoint != 0:
        raise SettingError("base_frame", base_frame, "a frame that is not moved by a joint")
    return frame.placement


def _link_pairs(
    model: pin.Model,
    links: Sequence[CollisionBody],
    pairs: Sequence[tuple[str, str]] | None,
) -> list[tuple[int, int]]:
    """Return the pairs of capsules of the links asked for, or of all that are not neighbours."""
    joint_of = {body.name: body.joint for body in links}
    for pair in pairs or ():
        for link in pair:
            if link not in joint_of:
                allowed = f"links with collision geometry: {', '.join(sorted(joint_of))}"
                allowed += did_you_mean(link, joint_of)
                raise SettingError("collision_pairs", link, allowed)
        if len(pair) != 2 or joint_of[pair[0]] == joint_of[pair[1]]:
            raise SettingError("collision_pairs", pair, "two links that move to each other")
    wanted = None if pairs is None else {frozenset(pair) for pair in pairs}
    chosen = []
    for i, first in enumerate(links):
        for j, second in enumerate(links[:i]):
            if wanted is not None:
                apart = frozenset((first.name, second.name)) in wanted
            else:
                apart = second.joint not in (first.joint, model.parents[first.joint])
                apart = apart and first.joint != model.parents[second.joint]
            if apart:
                chosen.append((i, j))
    return chosen


def _survey(
    model: pin.Model, bodies: Bodies, pairs: Pairs, near: float, clearance: float, samples: Array
) -> tuple[NDArray[np.int64], Array]:
    """Return in how many samples each pair is nearer than `clearance`, and its least distance."""
    kinematics, zero = Kinematics(model, len(bodies.joint)), np.zeros(model.nv)
    found = np.zeros(len(pairs.first))
    measure = bound(pair_distances, float(near), pairs, bodies, kinematics.motion, found)
    short, least = np.zeros(len(found), dtype=np.int64), np.full(len(found), np.inf)
    for q in samples:
        kinematics.update(q, zero)
        measure()
        short += found < clearance
        np.minimum(least, found, out=least)
    return short, least
