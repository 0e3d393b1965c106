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
1 - cos(pi / `FACETS`), 29%, and never ask for a force that would slip.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.qp import ContactForces, WrenchTerm
from viability_bounds_pkg.robot.description import frame_id

Array = NDArray[np.float64]

FACETS = 4
"""Edges of a friction pyramid."""


def friction_pyramid(normal: Array, friction: float) -> Array:
    """Return the edges of a pyramid inside a friction cone, shape (3, FACETS).

    Each has a normal component of 1, so that the sum of the coefficients is the normal force.

    Args:
        normal: direction in which the environment pushes, shape (3,), of length 1.
        friction: coefficient of friction, >= 0.
    """
    # Across the normal, away from the axis that is nearest to it.
    x = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    angle = 2.0 * math.pi * np.arange(FACETS) / FACETS
    across: Array = np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle))
    return normal[:, None] + friction * across


class FrictionContact:
    """One contact of a link, in the axes of one of its frames.

    Args:
        frame: name of the frame.
        points: where the link touches, shape (p, 3), m.
        normal: direction in which the environment pushes, shape (3,), of any length but 0.
        friction: coefficient of friction, >= 0.

    Attributes:
        frame, points, friction: as given.
        normal: of length 1.
        lever: distance of the farthest point from the frame's origin, m.
        W: wrench of the environment on the link by coefficient, shape (6, p * FACETS), forces
            first, moments about the frame's origin.
    """

    def __init__(self, frame: str, points: ArrayLike, normal: ArrayLike, friction: float) -> None:
        self.frame, self.friction = frame, friction
        self._frame_id: int | None = None
        self.points = np.asarray(points, dtype=float)
        self.normal: Array = np.asarray(normal) / np.linalg.norm(normal)
        self.lever = float(np.linalg.norm(self.points, axis=1).max())
        edges = friction_pyramid(self.normal, friction)
        self.W = np.hstack([np.vstack([edges, pin.skew(point) @ edges]) for point in self.points])

    @property
    def exerts_moments(self) -> bool:
        """Whether there is more than one point."""
        return len(self.points) > 1

    def wrench(self, rho: Array) -> Array:
        """Return the environment's wrench on the link, shape (6,), N and N m.

        Args:
            rho: force coefficients, as the QP returned them, shape (p * FACETS,), N.
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
        if self._frame_id is None:  # models of one arm have the same frames
            self._frame_id = frame_id(model, self.frame)
        J = pin.getFrameJacobian(model, data, self._frame_id, pin.ReferenceFrame.LOCAL)
        W = self.W if self.exerts_moments else self.W[:3]
        rho_max = np.full(W.shape[1], np.inf)
        return ContactForces(J.T @ self.W, rho_max, [WrenchTerm(W, F_des[: len(W)], weight)])
