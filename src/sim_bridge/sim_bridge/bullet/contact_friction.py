# SPDX-License-Identifier: Apache-2.0
"""Coulomb friction between a link and an obstacle.

The two are connected by a bristle: a spring of deflection s along the surface, with a little
damping, that slips where its force reaches Coulomb's limit,

    s+ = s + h v_t,   f = -(k s+ + d v_t),   |f| <= mu N:   else  f = mu N f / |f|,  s+ = -f / k,

with v_t the velocity along the surface and N the normal force, both of the last physics step. At
rest it holds as stiction does; in motion f opposes v_t with mu N in any direction.

The force is explicit, which is stable for links of more than about k h^2 / 4 + d h / 2; the values
of `Bristle` make that 30 g.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_bridge.bullet.obstacles import ContactMaterial

Array = NDArray[Any]

_STIFFNESS_MASS = 0.02  # k h^2, kg
_DAMPING_MASS = 0.05  # d h, kg


CONTACT_POINT = np.dtype(
    [
        ("position", np.float64, 3),  # on the link, m
        ("normal", np.float64, 3),  # from the obstacle to the link
        ("pressure", np.float64),  # normal force, N
    ]
)
"""A point where a link touches an obstacle."""


class Bristle:
    """The friction contact between one link and one obstacle.

    Args:
        physics_dt: the physics step h, s.
        material: of the obstacle, whose stiffness k does not exceed.

    Attributes:
        points: where the link is touched, shape (m,), of `CONTACT_POINT`.
        force: on the link in the next step, shape (3,), N.
        point: where it acts, the centre of pressure, shape (3,), m.
    """

    def __init__(self, physics_dt: float, material: ContactMaterial) -> None:
        self._dt, self._friction = physics_dt, material.friction
        self._stiffness = min(material.stiffness, _STIFFNESS_MASS / physics_dt**2)
        self._damping = _DAMPING_MASS / physics_dt
        self._deflection = np.zeros(3)
        self.points: Array = np.zeros(0, CONTACT_POINT)
        self.force, self.point = np.zeros((2, 3))

    def update(self, motion: Array) -> None:
        """Compute force and point in the next step from contacts and motion in the last.

        Args:
            motion: of the link, shape (3, 3): centre of mass, m, its velocity, m/s, angular
                velocity, rad/s.
        """
        _update(
            self.points,
            motion,
            self._friction,
            self._dt,
            self._stiffness,
            self._damping,
            self._deflection,
            self.force,
            self.point,
        )


@njit(cache=True)
def _update(
    points: Array,
    motion: Array,
    friction: float,
    dt: float,
    stiffness: float,
    damping: float,
    s: Array,
    force: Array,
    point: Array,
) -> None:
    centre, velocity, angular_velocity = motion
    normal = np.zeros(3)
    pressure = 0.0
    point[:] = 0.0
    for contact in points:
        pressure += contact.pressure
        point += contact.pressure * contact.position
        normal += contact.pressure * contact.normal
    point /= pressure
    normal /= np.sqrt(normal @ normal)
    v = velocity + np.cross(angular_velocity, point - centre)
    v -= (v @ normal) * normal
    s -= (s @ normal) * normal  # the surface may have turned
    s += dt * v
    force[:] = -(stiffness * s + damping * v)
    size, limit = np.sqrt(force @ force), friction * pressure
    if size > limit:
        force *= limit / size
        s[:] = force / -stiffness
