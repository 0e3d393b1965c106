# SPDX-License-Identifier: Apache-2.0
"""Bias forces and the diagonal of the inertia matrix of many states, compiled.

Pinocchio gives the whole matrix of one state a call, most of whose time goes into the call. Here
the force and the moment that each body needs, by Newton's and Euler's laws, are projected on the
joints that carry it (Kane's equations). Vectors are in the axes of the root.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


class Bodies(NamedTuple):
    """The bodies of a model with their joints, by Pinocchio's indices: 0 is the root.

    Attributes:
        parent: index of the body that carries the joint, shape (n + 1,).
        rotation: of the joint in its parent at q = 0, shape (n + 1, 3, 3).
        position: of the joint in its parent at q = 0, shape (n + 1, 3), m.
        turn: axis about which the joint turns, shape (n + 1, 3); zeros if it slides.
        slide: direction in which it slides, shape (n + 1, 3); zeros if it turns.
        mass: shape (n + 1,), kg.
        centre: of mass, in the joint's axes, shape (n + 1, 3), m.
        inertia: about the centre of mass, shape (n + 1, 3, 3), kg m^2.
        armature: inertia of the rotors, shape (n,), kg m^2.
        gravity: acceleration, shape (3,), m/s^2.
    """

    parent: NDArray[np.int64]
    rotation: Array
    position: Array
    turn: Array
    slide: Array
    mass: Array
    centre: Array
    inertia: Array
    armature: Array
    gravity: Array

    @classmethod
    def of(cls, model: pin.Model) -> Bodies:
        """Return the bodies of a model whose joints have one coordinate each."""
        data = model.createData()
        pin.computeJointJacobians(model, data, np.zeros(model.nq))
        motion = np.zeros((model.njoints, 6))
        for k in range(1, model.njoints):
            motion[k] = np.ravel(data.joints[k].S)
        return cls(
            np.array(list(model.parents), dtype=np.int64),
            np.array([placement.rotation for placement in model.jointPlacements]),
            np.array([placement.translation for placement in model.jointPlacements]),
            np.ascontiguousarray(motion[:, 3:]),
            np.ascontiguousarray(motion[:, :3]),
            np.array([body.mass for body in model.inertias]),
            np.array([body.lever for body in model.inertias]),
            np.array([body.inertia for body in model.inertias]),
            np.array(model.armature),
            np.array(model.gravity.linear),
        )


def torque_terms(bodies: Bodies, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the bias forces and the diagonal of the inertia matrix of a batch of states.

    Args:
        bodies: of the robot.
        q: positions, shape (batch, n), rad.
        v: velocities, shape (batch, n), rad/s.

    Returns:
        h, shape (batch, n), N m, and the diagonal of M, rotors included, shape (batch, n), kg m^2.
    """
    h, inertia = np.zeros(q.shape), np.zeros(q.shape) + bodies.armature
    _add_terms(bodies, q, v, h, inertia)
    return h, inertia


@njit(cache=True, error_model="numpy", nogil=True)
def _add_terms(bodies: Bodies, q: Array, v: Array, h: Array, inertia: Array) -> None:
    """Add the terms of all bodies to `h` and `inertia`, without the interpreter's lock."""
    count = len(bodies.parent)
    axes = np.zeros((count, 3, 3))  # of each joint, as columns
    origin, turn, slide = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    omega, alpha = np.zeros((count, 3)), np.zeros((count, 3))  # angular velocity, acceleration
    a = np.zeros((count, 3))  # acceleration of the origin
    placed, spread = np.zeros((3, 3)), np.zeros((3, 3))
    axes[0, 0, 0] = axes[0, 1, 1] = axes[0, 2, 2] = 1.0
    a[0] = -bodies.gravity
    for i in range(len(q)):
        for k in range(1, count):
            p, q_k, v_k = bodies.parent[k], q[i, k - 1], v[i, k - 1]
            w, dw = _row(omega, p), _row(alpha, p)
            _product(axes[p], bodies.rotation[k], placed)
            z, d = _times(placed, _row(bodies.turn, k)), _times(placed, _row(bodies.slide, k))
            _rotate(placed, z, q_k * _dot(z, z), axes[k])  # by nothing where it slides
            r = _sum(_times(axes[p], _row(bodies.position, k)), d, q_k)
            o = _sum(_row(origin, p), r, 1.0)
            a_k = _sum(_sum(_row(a, p), _carried(dw, w, r), 1.0), _cross(w, d), 2.0 * v_k)
            w, dw = _sum(w, z, v_k), _sum(dw, _cross(w, z), v_k)
            _put(turn, k, z), _put(slide, k, d), _put(origin, k, o)
            _put(omega, k, w), _put(alpha, k, dw), _put(a, k, a_k)

            arm, mass = _times(axes[k], _row(bodies.centre, k)), bodies.mass[k]
            centre, acceleration = _sum(o, arm, 1.0), _sum(a_k, _carried(dw, w, arm), 1.0)
            _product(axes[k], bodies.inertia[k], placed)
            _product(placed, axes[k].T, spread)
            moment = _sum(_times(spread, dw), _cross(w, _times(spread, w)), 1.0)
            j = k
            while j > 0:
                z = _row(turn, j)
                # How the centre of mass moves with joint j.
                lever = _sum(_row(slide, j), _cross(z, _sum(centre, _row(origin, j), -1.0)), 1.0)
                h[i, j - 1] += mass * _dot(lever, acceleration) + _dot(z, moment)
                inertia[i, j - 1] += mass * _dot(lever, lever) + _dot(z, _times(spread, z))
                j = bodies.parent[j]


@njit(cache=True, error_model="numpy")
def _row(array: Array, k: int) -> Vector:
    return array[k, 0], array[k, 1], array[k, 2]


@njit(cache=True, error_model="numpy")
def _put(array: Array, k: int, x: Vector) -> None:
    array[k, 0], array[k, 1], array[k, 2] = x


@njit(cache=True, error_model="numpy")
def _dot(x: Vector, y: Vector) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@njit(cache=True, error_model="numpy")
def _cross(x: Vector, y: Vector) -> Vector:
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@njit(cache=True, error_model="numpy")
def _sum(x: Vector, y: Vector, factor: float) -> Vector:
    return x[0] + factor * y[0], x[1] + factor * y[1], x[2] + factor * y[2]


@njit(cache=True, error_model="numpy")
def _times(matrix: Array, x: Vector) -> Vector:
    return _dot(_row(matrix, 0), x), _dot(_row(matrix, 1), x), _dot(_row(matrix, 2), x)


@njit(cache=True, error_model="numpy")
def _product(left: Array, right: Array, out: Array) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = (
                left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]
            )


@njit(cache=True, error_model="numpy")
def _rotate(axes: Array, z: Vector, angle: float, out: Array) -> None:
    """Write `axes` turned about `z`, a unit vector or zero: Rodrigues' formula."""
    s, c = sin(angle), cos(angle)
    for i in range(3):
        x = axes[0, i], axes[1, i], axes[2, i]
        across, along = _cross(z, x), (1.0 - c) * _dot(x, z)
        for j in range(3):
            out[j, i] = c * x[j] + s * across[j] + along * z[j]


@njit(cache=True, error_model="numpy")
def _carried(alpha: Vector, omega: Vector, r: Vector) -> Vector:
    """Return the acceleration of a point at `r` on a body whose origin does not accelerate."""
    return _sum(_cross(alpha, r), _cross(omega, _cross(omega, r)), 1.0)
