# SPDX-License-Identifier: Apache-2.0
"""Friction of joints, and of contacts between links and obstacles.

A joint behind a gear of ratio N, with motor torque tau, obeys

    (M + I) a + h = tau - f(v) + contact,    I = N^2 times the inertia of the rotor,

with a friction f that follows Stribeck's curve with
Stribeck velocity v_s, and takes any value up to F_s at rest:

    f(v) = sign(v) L(v) + d v,    L(v) = F_c + (F_s - F_c) exp(-(v / v_s)^2),
    |f(0)| <= L(0) = F_s.

Each physics step of length h takes the friction at its end, so that it neither chatters nor
accelerates the joint; only the limit L is that of the velocity at the beginning. With -h d v_k+1
on the right, viscous friction is implicit as well, an explicit torque and a larger inertia,

    (M + I + h d) (v_k+1 - v_k) = ... - h d v_k.

In PyBullet dry friction is a motor with velocity target zero and limited torque, and each rotor a
link that a gear constraint couples to its joint; docs/guides/simulation.md has the reasons.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.client import finite_vector

Array = NDArray[np.float64]

DEFAULT_STRIBECK_VELOCITY = 0.01
"""rad/s."""

_STIFFNESS_MASS = 0.02  # k h^2, kg
_DAMPING_MASS = 0.05  # d h, kg


class JointFriction:
    """Friction and rotors of n joints. Arguments are scalars or of shape (n,).

    Args:
        n: number of joints.
        friction_coulomb: dry friction of a moving joint F_c, N m.
        friction_static: torque that moves a joint at rest F_s, N m; by default F_c.
        friction_viscous: d, N m s/rad.
        stribeck_velocity: v_s at which dry friction has decreased from F_s to F_c but for 1/e
            of the difference, rad/s.
        rotor_inertia: I, as seen from the joint, kg m^2.

    Raises:
        ValueError: a wrong shape, a number that is not finite, a negative one,
            stiction below Coulomb friction, a Stribeck velocity of zero.
    """

    def __init__(
        self,
        n: int,
        *,
        friction_coulomb: ArrayLike = 0.0,
        friction_static: ArrayLike | None = None,
        friction_viscous: ArrayLike = 0.0,
        stribeck_velocity: ArrayLike = DEFAULT_STRIBECK_VELOCITY,
        rotor_inertia: ArrayLike = 0.0,
    ) -> None:
        def per_joint(name: str, value: ArrayLike) -> Array:
            value = np.full(n, value) if np.ndim(value) == 0 else value
            return finite_vector(name, value, n, signed=False).copy()

        static = friction_coulomb if friction_static is None else friction_static
        self.friction_coulomb = per_joint("friction_coulomb", friction_coulomb)
        self.friction_static = per_joint("friction_static", static)
        self.friction_viscous = per_joint("friction_viscous", friction_viscous)
        self.stribeck_velocity = per_joint("stribeck_velocity", stribeck_velocity)
        self.rotor_inertia = per_joint("rotor_inertia", rotor_inertia)
        if np.any(self.friction_static < self.friction_coulomb):
            raise ValueError("friction_static must not be below friction_coulomb")
        if np.any(self.stribeck_velocity == 0.0):
            raise ValueError("stribeck_velocity must be positive")
        self._excess = self.friction_static - self.friction_coulomb

    @property
    def ideal(self) -> bool:
        """Whether there is no friction or rotor at all."""
        return not (self.friction_static + self.friction_viscous + self.rotor_inertia).any()

    def simulated_inertia(self, dt: float) -> Array:
        """Return the inertias I + h d of the rotors in a simulation, shape (n,), kg m^2."""
        return self.rotor_inertia + dt * self.friction_viscous

    def loads(self, v: Array, tau: Array) -> tuple[Array, Array]:
        """Return torques and friction limits of a physics step that begins with velocity `v`.

        Args:
            v: shape (n,), rad/s.
            tau: commanded torques, shape (n,), N m.

        Returns:
            The torque ``tau - d v`` and the limit L(v) of dry friction, shape (n,) each, N m.
        """
        torque = tau - self.friction_viscous * v
        falling = np.exp(-((v / self.stribeck_velocity) ** 2))
        return torque, self.friction_coulomb + self._excess * falling


class ContactFriction:
    """Coulomb friction between one link and one obstacle.

    The two are connected by a bristle: a spring of deflection s along the surface, with a little
    damping, that slips where its force reaches Coulomb's limit,

        s+ = s + h v_t,   f = -(k s+ + d v_t)   where |f| <= mu N,
        else  f = mu N f / |f|,  s+ = -f / k,

    with v_t the velocity along the surface and N the normal force, both of the last physics step.
    At rest it holds as stiction does; in motion f opposes v_t with mu N in any direction. The
    force is explicit, which is stable for links of more than about k h^2 / 4 + d h / 2, here 30 g.

    Args:
        physics_dt: the physics step h, s.
        coefficient: mu.
        stiffness: of the obstacle, which k does not exceed, N/m.

    Attributes:
        points: where the link is touched, shape (m, 7): position on the link, m; normal, from the
            obstacle to the link; normal force, N.
        force: on the link in the next step, shape (3,), N.
        point: where it acts, the centre of pressure, shape (3,), m.
    """

    def __init__(self, physics_dt: float, coefficient: float, stiffness: float) -> None:
        self._dt, self._coefficient = physics_dt, coefficient
        self._stiffness = min(stiffness, _STIFFNESS_MASS / physics_dt**2)
        self._damping = _DAMPING_MASS / physics_dt
        self._deflection = np.zeros(3)
        self.points = np.zeros((0, 7))
        self.force, self.point = np.zeros((2, 3))

    def update(self, centre: Array, velocity: Array, angular_velocity: Array) -> None:
        """Compute force and point in the next step from contacts and motion in the last.

        Args:
            centre: of the link's mass, shape (3,), m.
            velocity: of that centre, shape (3,), m/s.
            angular_velocity: of the link, shape (3,), rad/s.
        """
        pressure = self.points[:, 6]
        total = float(pressure.sum())
        weighted = pressure @ self.points[:, :6]
        self.point, normal = weighted[:3] / total, weighted[3:]
        normal /= math.sqrt(normal @ normal)
        (x, y, z), (a, b, c) = (self.point - centre).tolist(), angular_velocity.tolist()
        v = velocity + (b * z - c * y, c * x - a * z, a * y - b * x)
        v -= (v @ normal) * normal
        s = self._deflection
        s = s - (s @ normal) * normal + self._dt * v  # the surface may have turned
        force = -(self._stiffness * s + self._damping * v)
        size, limit = math.sqrt(force @ force), self._coefficient * total
        if size > limit:
            force *= limit / size
            s = force / -self._stiffness
        self.force, self._deflection = force, s
