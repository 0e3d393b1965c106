"""Contacts of links with the environment: friction cones, wrenches, Jacobians.

A contact is one or more points of a link at which the environment pushes, along a normal and,
by friction, across it. The force at a point is a combination of the edges of a pyramid with
coefficients rho >= 0, its wrench on the link ``F = W rho``, [Benallegue2021], III-E. Everything
is in the axes of the contact's frame, moments about its origin, and what the environment does
to the link: an arm that presses on a table with F feels -F. One point carries a force only;
points that are not all on a line, as the corners of a sole, carry moments too.

Friction holds a force within the Coulomb cone ``|f_t| <= friction * f_n``. Inscribed pyramids,
with their edges on the cone, lie inside it: they give up, between two edges, up to a share of
1 - cos(pi / facets), 29% with 4 facets, and never ask for a force that would slip.
Circumscribed ones have their faces on the cone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from torque_safety_controller.qp.constraints import LinearConstraints
from torque_safety_controller.qp.inverse_dynamics_qp import ContactForces
from torque_safety_controller.qp.terms import TaskTerm, WrenchTerm
from viability_bounds_pkg.exceptions import ArmSafetyError


class ContactError(ArmSafetyError, ValueError):
    """A contact that cannot be: which part of it, its value and what is allowed."""


def friction_pyramid(
    normal: np.ndarray, friction: float, facets: int, inscribed: bool = True
) -> np.ndarray:
    """Return the edges of a pyramid for a friction cone, shape (3, facets).

    Each has a normal component of 1, so that the sum of the coefficients is the normal force.

    Args:
        normal: direction in which the environment pushes, shape (3,), any length.
        friction: coefficient of friction, >= 0.
        facets: of the pyramid, at least 3.
        inscribed: whether the pyramid lies inside the cone, or the cone inside it.

    Raises:
        ContactError: something else.
    """
    normal = np.asarray(normal, dtype=float)
    length = float(np.linalg.norm(normal)) if normal.shape == (3,) else math.nan
    if not 1e-9 < length < math.inf:
        raise ContactError(f"normal {normal} of a contact: must be 3 finite numbers, not all 0")
    if not 0.0 <= friction < math.inf:
        raise ContactError(f"friction {friction} of a contact: must be finite and >= 0")
    if isinstance(facets, bool) or facets != int(facets) or facets < 3:
        raise ContactError(f"{facets} facets of a friction pyramid: must be a whole number >= 3")
    normal = normal / length
    # Across the normal, away from the axis that is nearest to it.
    x = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    slope = friction if inscribed else friction / math.cos(math.pi / facets)
    angle = 2.0 * math.pi * np.arange(facets) / facets
    return normal[:, None] + slope * (np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle)))


@dataclass(frozen=True, eq=False)
class Contact:
    """One contact of a link, in the axes of one of its frames.

    Attributes:
        frame: name of the frame.
        points: where the link touches, shape (p, 3), m; (3,) for a single point.
        normal: direction in which the environment pushes, shape (3,), any length.
        friction: coefficient of friction, >= 0.
        facets: of each point's friction pyramid, at least 3.
        inscribed: whether pyramids lie inside the friction cones, or the cones inside them.
        W: wrench of the environment on the link by coefficient, shape (6, p * facets), forces
            first, moments about the frame's origin.

    Raises:
        ContactError: what cannot be.
    """

    frame: str
    points: np.ndarray
    normal: np.ndarray
    friction: float
    facets: int = 4
    inscribed: bool = True
    W: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=float)
        if points.shape == (3,):
            points = points[None]
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise ContactError(f"points of shape {points.shape} on {self.frame!r}: must be (p, 3)")
        if not np.isfinite(points).all():
            raise ContactError(f"points {points} on {self.frame!r}: must be finite")
        edges = friction_pyramid(self.normal, self.friction, self.facets, self.inscribed)
        moments = np.cross(points[:, None], edges.T[None])  # (p, facets, 3)
        forces = np.broadcast_to(edges.T, moments.shape)
        W = np.concatenate([forces, moments], axis=2).reshape(-1, 6).T
        normal = np.asarray(self.normal, dtype=float)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "normal", normal / np.linalg.norm(normal))
        object.__setattr__(self, "W", np.ascontiguousarray(W))


class Contacts:
    """All contacts of an arm, as the QP needs them.

    Args:
        model: of the arm, n joints with one coordinate each.
        contacts: at least one.

    Attributes:
        contacts: as given.
        closed: which of them there are at present, shape (c,); open ones exert nothing.
        r: number of force coefficients of all contacts.

    Raises:
        ContactError: none, or an unknown frame.
    """

    def __init__(self, model: pin.Model, contacts: Sequence[Contact]) -> None:
        if not contacts:
            raise ContactError("no contacts")
        for contact in contacts:
            if not model.existFrame(contact.frame):
                known = ", ".join(f.name for f in model.frames)
                raise ContactError(
                    f"unknown frame {contact.frame!r} of a contact; the URDF has: {known}"
                )
        self.contacts = tuple(contacts)
        self.closed = np.ones(len(contacts), dtype=bool)
        ends = np.cumsum([contact.W.shape[1] for contact in contacts])
        self.r = int(ends[-1])
        self._model = model
        self._data: pin.Data | None = None
        self._frames = [model.getFrameId(contact.frame) for contact in contacts]
        self._slices = [
            slice(int(end) - contact.W.shape[1], int(end))
            for contact, end in zip(contacts, ends, strict=True)
        ]
        self._B = np.zeros((model.nv, self.r))
        self._rho_max = np.zeros(self.r)
        # Rows that give the points' velocities from the frame's, 3 for each point.
        self._to_points = [
            np.vstack([np.hstack([np.eye(3), -pin.skew(p)]) for p in contact.points])
            for contact in contacts
        ]

    def update(self, data: pin.Data) -> None:
        """Compute what depends on the state.

        Args:
            data: of the model, with its joint Jacobians, and its kinematics at the current
                velocity and no acceleration.
        """
        self._data = data
        for frame, part, contact in zip(self._frames, self._slices, self.contacts, strict=True):
            J = pin.getFrameJacobian(self._model, data, frame, pin.ReferenceFrame.LOCAL)
            self._B[:, part] = J.T @ contact.W

    def forces(self, tasks: Sequence[WrenchTerm] = ()) -> ContactForces:
        """Return the forces for the QP, with what they should be; the next update changes them."""
        for closed, part in zip(self.closed, self._slices, strict=True):
            self._rho_max[part] = np.inf if closed else 0.0
        return ContactForces(self._B, self._rho_max, tasks)

    def wrench_task(
        self, index: int, F_des: np.ndarray, weight: float, components: Sequence[int] | None = None
    ) -> WrenchTerm:
        """Let the environment exert a wrench on a link: [Benallegue2021], III-E (a).

        Args:
            index: of the contact.
            F_des: desired wrench on the link, shape (6,), N and N m; the arm exerts its negative.
            weight: of the squared error.
            components: of the wrench that are meant, by index; None for the force of a point, or
                all 6 of several points.
        """
        contact = self.contacts[index]
        if components is None:
            components = range(3 if len(contact.points) == 1 else 6)
        W = np.ascontiguousarray(contact.W[list(components)])
        F_des = np.asarray(F_des, dtype=float)[list(components)]
        return WrenchTerm(W, F_des, weight, self._slices[index].start)

    def wrench(self, index: int, rho: np.ndarray) -> np.ndarray:
        """Return the environment's wrench on a link, shape (6,), N and N m.

        Args:
            index: of the contact.
            rho: as the QP returned it, shape (r,), N.
        """
        return self.contacts[index].W @ rho[self._slices[index]]

    def acceleration(self, index: int, normal_only: bool = False) -> tuple[np.ndarray, ...]:
        """Return A, v_c and drift: the points move with v_c and accelerate with A a + drift.

        In the frame's axes: A of shape (3 p, n), v_c in m/s and drift in m/s^2 of shape (3 p,);
        with `normal_only` the components along the normal, p rows.
        """
        local = pin.ReferenceFrame.LOCAL
        model, data, frame = self._model, self._data, self._frames[index]
        S, contact = self._to_points[index], self.contacts[index]
        motion = pin.getFrameVelocity(model, data, frame, local)
        v_c = S @ motion.vector
        # A point's acceleration is that of the frame, as a field, and w x v_c: the field is seen
        # from a place that does not move, the point moves through it.
        turning = np.cross(motion.angular, v_c.reshape(-1, 3)).reshape(-1)
        drift = S @ pin.getFrameAcceleration(model, data, frame, local).vector + turning
        A = S @ pin.getFrameJacobian(model, data, frame, local)
        if not normal_only:
            return A, v_c, drift
        along = [
            contact.normal @ each.reshape(len(contact.points), 3, -1) for each in (A, v_c, drift)
        ]
        return along[0], along[1][:, 0], along[2][:, 0]

    def rest_task(
        self, index: int, kd: float, weight: float, normal_only: bool = False
    ) -> TaskTerm:
        """Keep the points of a contact where they are, as a task.

        Args:
            index: of the contact.
            kd: damping of what velocity there is, 1/s.
            weight: of the squared error of acceleration, the mean over the points.
            normal_only: whether they may slide.
        """
        A, v_c, drift = self.acceleration(index, normal_only)
        weight /= len(self.contacts[index].points)
        return TaskTerm(np.ascontiguousarray(A), -kd * v_c - drift, weight)

    def rest_rows(self, index: int, kd: float, normal_only: bool = False) -> LinearConstraints:
        """Keep the points of a contact where they are, as equations; see `rest_task`."""
        A, v_c, drift = self.acceleration(index, normal_only)
        b = -kd * v_c - drift
        return LinearConstraints(A, b, b)
