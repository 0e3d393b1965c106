# SPDX-License-Identifier: Apache-2.0
"""Imperfect hardware: encoders, drives and motors of a real robot.

With the torque u that a drive is asked for, the torque T that it believes to give follows

    T' = omega (u - T).

u is constant in a physics step of length h, so that at the end of the step, and on average,

    T+ = u + (T - u) exp(-omega h),    T_mean = u + (T - u) (1 - exp(-omega h)) / (omega h).

The mean accelerates the joints in the step: then a joint's velocity changes by the integral of T,
without an error of the discretisation. The true torque is

    tau = clip((1 + e) T_mean + r tau_max sin(N q) + n, -tau_max, tau_max)

with an error e of the torque constant, ripple of amplitude r, N periods a turn, and noise n of the
current.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    Range,
    joint_amounts,
    joint_numbers,
    number,
    periods,
    text,
    whole_number,
)

Array = NDArray[np.float64]

NOISE_CLIP = 3.0
"""Standard deviations at which noise is clipped, so that there is a largest error."""
RIPPLE_PERIODS = 200
"""Periods of torque ripple in one turn of a joint: a harmonic drive has two in each turn of its
motor, and a gear ratio of 100 is assumed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Imperfections:
    """Parameters of imperfect hardware; arrays of shape (n,)."""

    encoder_resolution: Array = joint_amounts("step of the encoders, rad; 0 or empty: exact")
    position_noise: Array = joint_amounts(
        "standard deviation of the encoders' noise, rad; none if empty"
    )
    velocity_source: str = text(
        "exact: the true velocity; encoder: difference of encoder positions over a period",
        default="exact",
        choices=("exact", "encoder"),
    )
    velocity_filter_hz: float = number(
        "first-order low-pass of the velocity, Hz; 0: none",
        Range(0.0, 5000.0),
        default=0.0,
        note="below half of rate_hz",
    )
    velocity_noise: Array = joint_amounts(
        "standard deviation of the velocity's noise, rad/s; none if empty"
    )
    state_delay: int = periods("control periods by which states are reported late")
    command_delay: int = periods("control periods by which commands act late")
    motor_bandwidth: Array = joint_amounts(
        "bandwidth of the motors' torque, a first-order lag, Hz; 0 or empty: infinite"
    )
    torque_constant_error: Array = joint_numbers(
        "share by which the true torque exceeds the reported one; 0 if empty",
        Range(-0.5, 0.5),
        if_empty=0.0,
    )
    torque_ripple: Array = joint_numbers(
        "amplitude of torque ripple, share of torque_max; 0 if empty",
        Range(0.0, 0.5),
        if_empty=0.0,
    )
    current_noise: Array = joint_numbers(
        "standard deviation of the noise of torque and of reported effort, share of torque_max;"
        " 0 if empty",
        Range(0.0, 0.2),
        if_empty=0.0,
    )
    missed_probability: float = number(
        "probability that a command misses its period; the last one is held",
        Range(0.0, 1.0, without=1.0),
        default=0.0,
    )
    missed_in_row: int = whole_number(
        "largest number of consecutive missed periods", Range(1, 1000), default=4
    )
    outage_probability: float = number(
        "probability that an outage starts, in which all commands are lost",
        Range(0.0, 1.0, without=1.0),
        default=0.0,
    )
    outage_longest: int = whole_number(
        "longest outage, control periods",
        Range(1, 10_000),
        default=100,
    )
    imperfection_seed: int = whole_number(
        "seed of all random numbers", Range(0, 2**31 - 1), default=0
    )

    def check_rate(self, rate_hz: float) -> None:
        """Check that the velocity filter is below half of the control rate.

        Raises:
            SettingError: it is not.
        """
        if not self.velocity_filter_hz < 0.5 * rate_hz:
            allowed = f"a number below half of rate_hz, {0.5 * rate_hz:g}; 0: no filter"
            raise SettingError("velocity_filter_hz", self.velocity_filter_hz, allowed)

    @property
    def motor_lag(self) -> Array:
        """Time constant of the motors' torque, shape (n,), s; 0 without a lag."""
        omega = 2.0 * np.pi * self.motor_bandwidth
        return np.divide(1.0, omega, out=np.zeros_like(omega), where=omega > 0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that make a difference."""
        named = ((each.name, getattr(self, each.name)) for each in fields(self))
        on = {n: v != "exact" if isinstance(v, str) else bool(np.any(v)) for n, v in named}
        return tuple(name for name in on if on[name] and name not in _DETAILS)

    @property
    def of_motors(self) -> bool:
        """Whether torques differ from those asked for."""
        return not _MOTORS.isdisjoint(self.names)


_MOTORS = {"motor_bandwidth", "torque_constant_error", "torque_ripple", "current_noise"}
_DETAILS = {"missed_in_row", "outage_longest", "imperfection_seed"}  # without effect alone


class RandomStream(IntEnum):
    """Kinds of random error; switching one on does not change the numbers of the others."""

    POSITION = 0
    VELOCITY = 1
    REPORTED_CURRENT = 2
    MOTOR_CURRENT = 3
    MISSED_DEADLINES = 4
    OUTAGES = 5


class ClippedNoise:
    """White normal noise, clipped at `NOISE_CLIP` standard deviations.

    Args:
        deviation: standard deviations before clipping, shape (n,), not negative.
        seed: of the random numbers.
        stream: of the random numbers.
    """

    def __init__(self, deviation: Array, seed: int, stream: RandomStream) -> None:
        self._deviation, self._source = deviation, [seed, stream]
        self._on = bool(deviation.any())
        self.reset()

    def reset(self) -> None:
        """Restart the sequence."""
        self._random = np.random.default_rng(self._source)

    def added_to(self, value: Array) -> Array:
        """Return `value` with new noise, shape (n,)."""
        if not self._on:
            return value
        draw = self._random.standard_normal(value.size)
        return value + self._deviation * np.clip(draw, -NOISE_CLIP, NOISE_CLIP)


class JointReading(NamedTuple):
    """Joint state that the drives report, arrays of shape (n,)."""

    q: Array  # positions, rad
    v: Array  # velocities, rad/s
    effort: Array  # torques that the drives believe to give, N m


class Sensing:
    """Joint readings with finite resolution, noise, a velocity filter and delay.

    Args:
        imperfections: which ones there are.
        torque_max: torque limits of the motors, shape (n,), N m.
        dt: control period, s.
    """

    def __init__(self, imperfections: Imperfections, torque_max: Array, dt: float) -> None:
        given, seed = imperfections, imperfections.imperfection_seed
        self._dt, self._delay = dt, given.state_delay
        self._coarse = given.encoder_resolution > 0.0
        self._any_coarse = bool(self._coarse.any())
        self._resolution = np.where(self._coarse, given.encoder_resolution, 1.0)
        self._position_noise = ClippedNoise(given.position_noise, seed, RandomStream.POSITION)
        self._velocity_noise = ClippedNoise(given.velocity_noise, seed, RandomStream.VELOCITY)
        self._effort_noise = ClippedNoise(
            given.current_noise * torque_max, seed, RandomStream.REPORTED_CURRENT
        )
        self._from_encoder = given.velocity_source == "encoder"
        # v' = omega (u - v), exact for inputs that are constant in a period; 0 without a filter.
        self._filter_gain = -math.expm1(-2.0 * math.pi * given.velocity_filter_hz * dt)

    def reset(self, q: Array, v: Array, effort: Array) -> JointReading:
        """Restart at a state that has lasted for long; return its reading."""
        for noise in (self._position_noise, self._velocity_noise, self._effort_noise):
            noise.reset()
        self._last, self._filtered = self.encoders(q), v
        first = self._reading(v, effort)
        self._delayed = deque([first] * self._delay)
        return first

    def read(self, q: Array, v: Array, effort: Array) -> JointReading:
        """Return the reading one control period later, that of a delayed state.

        Args:
            q: true positions, shape (n,), rad.
            v: true velocities, shape (n,), rad/s.
            effort: torques that the drives believe to give, shape (n,), N m.
        """
        position = self.encoders(q)
        if self._from_encoder:
            v = (position - self._last) / self._dt
        self._last = position
        if self._filter_gain > 0.0:
            v = self._filtered = self._filtered + self._filter_gain * (v - self._filtered)
        self._delayed.append(self._reading(v, effort))
        return self._delayed.popleft()

    def encoders(self, q: Array) -> Array:
        """Return whole encoder steps at positions `q`, with new noise, shape (n,), rad."""
        noisy = self._position_noise.added_to(q)
        if not self._any_coarse:
            return noisy
        steps = self._resolution * np.rint(noisy / self._resolution)
        return np.where(self._coarse, steps, noisy)

    def _reading(self, v: Array, effort: Array) -> JointReading:
        v, effort = self._velocity_noise.added_to(v), self._effort_noise.added_to(effort)
        return JointReading(self._last, v, effort)


class Motors:
    """Motors of n joints with a bandwidth and torque errors.

    They are off after a reset and while the brakes hold. When they are switched on, their torque
    is at once what is asked for: the brakes are opened when the motors carry the load.

    Args:
        imperfections: which ones there are.
        torque_max: torque limits, shape (n,), N m; no torque is beyond them, errors included.
        physics_dt: the physics step, s.

    Attributes:
        believed: torque that the drives believe to give, at the end of the last physics step,
            shape (n,), N m; None while they are off.
    """

    def __init__(self, imperfections: Imperfections, torque_max: Array, physics_dt: float) -> None:
        given = imperfections
        x = 2.0 * math.pi * given.motor_bandwidth * physics_dt
        lag = x > 0.0
        self._decay = np.where(lag, np.exp(-x), 0.0)
        self._mean = np.where(lag, -np.expm1(-x) / np.where(lag, x, 1.0), 0.0)
        self._gain = 1.0 + given.torque_constant_error
        self._ripple = given.torque_ripple * torque_max
        self._noise = ClippedNoise(
            given.current_noise * torque_max, given.imperfection_seed, RandomStream.MOTOR_CURRENT
        )
        self._limit = torque_max
        self.believed: Array | None = None

    def reset(self) -> None:
        """Switch the motors off and restart the noise."""
        self._noise.reset()
        self.believed = None

    def switch_off(self) -> None:
        """Switch the motors off."""
        self.believed = None

    def step(self, asked: Array, q: Array) -> Array:
        """Return the true torque in the next physics step, shape (n,), N m.

        Args:
            asked: torques that the drives are asked for, shape (n,), N m.
            q: positions of the joints, shape (n,), rad.
        """
        gap = (asked if self.believed is None else self.believed) - asked
        self.believed = asked + self._decay * gap
        mean = asked + self._mean * gap
        torque = self._gain * mean + self._ripple * np.sin(RIPPLE_PERIODS * q)
        return np.clip(self._noise.added_to(torque), -self._limit, self._limit)
