# SPDX-License-Identifier: Apache-2.0
"""Placements and velocities of joints and bodies, as arrays for compiled functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.collision.vectors3 import (
    Vector,
    along,
    at,
    column,
    compiled_vectors,
    cross,
    times,
)

Array = NDArray[np.float64]


class Bodies(NamedTuple):
    """Boxes with rounded edges, and their parts: first the whole, then its edges or ends.

    Attributes:
        joint: that moves the body, shape (b,), int; 0 for what does not move.
        rotation: of the box in the joint's axes, shape (b, 3, 3).
        centre: of the box there, shape (b, 3), m.
        radius: of the rounding, shape (b,), m.
        plane: whether only the distances of the other body's ends count, shape (b,), bool.
        first: index of the first of its parts, shape (b + 1,), int.
        offset: of a part in the axes of the box, shape (m, 3), m.
        half: half the lengths of a part, shape (m, 3), m.
    """

    joint: NDArray[np.int64]
    rotation: Array
    centre: Array
    radius: Array
    plane: NDArray[np.bool_]
    first: NDArray[np.int64]
    offset: Array
    half: Array


class ArmMotion(NamedTuple):
    """Where bodies are, and how joints move; all in the root frame, joint 0 is the root.

    Spatial velocities are about the root's origin: linear, then angular.

    Attributes:
        parent: of each joint, shape (n + 1,), int.
        placements: of the joints: the rows of the rotation, then the origin, m, shape
            (n + 1, 4, 3).
        J: spatial velocity of each joint for a unit joint velocity, shape (n, 2, 3).
        dJ: its time derivative, shape (n, 2, 3).
        velocity: spatial velocities of the joints, shape (n + 1, 2, 3), m/s and rad/s.
        bias: their rates at zero joint acceleration, shape (n + 1, 2, 3).
        rotation: of the bodies, shape (b, 3, 3).
        centre: of the bodies, shape (b, 3), m.
    """

    parent: NDArray[np.int64]
    placements: Array
    J: Array
    dJ: Array
    velocity: Array
    bias: Array
    rotation: Array
    centre: Array


class Kinematics:
    """Joint placements, Jacobian and its rate at one state, by Pinocchio.

    Args:
        model: n joints with one coordinate each.
        bodies: how many bodies the joints move.

    Attributes:
        motion: placements, J and dJ are computed here, the rest by compiled functions.
    """

    def __init__(self, model: pin.Model, bodies: int) -> None:
        self._model, self._data = model, model.createData()
        data, joints = self._data, model.njoints
        self.motion = ArmMotion(
            parent=np.array(list(model.parents), dtype=np.int64),
            placements=np.zeros((joints, 4, 3)),
            J=data.J.T.reshape(-1, 2, 3),  # views of Pinocchio's memory, like the two below
            dJ=data.dJ.T.reshape(-1, 2, 3),
            velocity=np.zeros((joints, 2, 3)),
            bias=np.zeros((joints, 2, 3)),
            rotation=np.zeros((bodies, 3, 3)),
            centre=np.zeros((bodies, 3)),
        )
        self._rows = self.motion.placements.reshape(-1, 3)
        # To read each placement anew takes ten times as long.
        self._views = [
            view
            for i in range(joints)
            for view in (data.oMi[i].rotation, data.oMi[i].translation[None])
        ]

    def update(self, q: Array, v: Array) -> None:
        """Compute the joints' part of `motion` at positions and velocities of shape (n,)."""
        pin.computeJointJacobiansTimeVariation(self._model, self._data, q, v)
        np.concatenate(self._views, out=self._rows)


@compiled_vectors
def place_bodies(bodies: Bodies, motion: ArmMotion) -> None:
    """Compute where the bodies are."""
    for i in range(len(bodies.joint)):
        placement = motion.placements[bodies.joint[i]]
        rotation, centre = motion.rotation[i], motion.centre[i]
        for k in range(3):
            turned = times(placement, column(bodies.rotation[i], k))
            rotation[0, k], rotation[1, k], rotation[2, k] = turned
        offset = times(placement, at(bodies.centre, i))
        centre[0], centre[1], centre[2] = along(at(placement, 3), 1.0, offset)


@compiled_vectors
def move_joints(v: Array, motion: ArmMotion) -> None:
    """Compute the joints' spatial velocities and biases for joint velocities of shape (n,)."""
    for i in range(1, len(motion.parent)):
        p = motion.parent[i]
        for k in range(2):
            for m in range(3):
                rate, bias = motion.J[i - 1, k, m], motion.dJ[i - 1, k, m]
                motion.velocity[i, k, m] = motion.velocity[p, k, m] + rate * v[i - 1]
                motion.bias[i, k, m] = motion.bias[p, k, m] + bias * v[i - 1]


@compiled_vectors
def at_point(field: Array, point: Vector) -> Vector:
    """Return a spatial velocity or acceleration, shape (2, 3), at a point."""
    return along(at(field, 0), 1.0, cross(at(field, 1), point))
