# SPDX-License-Identifier: Apache-2.0
"""The wrench that a force/torque sensor of a robot measures.

The Newton-Euler equations of all links beyond the sensor, in a physics step from (q, v) to v+: the
arm's force on them, weight, contacts and external wrenches equal their change of momentum,

    -w + sum I g + sum f = sum (I a + v x* I v),    a = (v+ - v) / h  at each joint,

so that w, their wrench on the arm, follows from the motion, exactly as in the equations of motion
that PyBullet solves. How PyBullet transmits the force through its joints does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.bullet.obstacles import LinkWrench
from sim_bridge.urdf import ReducedArm
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import FINITE, NOT_NEGATIVE, numbers, text

Array = NDArray[np.float64]


class ForceTorqueSensor:
    """A sensor that is a link of the robot: it measures the load beyond that link.

    The link's own weight and inertia are not measured.

    Args:
        arm: model of the moving joints, and of those on the sensor.
        frame: the link; the sensor measures at its origin, in its axes.
        gravity: shape (3,), m/s^2.
        physics_dt: the physics step h, s.

    Attributes:
        wrench: force, N, and moment, N m, of the load on the sensor in the last physics step:
            contacts, external wrenches, weight and inertia; shape (6,). After a reset it is that
            of zero accelerations.
    """

    def __init__(self, arm: ReducedArm, frame: str, gravity: Array, physics_dt: float) -> None:
        # The joints on the sensor are joints of the model, which computes their forces.
        self._model = model = arm.model
        model.gravity.linear = gravity
        self._data = model.createData()
        self._frame = model.getFrameId(frame, pin.FrameType.BODY)
        self._mounts = [model.getJointId(name) for name in arm.mounts]
        self._beyond = {joint for mount in self._mounts for joint in model.subtrees[mount]}
        self._q, self._moving = arm.positions.copy(), arm.moving
        self._v, self._a = np.zeros((2, model.nv))
        self._dt = physics_dt
        self.wrench: Array = np.zeros(6)

    def update(self, q: Array, v: Array, v_next: Array, wrenches: Iterable[LinkWrench]) -> None:
        """Compute the wrench in a physics step.

        Args:
            q: PyBullet's own positions at its beginning, shape (n,), rad.
            v: velocities at its beginning, shape (n,), rad/s.
            v_next: velocities at its end, shape (n,), rad/s.
            wrenches: all external wrenches on the robot in it.
        """
        model, data = self._model, self._data
        self._q[self._moving], self._v[self._moving] = q, v
        self._a[self._moving] = (v_next - v) / self._dt
        pin.rnea(model, data, self._q, self._v, self._a)
        pin.updateGlobalPlacements(model, data)
        sensor = pin.updateFramePlacement(model, data, self._frame)
        measured = pin.Force.Zero()
        for mount in self._mounts:
            measured -= sensor.actInv(data.oMi[mount].act(data.f[mount]))
        for wrench in wrenches:
            link = model.getFrameId(wrench.link, pin.FrameType.BODY)
            if model.frames[link].parentJoint in self._beyond:
                point = wrench.point
                if point is None:
                    point = pin.updateFramePlacement(model, data, link).translation
                moment = np.cross(point, wrench.force) + wrench.torque
                measured += sensor.actInv(pin.Force(wrench.force, moment))
        self.wrench = measured.vector


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorConfiguration:
    """Parameters of a force/torque sensor."""

    ft_frame: str = text("link that is a force/torque sensor; none if empty", default="")
    ft_bias: Array = numbers(
        "bias of the sensor, force and moment, N and N m; none if empty",
        FINITE,
        length=6,
        if_empty=0.0,
    )
    ft_noise: Array = numbers(
        "standard deviation of its noise, force and moment, N and N m; none if empty",
        NOT_NEGATIVE,
        length=6,
        if_empty=0.0,
    )

    def __post_init__(self) -> None:
        """Check that there is no bias or noise without a sensor."""
        for name in ("ft_bias", "ft_noise"):
            if getattr(self, name).any() and not self.ft_frame:
                allowed = "only with a force/torque sensor, 'ft_frame'"
                raise SettingError(name, getattr(self, name), allowed)


class ForceTorqueReading:
    """The reading of a sensor: the simulated wrench, bias and noise.

    Args:
        sensor: of a robot.
        config: of that sensor.
        seed: of the noise.
    """

    def __init__(self, sensor: ForceTorqueSensor, config: SensorConfiguration, seed: int) -> None:
        self._sensor, self._config = sensor, config
        self._random = np.random.default_rng(seed)

    def read(self) -> Array:
        """Return force and moment, shape (6,), N and N m, with new noise."""
        noise = self._config.ft_noise * self._random.standard_normal(6)
        return self._sensor.wrench + self._config.ft_bias + noise
