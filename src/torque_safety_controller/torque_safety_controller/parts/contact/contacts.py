# SPDX-License-Identifier: Apache-2.0
"""Contact of a link with the environment: friction cones, wrenches, joint torques.

A contact is one or more points of a link at which the environment pushes, along a normal and,
by friction, across it. The force at a point is a combination of the edges of a pyramid with
coefficients rho >= 0, its wrench on the link ``F = W rho``, [Benallegue2021], III-E. Everything
is in the axes of the contact's frame, moments about its origin, and what the environment does
to the link: an arm that presses on a table with F feels -F. One point carries a force only;
points that are not all on a line, as the corners of a sole, carry moments too.

Friction holds a force within the Coulomb cone ``|f_t| <= friction * f_n``. Pyramids, with their
edges on the cone, lie inside it: they give up, between two edges, up to a share of
1 - cos(pi / facets), 29% with 4 facets, and never ask for a force that would slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.qp import ContactForces, WrenchTerm
from viability_bounds_pkg.exceptions import SettingError

Array = NDArray[np.float64]

FACETS = 4
"""Edges of a friction pyramid."""


def friction_pyramid(normal: ArrayLike, friction: float, facets: int = FACETS) -> Array:
    """Return the edges of a pyramid inside a friction cone, shape (3, facets).

    Each has a normal component of 1, so that the sum of the coefficients is the normal force.

    Args:
        normal: direction in which the environment pushes, shape (3,), any length.
        friction: coefficient of friction, >= 0.
        facets: of the pyramid, at least 3.

    Raises:
        SettingError: something else.
    """
    normal = np.asarray(normal, dtype=np.float64)
    length = float(np.linalg.norm(normal)) if normal.shape == (3,) else math.nan
    if not 1e-9 < length < math.inf:
        raise SettingError("normal of a contact", normal, "3 finite numbers, not all 0")
    if not 0.0 <= friction < math.inf:
        raise SettingError("friction of a contact", friction, "finite and >= 0")
    if facets < 3:
        raise SettingError("facets of a contact", facets, "at least 3")
    normal = normal / length
    # Across the normal, away from the axis that is nearest to it.
    x = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    angle = 2.0 * math.pi * np.arange(facets) / facets
    across: Array = np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle))
    return normal[:, None] + friction * across


@dataclass(frozen=True, eq=False)
class FrictionContact:
    """One contact of a link, in the axes of one of its frames.

    Attributes:
        frame: name of the frame.
        points: where the link touches, shape (p, 3), m; (3,) for a single point.
        normal: direction in which the environment pushes, shape (3,), any length.
        friction: coefficient of friction, >= 0.
        facets: of each point's friction pyramid, at least 3.
        lever: distance of the farthest point from the frame's origin, m.
        W: wrench of the environment on the link by coefficient, shape (6, p * facets), forces
            first, moments about the frame's origin.

    Raises:
        SettingError: a value cannot be used.
    """

    frame: str
    points: Array
    normal: Array
    friction: float
    facets: int = FACETS
    lever: float = field(init=False)
    W: Array = field(init=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=float)
        if points.shape == (3,):
            points = points[None]
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise SettingError(f"points on {self.frame!r}", points, "of shape (p, 3)")
        if not np.isfinite(points).all():
            raise SettingError(f"points on {self.frame!r}", points, "finite")
        edges = friction_pyramid(self.normal, self.friction, self.facets)
        moments = np.cross(points[:, None], edges.T[None])  # (p, facets, 3)
        forces = np.broadcast_to(edges.T, moments.shape)
        W = np.concatenate([forces, moments], axis=2).reshape(-1, 6).T
        normal = np.asarray(self.normal, dtype=float)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "normal", normal / np.linalg.norm(normal))
        object.__setattr__(self, "lever", float(np.linalg.norm(points, axis=1).max()))
        object.__setattr__(self, "W", np.ascontiguousarray(W))

    @property
    def exerts_moments(self) -> bool:
        """Whether there is more than one point."""
        return len(self.points) > 1

    def wrench(self, rho: Array) -> Array:
        """Return the environment's wrench on the link, shape (6,), N and N m.

        Args:
            rho: force coefficients, as the QP returned them, shape (p * facets,), N.
        """
        wrench: Array = self.W @ rho
        return wrench

    def forces(
        self, model: pin.Model, data: pin.Data, F_des: Array, weight: float
    ) -> ContactForces:
        """Return what the contact may exert, and should: [Benallegue2021], III-E (a).

        Args:
            model: of the arm.
            data: with its joint Jacobians.
            F_des: desired wrench on the link, shape (6,), N and N m; the arm exerts its negative.
                A single point can only exert its force.
            weight: of the squared error.
        """
        J = pin.getFrameJacobian(
            model, data, model.getFrameId(self.frame), pin.ReferenceFrame.LOCAL
        )
        W = self.W if self.exerts_moments else self.W[:3]
        rho_max = np.full(W.shape[1], np.inf)
        return ContactForces(J.T @ self.W, rho_max, [WrenchTerm(W, F_des[: len(W)], weight, 0)])
