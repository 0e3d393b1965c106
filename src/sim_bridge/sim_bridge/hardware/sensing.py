# SPDX-License-Identifier: Apache-2.0
"""What a robot reports of its joints: encoders, the drive's velocity, noise and delay."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hardware.imperfections import Imperfections
from sim_bridge.hardware.noise import ClippedNoise, Stream

Array = NDArray[np.float64]


class JointReading(NamedTuple):
    """What the drives report, arrays of shape (n,)."""

    q: Array  # positions, rad
    v: Array  # velocities, rad/s
    effort: Array  # torques that the drives believe to give, N m


class Encoders:
    """Position sensors of finite resolution, with noise that is there before it is rounded.

    Args:
        resolution: of each, shape (n,), rad; 0: exact.
        noise: of the positions.
    """

    def __init__(self, resolution: Array, noise: ClippedNoise) -> None:
        self._coarse = resolution > 0.0
        self._step = np.where(self._coarse, resolution, 1.0)
        self._noise = noise

    def read(self, q: Array) -> Array:
        """Return the readings at positions `q`, shape (n,), rad: whole steps."""
        noisy = self._noise.added_to(q)
        return np.where(self._coarse, self._step * np.rint(noisy / self._step), noisy)


class Sensing:
    """The readings of all joints, one in each control period.

    Args:
        imperfections: which ones there are.
        torque_max: torque limits of the motors, shape (n,), N m.
        dt: control period, s.
    """

    def __init__(self, imperfections: Imperfections, torque_max: Array, dt: float) -> None:
        given, seed = imperfections, imperfections.imperfection_seed
        self._dt, self._delay = dt, given.state_delay
        position_noise = ClippedNoise(given.position_noise, seed, Stream.POSITION)
        self._velocity_noise = ClippedNoise(given.velocity_noise, seed, Stream.VELOCITY)
        self._effort_noise = ClippedNoise(
            given.current_noise * torque_max, seed, Stream.REPORTED_CURRENT
        )
        self._noises = position_noise, self._velocity_noise, self._effort_noise
        self._encoders = Encoders(given.encoder_resolution, position_noise)
        self._by_difference = given.velocity_source == "encoder"
        # v' = omega (u - v), exact for inputs that are constant in a period; 0 without a filter.
        self._filter_gain = -math.expm1(-2.0 * math.pi * given.velocity_filter_hz * dt)

    def reset(self, q: Array, v: Array, effort: Array) -> JointReading:
        """Begin anew at a state that has lasted for long; return its reading."""
        for noise in self._noises:
            noise.reset()
        self._last = self._encoders.read(q)
        self._filtered = v
        first = JointReading(
            self._last, self._velocity_noise.added_to(v), self._effort_noise.added_to(effort)
        )
        self._under_way = deque([first] * self._delay)
        return first

    def read(self, q: Array, v: Array, effort: Array) -> JointReading:
        """Return the reading one control period later, that of a delayed state.

        Args:
            q: true positions, shape (n,), rad.
            v: true velocities, shape (n,), rad/s.
            effort: torques that the drives believe to give, shape (n,), N m.
        """
        position = self._encoders.read(q)
        if self._by_difference:
            v = (position - self._last) / self._dt
        self._last = position
        if self._filter_gain > 0.0:
            v = self._filtered = self._filtered + self._filter_gain * (v - self._filtered)
        self._under_way.append(
            JointReading(
                position, self._velocity_noise.added_to(v), self._effort_noise.added_to(effort)
            )
        )
        return self._under_way.popleft()
