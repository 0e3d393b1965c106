"""What may collide with what: capsules around an arm's links, obstacles, and pairs of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from torque_safety_controller.collision.capsule_fit import Capsule, capsules_around
from torque_safety_controller.collision.geometry import link_shapes
from torque_safety_controller.collision.kernels import (
    BOX,
    CAPSULES,
    HALF_SPACE,
    Bodies,
    Pairs,
    distance_of,
    place_capsules,
)
from torque_safety_controller.collision.kinematics import Chain, make_chain, make_motion, move
from torque_safety_controller.collision.obstacles import CollisionError, Obstacle
from torque_safety_controller.collision.row import make_rows
from viability_bounds_pkg.compiled import compiled


@dataclass(frozen=True)
class Pruning:
    """How pairs are chosen automatically.

    Attributes:
        samples: random configurations within the position limits; +-pi where there are none.
        seed: of them.
        near: pairs that never come nearer than this are left out, m.
        clearance: pairs that are nearer than this at the start are left out, m: more than the
            margin to be kept. Their capsules, not the links, are in each other's way.
        always: so are pairs that are nearer in more than this share of the samples.
    """

    samples: int = 20_000
    seed: int = 0
    near: float = 0.05
    clearance: float = 0.025
    always: float = 0.5


@dataclass(frozen=True)
class CollisionModel:
    """Shapes of an arm and its surroundings, and the pairs to be kept apart.

    Attributes:
        chain: the arm's joints.
        bodies: all shapes.
        pairs: of them.
        names: of the two bodies of each pair, ``link - link`` or ``link - obstacle``.
        capsules: of each link, in the axes of the joint that moves it.
        left_out: pairs that were pruned, by reason: ``far``, ``near at start``,
            ``near mostly``; with obstacles ``near always``, as what the arm is mounted on.
    """

    chain: Chain
    bodies: Bodies
    pairs: Pairs
    names: tuple[str, ...]
    capsules: dict[str, list[Capsule]]
    left_out: dict[str, list[str]] = field(default_factory=dict)


def build_collision_model(
    model: pin.Model,
    geometry: pin.GeometryModel,
    q_start: ArrayLike,
    obstacles: Sequence[Obstacle] = (),
    pairs: Sequence[tuple[str, str]] | None = None,
    base_frame: str | None = None,
    capsules_per_link: int = 3,
    pruning: Pruning | None = None,
) -> CollisionModel:
    """Return the collision model of an arm.

    Args:
        model: n joints with one coordinate each.
        geometry: of `collision_geometry.load_geometry`.
        q_start: a configuration free of collisions, shape (n,), rad: of the pairs chosen
            automatically, those that are near each other there are left out.
        obstacles: that every link is kept away from which can move.
        pairs: of links to be kept apart; None chooses them automatically: all that are not
            neighbours, less those that `pruning` leaves out.
        base_frame: that obstacles are given in; None: the URDF's root. Fixed to the base.
        capsules_per_link: at most.
        pruning: of the pairs; it also leaves out obstacles that a link cannot come near, or
            cannot get away from.

    Raises:
        CollisionError: an unknown link, a frame that moves, names that are not different, a
            start of the wrong size, or nothing to keep apart in a pair asked for.
    """
    pruning = pruning or Pruning()
    q_start = np.asarray(q_start, dtype=float)
    if q_start.shape != (model.nq,) or not np.isfinite(q_start).all():
        raise CollisionError("q_start", q_start, f"{model.nq} finite numbers")
    owners, joints, capsules = [], [], []
    for shape in link_shapes(model, geometry):
        around = list(shape.capsules)
        if len(shape.triangles):
            around += capsules_around(shape.vertices, shape.triangles, capsules_per_link)
        owners += [shape.link] * len(around)
        joints += [shape.joint] * len(around)
        capsules += around
    links = set(owners)
    _check_names(links, obstacles)
    placement = _base_placement(model, base_frame)
    of_links = len(capsules)
    boxes, planes, standing = [], [], []
    for obstacle in obstacles:
        place = placement * obstacle.placement
        if obstacle.kind == "capsule":
            half = obstacle.size[0] * place.rotation[:, 2]
            centre = place.translation
            standing.append((CAPSULES, len(capsules), obstacle.name))
            capsules.append(Capsule(centre - half, centre + half, float(obstacle.size[1])))
            joints.append(0)
        elif obstacle.kind == "box":
            standing.append((BOX, len(boxes), obstacle.name))
            boxes.append((place, obstacle.size))
        else:
            standing.append((HALF_SPACE, len(planes), obstacle.name))
            planes.append(place)
    bodies = Bodies(
        np.array(joints, dtype=np.int64),
        np.array([c.start for c in capsules]).reshape(-1, 3),
        np.array([c.end - c.start for c in capsules]).reshape(-1, 3),
        np.array([c.radius for c in capsules]),
        np.array([p.rotation for p, _ in boxes]).reshape(-1, 3, 3),
        np.array([p.translation for p, _ in boxes]).reshape(-1, 3),
        np.array([half for _, half in boxes]).reshape(-1, 3),
        np.array([p.rotation[:, 2] for p in planes]).reshape(-1, 3),
        np.array([p.rotation[:, 2] @ p.translation for p in planes]),
    )
    chain = make_chain(model)
    candidates = _link_pairs(owners, joints, chain, pairs)
    own = len(candidates)
    for kind, j, name in standing:
        for i in range(of_links):
            if joints[i] > 0:
                candidates.append((kind, i, j, f"{owners[i]} - {name}"))
    kept, left_out = _prune(model, chain, bodies, candidates, own, pairs is None, q_start, pruning)
    table = np.array([c[:3] for c in kept], dtype=np.int64).reshape(-1, 3).T
    by_link: dict[str, list[Capsule]] = {}
    for owner, capsule in zip(owners, capsules, strict=False):  # obstacles come last
        by_link.setdefault(owner, []).append(capsule)
    return CollisionModel(
        chain,
        bodies,
        Pairs(*(np.ascontiguousarray(row) for row in table)),
        tuple(c[3] for c in kept),
        by_link,
        left_out,
    )


def _check_names(links: set[str], obstacles: Sequence[Obstacle]) -> None:
    names = [obstacle.name for obstacle in obstacles]
    for name in names:
        if names.count(name) > 1 or name in links:
            raise CollisionError("name", name, "what no other obstacle and no link is called")


def _base_placement(model: pin.Model, base_frame: str | None) -> pin.SE3:
    if base_frame is None:
        return pin.SE3.Identity()
    if not model.existFrame(base_frame):
        raise CollisionError("base_frame", base_frame, "a frame of the URDF")
    frame = model.frames[model.getFrameId(base_frame)]
    if frame.parentJoint != 0:
        raise CollisionError("base_frame", base_frame, "a frame that is not moved by a joint")
    return frame.placement


def _link_pairs(owners, joints, chain, pairs) -> list[tuple[int, int, int, str]]:
    """Return the pairs of capsules of the links asked for, or of all that are not neighbours."""
    wanted = None if pairs is None else _checked_pairs(pairs, owners, joints)
    candidates = []
    for i in range(len(owners)):
        for j in range(i):
            first, second = joints[i], joints[j]
            if first == second:
                continue
            if wanted is None:
                if second == chain.parent[first] or first == chain.parent[second]:
                    continue
            elif frozenset((owners[i], owners[j])) not in wanted:
                continue
            candidates.append((CAPSULES, i, j, f"{owners[i]} - {owners[j]}"))
    return candidates


def _checked_pairs(pairs, owners, joints) -> set[frozenset[str]]:
    joint_of = dict(zip(owners, joints, strict=False))
    for pair in pairs:
        if len(pair) != 2:
            raise CollisionError("pairs", pair, "two links")
        for link in pair:
            if link not in joint_of:
                known = ", ".join(sorted(joint_of))
                raise CollisionError("pairs", link, f"links with collision geometry: {known}")
        if joint_of[pair[0]] == joint_of[pair[1]]:
            raise CollisionError("pairs", pair, "links that move to each other")
    return {frozenset(pair) for pair in pairs}


def _prune(model, chain, bodies, candidates, own, automatic, q_start, pruning):
    """Return the candidates to keep and the names of the others by reason."""
    rng = np.random.default_rng(pruning.seed)
    low = np.where(np.isfinite(model.lowerPositionLimit), model.lowerPositionLimit, -np.pi)
    high = np.where(np.isfinite(model.upperPositionLimit), model.upperPositionLimit, np.pi)
    samples = rng.uniform(low, high, size=(pruning.samples, model.nq))
    table = np.array([c[:3] for c in candidates], dtype=np.int64).reshape(-1, 3)
    motion = make_motion(chain)
    rows = make_rows(0, model.nv, 0, len(bodies.joint))
    least = pruning.clearance
    nearest, often = _survey(samples, least, table, chain, motion, bodies, rows)
    at_start, _ = _survey(q_start[None], least, table, chain, motion, bodies, rows)
    kept, left_out = [], {}
    for k, candidate in enumerate(candidates):
        reason = ""
        if nearest[k] > pruning.near:
            reason = "far"
        elif k >= own and often[k] == pruning.samples:
            reason = "near always"
        elif automatic and k < own:
            if at_start[k] < least:
                reason = "near at start"
            elif often[k] > pruning.always * pruning.samples:
                reason = "near mostly"
        if reason and (automatic or k >= own):
            left_out.setdefault(reason, []).append(candidate[3])
        else:
            kept.append(candidate)
    return kept, left_out


@compiled
def _survey(samples, clearance, table, chain, motion, bodies, rows):
    """Return each pair's least distance over configurations, and how often it is short."""
    least = np.full(len(table), np.inf)
    short = np.zeros(len(table), dtype=np.int64)
    still = np.zeros(samples.shape[1])
    for m in range(len(samples)):
        move(samples[m], still, chain, motion)
        place_capsules(motion, bodies, rows)
        for k in range(len(table)):
            d = distance_of(table[k, 0], table[k, 1], table[k, 2], bodies, rows)
            least[k] = min(least[k], d)
            short[k] += d < clearance
    return least, short
