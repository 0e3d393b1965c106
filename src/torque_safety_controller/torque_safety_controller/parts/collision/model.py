# SPDX-License-Identifier: Apache-2.0
"""Which shapes may collide: capsules around an arm's links, obstacles, and pairs of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.parts.collision.shapes import Shape
from viability_bounds_pkg.exceptions import SettingError, did_you_mean
from viability_bounds_pkg.robot.description import frame_id

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

AT_START, MOSTLY, ALWAYS = "collision_posture", "most postures", "all postures"
"""Where pairs are near each other that are not kept apart."""

CLEARANCE = 0.025
"""Distance of pairs that are left out as near each other, m: more than the margin to be kept."""

_MOSTLY = 0.5  # links that are near each other in more than this share of postures are left out
_POSTURES = 200  # from which it is told
_WHOLE, _ENDS = (0.0, 1.0), ((0.0, 0.0), (1.0, 1.0))  # shares of a segment


class Segments(NamedTuple):
    """Segments and boxes.

    Attributes:
        joint: that moves a segment, shape (s,), int; 0 for what does not move.
        ends: of the segments in the joint's axes, shape (s, 2, 3), m.
        radius: of the segments, shape (s,), m; written where a segment is the point of a box.
        boxes: centre, half the edges, and axes as rows, in the root frame, shape (b, 5, 3), m.
    """

    joint: Integers
    ends: Array
    radius: Array
    boxes: Array


class Candidates(NamedTuple):
    """Distances that may matter, pair by pair.

    Of two segments they are that of their closest points, and those of each end from the other
    segment; of a segment and a box those of the ends, that of the chord inside, and those of the
    edges. So the closest points may jump from one to the other, as they do between parallel
    segments: each of these distances is smooth there.

    Attributes:
        start: index of the first of each pair, shape (p + 1,), int.
        bodies: the segment that moves, the other segment, and the box that this is a point of or
            -1, shape (c, 3), int.
        share: which part of either segment counts: from and to, in shares of its length, shape
            (c, 4).
    """

    start: Integers
    bodies: Integers
    share: Array


@dataclass(frozen=True)
class CollisionModel:
    """Shapes of an arm and its surroundings, and the pairs to be kept apart.

    Attributes:
        arm: the arm's joints.
        shapes: capsules of links, then obstacles.
        frames: of the arm, that these are in, by index.
        segments: capsules, and what boxes consist of.
        candidates: distances of the pairs.
        moves: 1 for joints that move the first shape of a pair only, -1 the second only, shape
            (p, n).
        names: of the two shapes of each pair, ``link - link`` or ``link - obstacle``.
        left_out: pairs that are not kept apart, by where they are near each other: `AT_START`,
            `MOSTLY`; with obstacles `ALWAYS`, as what the arm is mounted on.
    """

    arm: pin.Model
    shapes: tuple[Shape, ...]
    frames: tuple[int, ...]
    segments: Segments
    candidates: Candidates
    moves: Array
    names: tuple[str, ...]
    left_out: dict[str, list[str]]

    def place(self) -> None:
        """Place segments and boxes as the frames of the arm are placed now."""
        ends, boxes = _placed(self.shapes, [self.arm.frames[k] for k in self.frames])
        self.segments.ends[:], self.segments.boxes[:] = ends, boxes


def build_collision_model(
    model: pin.Model,
    capsules: Sequence[Shape],
    q_start: ArrayLike,
    obstacles: Sequence[Shape] = (),
    base_frame: str | None = None,
) -> CollisionModel:
    """Return the collision model of an arm.

    Args:
        model: n joints with one coordinate each.
        capsules: around the links, whose names they have, in the links' frames.
        q_start: a configuration free of collisions, shape (n,), rad: pairs that are near each
            other there are left out.
        obstacles: that every link is kept away from which can move.
        base_frame: that obstacles are given in, fixed to the base; None: the URDF's root.

    Pairs that are nearer than `CLEARANCE` at the start, or in most of some random postures, are
    left out: their capsules, not the links, are in each other's way. So are obstacles that a link
    cannot get away from.

    Raises:
        SettingError: an unknown link; named as the node's parameter.
    """
    places = [_link_frame(model, shape.name) for shape in capsules]
    places += [frame_id(model, base_frame) if base_frame else 0] * len(obstacles)
    frames = [model.frames[k] for k in places]
    shapes = [*capsules, *obstacles]
    joints = [int(frame.parentJoint) for frame in frames]
    chosen = _link_pairs(model, joints[: len(capsules)])
    own = len(chosen)
    chosen += [
        (i, j)
        for j in range(len(capsules), len(shapes))
        for i in range(len(capsules))
        if joints[i] > 0
    ]
    geometry = pin.GeometryModel()
    for shape, frame in zip(shapes, frames, strict=True):
        geometry.addGeometryObject(shape.geometry(frame.parentJoint, frame.placement))
    for pair in chosen:
        geometry.addCollisionPair(pin.CollisionPair(*pair))
    low = np.where(np.isfinite(model.lowerPositionLimit), model.lowerPositionLimit, -np.pi)
    high = np.where(np.isfinite(model.upperPositionLimit), model.upperPositionLimit, np.pi)
    postures = np.random.default_rng(0).uniform(low, high, size=(_POSTURES, model.nq))
    near = _near(model, geometry, np.vstack([np.asarray(q_start), postures]))
    share = near[1:].mean(axis=0)
    kept: list[int] = []
    left_out: dict[str, list[str]] = {}
    names = [f"{shapes[i].name} - {shapes[j].name}" for i, j in chosen]
    for k, name in enumerate(names):
        if k < own and near[0, k]:
            left_out.setdefault(AT_START, []).append(name)
        elif k < own and share[k] > _MOSTLY:
            left_out.setdefault(MOSTLY, []).append(name)
        elif share[k] == 1.0:
            left_out.setdefault(ALWAYS, []).append(name)
        else:
            kept.append(k)
    moved = np.zeros((len(shapes), model.njoints))
    for row, joint in zip(moved, joints, strict=True):
        row[list(model.supports[joint])] = 1.0
    first, second = np.array([chosen[k] for k in kept], dtype=np.int64).reshape(-1, 2).T
    segments, candidates = _tables(shapes, frames, [chosen[k] for k in kept])
    return CollisionModel(
        arm=model,
        shapes=tuple(shapes),
        frames=tuple(places),
        segments=segments,
        candidates=candidates,
        moves=(moved[first] - moved[second])[:, 1:].copy(),
        names=tuple(names[k] for k in kept),
        left_out=left_out,
    )


def _link_frame(model: pin.Model, link: str) -> int:
    if model.existFrame(link, pin.FrameType.BODY):
        return int(model.getFrameId(link, pin.FrameType.BODY))
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    raise SettingError("collision_capsules", link, f"links of the URDF{did_you_mean(link, links)}")


def _link_pairs(model: pin.Model, joints: Sequence[int]) -> list[tuple[int, int]]:
    """Return the pairs of the arm's capsules, on `joints`, that are not neighbours."""
    parents = model.parents
    return [
        (i, j)
        for i in range(len(joints))
        for j in range(i)
        if joints[j] not in (joints[i], parents[joints[i]]) and joints[i] != parents[joints[j]]
    ]


def _near(model: pin.Model, geometry: pin.GeometryModel, postures: Array) -> NDArray[np.bool_]:
    """Return which pairs are nearer than `CLEARANCE` in each posture, by coal, shape (k, p)."""
    data, found = model.createData(), geometry.createData()
    near = np.zeros((len(postures), len(geometry.collisionPairs)), dtype=bool)
    for row, q in zip(near, postures, strict=True):
        pin.computeDistances(model, data, geometry, found, q)
        row[:] = [result.min_distance < CLEARANCE for result in found.distanceResults]
    return near


def _tables(
    shapes: Sequence[Shape], frames: Sequence[pin.Frame], pairs: Sequence[tuple[int, int]]
) -> tuple[Segments, Candidates]:
    """Return segments, one for each shape and then those of edges, and the distances of pairs."""
    joint = [int(frame.parentJoint) for frame in frames]
    ends, boxes = _placed(shapes, frames)
    radius = [shape.radius for shape in shapes]
    box_of: dict[int, int] = {}
    edges_of = {}
    for index, shape in enumerate(shapes):
        if shape.is_box:
            count = len(shape.edges(frames[index].placement))
            box_of[index] = len(box_of)
            edges_of[index] = range(len(joint), len(joint) + count)
            joint += [0] * count
            radius += [0.0] * count
    start, bodies, share = [0], [], []
    for i, j in pairs:
        length, other_length = shapes[i].half[2], shapes[j].half[2]
        if j in box_of:
            chord = [_WHOLE] if length and edges_of[j] else []
            own = [*(_ENDS if length else _ENDS[:1]), *chord]
            bodies += [(i, j, box_of[j])] * len(own)
            share += [(*part, *_WHOLE) for part in own]
            if length:
                bodies += [(i, edge, -1) for edge in edges_of[j]]
                share += [(*_WHOLE, *_WHOLE)] * len(edges_of[j])
        else:
            found = [(*_WHOLE, *_WHOLE)]
            found += [(*end, *_WHOLE) for end in _ENDS if length]
            found += [(*_WHOLE, *end) for end in _ENDS if other_length]
            bodies += [(i, j, -1)] * len(found)
            share += found
        start.append(len(bodies))
    return Segments(
        joint=np.array(joint, dtype=np.int64),
        ends=ends,
        radius=np.array(radius),
        boxes=boxes,
    ), Candidates(
        start=np.array(start, dtype=np.int64),
        bodies=np.array(bodies, dtype=np.int64).reshape(-1, 3),
        share=np.array(share).reshape(-1, 4),
    )


def _placed(shapes: Sequence[Shape], frames: Sequence[pin.Frame]) -> tuple[Array, Array]:
    """Return ends of segments, those of the shapes and then of edges, and boxes, as `Segments`."""
    places = [frame.placement for frame in frames]
    ends = [shape.ends(place) for shape, place in zip(shapes, places, strict=True)]
    boxes: list[list[Array]] = []
    for shape, place in zip(shapes, places, strict=True):
        if shape.is_box:
            middle = place * shape.placement
            boxes.append([middle.translation, shape.half, *middle.rotation.T])
            ends += list(shape.edges(place))
    return np.array(ends).reshape(-1, 2, 3), np.array(boxes).reshape(-1, 5, 3)
