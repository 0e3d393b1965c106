"""Where the joints of an arm are and how they move, compiled.

Pinocchio computes the same, but to read ten placements and velocities out of it through Python
takes longer than everything the collision avoidance computes.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.collision.vectors3 import (
    along,
    at,
    compiled,
    cross,
    dot,
    sub,
    turned,
)

Array = NDArray[np.float64]


class Chain(NamedTuple):
    """Constants of n joints; joint 0 is the base.

    Attributes:
        parent: shape (n + 1,), int.
        rotation: of the joint's axes in the parent's at zero, shape (n + 1, 3, 3).
        offset: its origin there, shape (n + 1, 3), m.
        axis: unit vector in the joint's axes, shape (n + 1, 3).
        slides: whether it is prismatic, shape (n + 1,), bool.
        moved_by: whether a joint moves with joint k + 1, shape (n + 1, n), bool.
    """

    parent: NDArray[np.int64]
    rotation: Array
    offset: Array
    axis: Array
    slides: NDArray[np.bool_]
    moved_by: NDArray[np.bool_]


class Motion(NamedTuple):
    """Motion of the joints in the base frame; arrays of shape (n + 1, 3) but the first.

    Attributes:
        rotation: shape (n + 1, 3, 3).
        origin: m.
        axis: unit vectors.
        turning: angular velocity, rad/s.
        velocity: of the origin, m/s.
        turning_bias: angular acceleration at zero joint acceleration, rad/s^2.
        bias: acceleration of the origin at zero joint acceleration, m/s^2.
    """

    rotation: Array
    origin: Array
    axis: Array
    turning: Array
    velocity: Array
    turning_bias: Array
    bias: Array


def make_chain(model: pin.Model) -> Chain:
    """Return the constants of a model whose joints have one degree of freedom each.

    Raises:
        ValueError: a joint that neither turns nor slides alone.
    """
    count = model.njoints
    data = model.createData()
    pin.computeJointJacobians(model, data, np.zeros(model.nq))
    axis, slides = np.zeros((count, 3)), np.zeros(count, dtype=bool)
    moved_by = np.zeros((count, model.nv), dtype=bool)
    for i in range(1, count):
        column = pin.getJointJacobian(model, data, i, pin.LOCAL)[:, model.joints[i].idx_v]
        slides[i] = not column[3:].any()
        axis[i] = column[:3] if slides[i] else column[3:]
        if not slides[i] and column[:3].any():
            raise ValueError(f"joint {model.names[i]!r} neither turns nor slides alone")
        moved_by[i] = moved_by[model.parents[i]]
        moved_by[i, i - 1] = True
    return Chain(
        np.array(list(model.parents), dtype=np.int64),
        np.array([placement.rotation for placement in model.jointPlacements]),
        np.array([placement.translation for placement in model.jointPlacements]),
        axis,
        slides,
        moved_by,
    )


def make_motion(chain: Chain) -> Motion:
    """Return arrays for `move` to fill in."""
    count = len(chain.parent)
    motion = Motion(np.zeros((count, 3, 3)), *(np.zeros((count, 3)) for _ in range(6)))
    motion.rotation[0] = np.eye(3)
    return motion


@compiled
def _set(A, i, x):
    A[i, 0], A[i, 1], A[i, 2] = x


@compiled
def move(q, v, chain, motion):
    """Compute `motion` at a state, in place.

    Args:
        q: shape (n,), rad or m.
        v: shape (n,), rad/s or m/s.
        chain: of `make_chain`.
        motion: of `make_motion`.
    """
    for i in range(1, len(chain.parent)):
        p, angle, rate = chain.parent[i], q[i - 1], v[i - 1]
        R, P, local = motion.rotation[i], motion.rotation[p], chain.rotation[i]
        for k in range(3):
            for m in range(3):
                R[k, m] = P[k, 0] * local[0, m] + P[k, 1] * local[1, m] + P[k, 2] * local[2, m]
        axis = at(chain.axis, i)
        z = turned(R, axis)
        lever = turned(P, at(chain.offset, i))
        turning, turning_bias = at(motion.turning, p), at(motion.turning_bias, p)
        if chain.slides[i]:
            lever = along(lever, angle, z)
        velocity = along(at(motion.velocity, p), 1.0, cross(turning, lever))
        bias = along(at(motion.bias, p), 1.0, cross(turning_bias, lever))
        bias = along(bias, 1.0, cross(turning, cross(turning, lever)))
        across = cross(turning, z)
        if chain.slides[i]:
            velocity = along(velocity, rate, z)
            bias = along(bias, 2.0 * rate, across)
        else:
            turning = along(turning, rate, z)
            turning_bias = along(turning_bias, rate, across)
            _turn(R, axis, cos(angle), sin(angle))
        _set(motion.origin, i, along(at(motion.origin, p), 1.0, lever))
        _set(motion.axis, i, z)
        _set(motion.turning, i, turning)
        _set(motion.velocity, i, velocity)
        _set(motion.turning_bias, i, turning_bias)
        _set(motion.bias, i, bias)


@compiled
def _turn(R, axis, c, s):
    """Replace R by R times the rotation about `axis`, row by row: Rodrigues' formula."""
    for k in range(3):
        row = at(R, k)
        side = cross(row, axis)
        share = (1.0 - c) * dot(row, axis)
        _set(R, k, along((c * row[0] + s * side[0], c * row[1] + s * side[1],
                          c * row[2] + s * side[2]), share, axis))  # fmt: skip


@compiled
def place(motion, i, local):
    """Return a point of joint `i`, given in its axes, in the base frame."""
    return along(at(motion.origin, i), 1.0, turned(motion.rotation[i], local))


@compiled
def point_motion(motion, i, point):
    """Return velocity and acceleration at zero joint acceleration of a point fixed to joint i."""
    lever = sub(point, at(motion.origin, i))
    turning = at(motion.turning, i)
    swing = cross(turning, lever)
    bias = along(at(motion.bias, i), 1.0, cross(at(motion.turning_bias, i), lever))
    return along(at(motion.velocity, i), 1.0, swing), along(bias, 1.0, cross(turning, swing))
