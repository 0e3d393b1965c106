"""Coulomb friction between a link and an obstacle.

The two are connected by a bristle: a spring of deflection s along the surface, with a little
damping, that gives way where Coulomb's law ends what it can bear,

    s+ = s + h v_t,   f = -(k s+ + d v_t),   |f| <= mu N:   else  f = mu N f / |f|,  s+ = -f / k,

with v_t the velocity along the surface and N the pressure, both of the last physics step. At
rest it holds as stiction does; in motion f opposes v_t with mu N in any direction.

The force is explicit, which is stable for links of more than about k h^2 / 4 + d h / 2; see
`Bristle` for the values, which let the weakest feel as if they weighed 30 g.
"""

from __future__ import annotations

import numpy as np

from viability_bounds_pkg.compiled import compiled

_STIFFNESS_MASS = 0.02  # k h^2, kg
_DAMPING_MASS = 0.05  # d h, kg


class Bristle:
    """What holds one link on one obstacle.

    Args:
        physics_dt: the physics step h, s.
        stiffness: of the obstacle, N/m, which k does not exceed.

    Attributes:
        force: on the link in the step to come, shape (3,), N.
        point: where it acts, the centre of pressure, shape (3,), m.
    """

    def __init__(self, physics_dt: float, stiffness: float) -> None:
        self._dt = physics_dt
        self._stiffness = min(stiffness, _STIFFNESS_MASS / physics_dt**2)
        self._damping = _DAMPING_MASS / physics_dt
        self._deflection = np.zeros(3)
        self.force, self.point = np.zeros((2, 3))

    def update(self, points: np.ndarray, motion: np.ndarray, friction: float) -> None:
        """Find the force in the step to come from what happened in the last.

        Args:
            points: where the link is touched, shape (m, 7): position, m, direction from the
                obstacle to the link, pressure, N.
            motion: of the link, shape (9,): centre, m, its velocity, m/s, angular velocity,
                rad/s.
            friction: Coulomb's coefficient.
        """
        _update(
            points,
            motion,
            friction,
            self._dt,
            self._stiffness,
            self._damping,
            self._deflection,
            self.force,
            self.point,
        )


@compiled
def _update(points, motion, friction, dt, stiffness, damping, s, force, point):
    normal = np.zeros(3)
    pressure = 0.0
    point[:] = 0.0
    for row in points:
        pressure += row[6]
        point += row[6] * row[:3]
        normal += row[6] * row[3:6]
    point /= pressure
    normal /= np.sqrt(normal @ normal)
    v = motion[3:6] + np.cross(motion[6:], point - motion[:3])
    v -= (v @ normal) * normal
    s -= (s @ normal) * normal  # the surface may have turned
    s += dt * v
    force[:] = -(stiffness * s + damping * v)
    size, limit = np.sqrt(force @ force), friction * pressure
    if size > limit:
        force *= limit / size
        s[:] = force / -stiffness
