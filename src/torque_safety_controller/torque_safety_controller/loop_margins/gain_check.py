# SPDX-License-Identifier: Apache-2.0
"""Compares gains with the largest that delay, motors and encoders of a robot allow."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.loop_margins.joint_loop import (
    Feedback,
    Link,
    ObserverGains,
    Sensing,
    filter_share,
    open_loop,
)
from viability_bounds_pkg.uncertainty import DeclaredUncertainty

Array = NDArray[np.float64]

MARGIN = 0.5
"""Modulus margin that is asked of the loop of a joint: then its gain margin is at least 2, its
phase margin at least 29 degrees, and its inertia may be 0.5 to 1.5 times that of the model."""

LIMIT_MARGIN = 0.3
"""That of a joint at its limit, where bound and disturbance observer only ever ask for less: its
inertia may be 30% off, and is assumed to be at most 20% off."""

TORQUE_STEP = 0.05
"""Share of `torque_max` by which the resolution may change a torque from period to period."""

_SCALES = 1e-4, 1e3  # of a gain
_LONGEST = 1e3  # horizon of the bounds, control periods
_BISECTIONS = 14


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotTiming:
    """Delay, bandwidth and resolution of a robot with n joints.

    Attributes:
        dt: control period, s.
        declared: delay, lag of the motors, errors of states and accelerations.
        braking: smaller limit of the acceleration, shape (n,), rad/s^2.
        horizon: of the bounds, in control periods.
        predicted: whether states are predicted through delay and lag.
        observed: whether velocities are observed, not reported.
    """

    dt: float
    declared: DeclaredUncertainty
    braking: Array
    horizon: float
    predicted: bool = False
    observed: bool = False

    @cached_property
    def links(self) -> list[Link]:
        """With the shortest and with the longest delay, and the slowest motor."""
        lag, delay = float(self.declared.motor_lag.max()), self.declared.delay
        delays = sorted({delay, delay + self.declared.delay_jitter})
        return [Link(self.dt, each, 1.0 / lag if lag > 0.0 else math.inf) for each in delays]

    @cached_property
    def observers(self) -> ObserverGains:
        """Gains of the observers, shape (n,) each."""
        design = self.declared.observers(self.dt)
        return ObserverGains(design.position_gain, design.velocity_gain)

    @cached_property
    def sensing(self) -> list[Sensing]:
        """How the slowest and the fastest observer tell the state."""
        predicted = self.declared.delay if self.predicted else None
        if not self.observed:
            return [Sensing(predicted=predicted)]
        gains = sorted(set(zip(*self.observers, strict=True)))
        return [
            Sensing(ObserverGains(*each), predicted=predicted)
            for each in dict.fromkeys((gains[0], gains[-1]))
        ]

    @cached_property
    def steps(self) -> ObserverGains:
        """Steps of position and velocity, as the controller knows them, by the resolution.

        Shape (n,) each. A position that is off by up to E changes by 2 E at once.
        """
        position, velocity = 2.0 * self.declared.position_error, 2.0 * self.declared.velocity_error
        if self.observed:
            velocity = self.observers.velocity * position
            position = self.observers.position * position
        if self.predicted:
            ahead = self.declared.delay * self.dt + self.declared.motor_lag
            position = position + ahead * velocity
        return ObserverGains(position, velocity)


class GainSettings(NamedTuple):
    """The gains that are checked.

    Attributes:
        tasks: kp and kd by the beginning of their names, `pose`, `posture` and `hold`.
        integral: lambda, 1/s; 0 for no integral action.
        leak: theta_s, theta_f, mu.
        disturbance_time: s; None for none.
    """

    tasks: dict[str, tuple[float, float]]
    integral: float
    leak: tuple[float, float, float]
    disturbance_time: float | None


class GainLimit(NamedTuple):
    """A gain, and how far it may go.

    Attributes:
        name: of the parameter.
        value: as given.
        by_margin: largest value with which the loop has its margin, or smallest; of
            `disturbance_time`, the delay.
        by_resolution: largest value with which the resolution leaves the torque calm, or
            smallest.
    """

    name: str
    value: float
    by_margin: float
    by_resolution: float

    @property
    def smallest(self) -> bool:
        """Whether the value must be at least its limit."""
        return self.name in (HORIZON, OBSERVER)

    @property
    def limit(self) -> float:
        """The stricter of both."""
        return (max if self.smallest else min)(self.by_margin, self.by_resolution)

    @property
    def exceeded(self) -> bool:
        """Whether the value is beyond the limit."""
        beyond = self.limit - self.value if self.smallest else self.value - self.limit
        return beyond > 1e-3 * abs(self.value)  # as near as the limit is found

    def __str__(self) -> str:
        """Return what to tell of a gain that is beyond its limit."""
        if math.isinf(self.limit) or self.limit == 0.0:
            least = "no value is"
        else:
            least = f"{self.limit:.3g} is the {'least' if self.smallest else 'most'}"
        return (
            f"parameter '{self.name}' is {self.value:.4g}, but with the delay, motors and "
            f"encoders declared {least} allowed: see gain_limits and docs/gains.md"
        )


HORIZON, OBSERVER = "bounds_dt_factor", "disturbance_time"
"""What must be at least, not at most, as large as its limit."""


class LimitGains(NamedTuple):
    """Slopes of the acceleration bound of a joint that rests on its limit.

    Attributes:
        kp: with the position, 1/s^2.
        kd: with the velocity, 1/s.
    """

    kp: Array
    kd: Array


def limit_gains(horizon: float, disturbance: Array, braking: Array) -> LimitGains:
    """Return how steep the bounds are where a joint rests on its limit.

    The bound ends its step with w that T w / 2 + w^2 / (2 B) = x - T v / 2 allows, x from the
    limit. It is at rest where w = T W; there dw = (2 dx - T dv) / T / (1 + 2 W / B).

    Args:
        horizon: T of the bounds, s.
        disturbance: W, shape (n,), rad/s^2.
        braking: limits of acceleration, of which W is not available, shape (n,), rad/s^2.
    """
    flatter = 1.0 / (1.0 + 2.0 * disturbance / np.maximum(braking - disturbance, 1e-9))
    return LimitGains(2.0 * flatter / horizon**2, (1.0 + flatter) / horizon)


class GainCheck:
    """Gains against the margins of the loops and the resolution.

    Args:
        gains: to check.
        timing: of the robot.
        inertia: of the arm.
        tau_max: torque limits, shape (n,), N m.
    """

    def __init__(
        self, gains: GainSettings, timing: RobotTiming, inertia: ArmInertia, tau_max: Array
    ) -> None:
        self._gains, self._timing = gains, timing
        self._inertia, self._tau_max = inertia, tau_max

    def limits(self) -> Iterator[GainLimit]:
        """Yield each gain with its limits: kp and kd of a task grow as its bandwidth does.

        Tasks are judged without the integral action; that with the fastest of them.
        """
        for task, (kp, kd) in self._gains.tasks.items():
            margin, resolution = (
                _largest_scale(good)
                for good in (
                    lambda s, kp=kp, kd=kd: self.margin(kp * s * s, kd * s, 0.0) >= MARGIN,
                    lambda s, kp=kp, kd=kd: _calm(self._step(kp * s * s, kd * s, 0.0)),
                )
            )
            if kp > 0.0:
                yield GainLimit(f"{task}_kp", kp, kp * margin**2, kp * resolution**2)
            yield GainLimit(f"{task}_kd", kd, kd * margin, kd * resolution)
        if gain := self._gains.integral:
            kp, kd = self._stiffest
            margin = _largest_scale(lambda s: self.margin(kp, kd, gain * s) >= MARGIN)
            resolution = _largest_scale(lambda s: _calm(self._step(0.0, 0.0, gain * s)))
            yield GainLimit("integral_lambda", gain, gain * margin, gain * resolution)
        if (time := self._gains.disturbance_time) is not None:
            yield GainLimit(OBSERVER, time, self._way(), self._fastest_observer())
        margin, resolution = (
            1.0 / scale if (scale := _last_good(good, 1.0 / _LONGEST, 1.0)) else math.inf
            for good in (
                lambda s: self.limit_margin(1.0 / s) >= LIMIT_MARGIN,
                lambda s: _calm(self._step_of_bounds(1.0 / s)),
            )
        )
        yield GainLimit(HORIZON, self._timing.horizon, margin, resolution)

    def margin(self, kp: float, kd: float, integral: float, observed: bool = False) -> float:
        """Return the least modulus margin, over delays, observers and postures.

        Args:
            kp: stiffness, 1/s^2.
            kd: damping, 1/s.
            integral: lambda, 1/s.
            observed: whether the disturbance observer acts.
        """
        time = self._gains.disturbance_time if observed else None
        return min(
            open_loop(
                link, sensing, Feedback(kp, kd, integral * factor, self._gains.leak, time)
            ).modulus_margin()
            for link in self._timing.links
            for sensing in self._timing.sensing
            for factor in (self._inertia.factors if integral > 0.0 else (1.0,))
        )

    @property
    def _stiffest(self) -> tuple[float, float]:
        return max(self._gains.tasks.values(), key=lambda pair: pair[1])

    def stiffest_margin(self) -> float:
        """Return the modulus margin of the task with the most damping, and integral action."""
        return self.margin(*self._stiffest, self._gains.integral)

    def limit_margin(self, factor: float) -> float:
        """Return the least modulus margin of joints at their limits, all that acts there counted.

        Args:
            factor: horizon of the bounds, in control periods.
        """
        slopes = self._slopes(factor)
        steepest = int(np.argmax(slopes.kd))
        kp, kd = float(slopes.kp[steepest]), float(slopes.kd[steepest])
        return self.margin(kp, kd, self._gains.integral, observed=True)

    def step_at_rest(self) -> Array:
        """Return the torque step that the resolution makes at rest, shape (n,), of `tau_max`.

        All encoders step at once, the worst way round.
        """
        kp, kd = np.max(list(self._gains.tasks.values()), axis=0)
        return self._step(kp, kd, self._gains.integral)

    def step_at_limits(self, factor: float) -> Array:
        """Return that of a joint that rests on its limit, shape (n,), of `tau_max`.

        Bounds, integral action and disturbance observer act there together.

        Args:
            factor: horizon of the bounds, in control periods.
        """
        time, dt = self._gains.disturbance_time, self._timing.dt
        damping = self._gains.integral
        if time is not None:
            damping += filter_share(time, dt) / dt
        return self._step_of_bounds(factor) + self._own(damping * self._timing.steps.velocity)

    def _step_of_bounds(self, factor: float) -> Array:
        slopes, steps = self._slopes(factor), self._timing.steps
        return self._own(slopes.kp * steps.position + slopes.kd * steps.velocity)

    def _way(self) -> float:
        """Return how long commands are under way that are predicted, s.

        Where they did not act, as the robot stopped itself, the predicted velocity changes at once
        by what they would have done in all that time: a so many times larger acceleration of one
        period. With at least this time constant the estimate is not larger than the change.
        """
        timing = self._timing
        return timing.declared.delay * timing.dt if timing.predicted else 0.0

    def _fastest_observer(self) -> float:
        """Return the least time constant of the disturbance observer that leaves joints calm."""
        dt = self._timing.dt
        share = TORQUE_STEP / float(self._own(self._timing.steps.velocity / dt).max() or math.inf)
        return 0.0 if share >= 1.0 or share == 0.0 else -dt / math.log1p(-share)

    def _own(self, acceleration: Array) -> Array:
        """Return the torque of joints' accelerations one by one, shape (n,), of `tau_max`."""
        torque: Array = self._inertia.diagonal * acceleration / self._tau_max
        return torque

    def _slopes(self, factor: float) -> LimitGains:
        timing = self._timing
        horizon = factor * timing.dt
        return limit_gains(horizon, timing.declared.acceleration_disturbance, timing.braking)

    def _step(self, kp: float, kd: float, integral: float) -> Array:
        steps = self._timing.steps
        torque = self._inertia.torque(kp * steps.position + kd * steps.velocity)
        return self._own(integral * steps.velocity) + torque / self._tau_max


def _calm(steps: Array) -> bool:
    return bool((steps <= TORQUE_STEP).all())


def _largest_scale(good: Callable[[float], bool]) -> float:
    """Return the largest factor for which `good` holds; infinite if there is none in reach."""
    scale = _last_good(good, *_SCALES)
    return math.inf if scale == _SCALES[1] else scale


def _last_good(good: Callable[[float], bool], low: float, high: float) -> float:
    """Return the largest number between for which `good` holds, as it does below; 0 for none."""
    if good(high):
        return high
    if not good(low):
        return 0.0
    for _ in range(_BISECTIONS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low
