"""Bias forces and joint inertias of many states at once.

Three times faster than two calls of Pinocchio for each state from Python: the recursions below
go through the joints once for a whole batch, in NumPy. They are the recursive Newton-Euler
algorithm for h and the composite rigid bodies for the diagonal of M ([Featherstone], chapters 5
and 6). Each link's frame is turned so that its joint's axis is z, which leaves, for every joint,
one constant matrix product and a planar rotation.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEW = 32
"""Up to this many states, a loop over Pinocchio's functions is faster."""

BLOCK = 2**11
"""States per pass: the arrays stay in the cache, and the matrix products below the size at which
a BLAS starts threads, which cost more than they bring here, most of all on a busy machine."""

# Spatial vectors are ordered as Pinocchio's: linear part first.
# Inertias of composite bodies are their 10 parameters (mass, first moments x y z, moments of
# inertia about the origin of the frame xx xy yy xz yz zz), in which changing frames is linear.
_ENTRIES = ((3, 3), (3, 4), (4, 4), (3, 5), (4, 5), (5, 5))


def _inertia_matrix(parameters: Array) -> Array:
    """Return the spatial inertia, shape (6, 6), of 10 parameters."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = parameters[0] * np.eye(3)
    matrix[3:, :3] = pin.skew(parameters[1:4])
    matrix[:3, 3:] = matrix[3:, :3].T
    for value, (row, column) in zip(parameters[4:], _ENTRIES, strict=True):
        matrix[row, column] = matrix[column, row] = value
    return matrix


def _inertia_parameters(matrix: Array) -> Array:
    """Return the 10 parameters of a spatial inertia: the inverse of `_inertia_matrix`."""
    moments = [matrix[5, 1], matrix[3, 2], matrix[4, 0]]
    return np.array([matrix[0, 0], *moments, *(matrix[entry] for entry in _ENTRIES)])


class _Link:
    """The constants of one joint and the link it carries, in the frame turned to its axis."""

    def __init__(self, model: pin.Model, index: int, axis: Array, frames: list[pin.SE3]):
        self.parent = model.parents[index] - 1
        self.prismatic = bool(np.any(axis[:3]))
        direction = axis[:3] if self.prismatic else axis[3:]
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction)
        frames.append(pin.SE3(turn.toRotationMatrix(), np.zeros(3)))
        placement = frames[self.parent + 1].inverse() * model.jointPlacements[index] * frames[-1]
        self.from_parent = np.array(placement.toActionMatrixInverse())
        self.inertia = np.array(frames[-1].actInv(model.inertias[index]).matrix())
        self.parameters = _inertia_parameters(self.inertia)[:, None]
        self.parameters_to_parent = np.stack(
            [
                _inertia_parameters(self.from_parent.T @ _inertia_matrix(unit) @ self.from_parent)
                for unit in np.eye(10)
            ],
            axis=1,
        )
        self.row = 2 if self.prismatic else 5  # of the axis in a spatial vector


class BatchDynamics:
    """Evaluates h(q, v) and the diagonal of M(q) for batches of states.

    Args:
        model: the robot. Revolute and prismatic joints about constant axes are evaluated in
            batches, which is every joint a URDF has; with others each state costs a call.
    """

    def __init__(self, model: pin.Model):
        self.model = model
        self._data = model.createData()
        self._links: list[_Link] = []
        pin.forwardKinematics(model, self._data, pin.neutral(model))
        frames = [pin.SE3.Identity()]
        for index in range(1, model.njoints):
            joint = model.joints[index]
            if not joint.shortname().startswith(("JointModelR", "JointModelP")) or joint.nq != 1:
                self._links.clear()
                break
            axis = np.asarray(self._data.joints[index].S, dtype=float).reshape(-1)
            self._links.append(_Link(model, index, axis, frames))

    def torque_terms(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the bias forces and the diagonal of the inertia matrix, rotors included.

        Args:
            q: positions, shape (batch, n), rad.
            v: velocities, shape (batch, n), rad/s.

        Returns:
            h, shape (batch, n), N m, and the diagonal of M, shape (batch, n), kg m^2.
        """
        h, inertia = np.empty(q.shape), np.empty(q.shape)
        recursion = self._recursion if len(q) > FEW and self._links else self._one_by_one
        for start in range(0, len(q), BLOCK):
            rows = slice(start, start + BLOCK)
            h[rows], inertia[rows] = recursion(q[rows], v[rows])
        return h, inertia

    def _recursion(self, q: Array, v: Array) -> tuple[Array, Array]:
        cosines, sines = np.cos(q.T), np.sin(q.T)
        forces = self._link_forces(q.T, v.T, cosines, sines)
        bodies = [link.parameters for link in self._links]
        h, inertia = np.empty(q.T.shape), np.empty(q.T.shape)
        for i in reversed(range(len(self._links))):
            link, force = self._links[i], forces[i]
            h[i] = force[link.row]
            inertia[i] = bodies[i][0 if link.prismatic else 9]
            if link.parent < 0:
                continue
            force = _force_before_joint(link, force, q.T[i], cosines[i], sines[i])
            forces[link.parent] += link.from_parent.T @ force
            body = _body_before_joint(link, bodies[i], q.T[i], cosines[i], sines[i])
            bodies[link.parent] = bodies[link.parent] + link.parameters_to_parent @ body
        return h.T, inertia.T + self.model.armature

    def _one_by_one(self, q: Array, v: Array) -> tuple[Array, Array]:
        data = self._data
        h, inertia = np.empty(q.shape), np.empty(q.shape)
        for i in range(len(q)):
            inertia[i] = pin.crba(self.model, data, q[i]).diagonal()
            h[i] = pin.nonLinearEffects(self.model, data, q[i], v[i])
        return h, inertia

    def _link_forces(self, q: Array, v: Array, cosines: Array, sines: Array) -> list[Array]:
        """Return the force that moves each link, shape (6, batch), joints not accelerating."""
        gravity = np.concatenate([-self.model.gravity.linear, np.zeros(3)])
        velocities, accelerations, forces = [], [], []
        for i, link in enumerate(self._links):
            if link.parent < 0:
                velocity = np.zeros((6, q.shape[1]))
                acceleration = np.repeat((link.from_parent @ gravity)[:, None], q.shape[1], axis=1)
            else:
                velocity = link.from_parent @ velocities[link.parent]
                acceleration = link.from_parent @ accelerations[link.parent]
            for motion in (velocity, acceleration):
                if link.prismatic:
                    motion[0] += motion[4] * q[i]
                    motion[1] -= motion[3] * q[i]
                else:
                    _turn(motion, (0, 3), cosines[i], -sines[i])
            velocity[link.row] += v[i]
            for source, target in ((3, 0),) if link.prismatic else ((3, 3), (0, 0)):
                acceleration[target] += velocity[source + 1] * v[i]
                acceleration[target + 1] -= velocity[source] * v[i]
            momentum = link.inertia @ velocity
            force = link.inertia @ acceleration
            _add_cross(force[:3], velocity[3:], momentum[:3])
            _add_cross(force[3:], velocity[3:], momentum[3:])
            _add_cross(force[3:], velocity[:3], momentum[:3])
            velocities.append(velocity)
            accelerations.append(acceleration)
            forces.append(force)
        return forces


def _turn(rows: Array, starts: tuple[int, ...], cosine: Array, sine: Array) -> None:
    """Rotate the (x, y) pairs of rows that begin at `starts` about z, in place."""
    for k in starts:
        x, y = rows[k], rows[k + 1]
        rows[k], rows[k + 1] = cosine * x - sine * y, sine * x + cosine * y


def _add_cross(target: Array, a: Array, b: Array) -> None:
    """Add the cross product of `a` and `b`, each of shape (3, batch), to `target`."""
    target[0] += a[1] * b[2] - a[2] * b[1]
    target[1] += a[2] * b[0] - a[0] * b[2]
    target[2] += a[0] * b[1] - a[1] * b[0]


def _force_before_joint(link: _Link, force: Array, q: Array, cosine: Array, sine: Array) -> Array:
    """Return a spatial force in the frame that does not move with the joint; may reuse it."""
    if link.prismatic:
        force[3] -= q * force[1]
        force[4] += q * force[0]
    else:
        _turn(force, (0, 3), cosine, sine)
    return force


def _body_before_joint(link: _Link, body: Array, q: Array, cosine: Array, sine: Array) -> Array:
    """Return inertia parameters in the frame that does not move with the joint."""
    mass, x, y, z, xx, xy, yy, xz, yz, zz = body
    if link.prismatic:
        far = q * (2.0 * z + mass * q)
        moved = (mass, x, y, z + mass * q, xx + far, xy, yy + far, xz - q * x, yz - q * y, zz)
    else:
        cc, cs, ss = cosine * cosine, cosine * sine, sine * sine
        moved = (
            mass,
            cosine * x - sine * y,
            sine * x + cosine * y,
            z,
            cc * xx - 2.0 * cs * xy + ss * yy,
            cs * (xx - yy) + (cc - ss) * xy,
            ss * xx + 2.0 * cs * xy + cc * yy,
            cosine * xz - sine * yz,
            sine * xz + cosine * yz,
            zz,
        )
    return np.stack(np.broadcast_arrays(*moved))
