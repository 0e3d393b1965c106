# SPDX-License-Identifier: Apache-2.0
"""Compares gains with the largest that delay, motors and encoders of a robot allow.

`docs/gains.md` derives the limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.loop_margins.joint_loop import Feedback, Link, open_loop
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.robot.configuration import load_model

Array = NDArray[np.float64]

MARGIN = 0.5
"""Modulus margin that is asked of the loop of a joint: then its gain margin is at least 2, its
phase margin at least 29 degrees, and its inertia may be 0.5 to 1.5 times that of the model."""

LIMIT_MARGIN = 0.3
"""That of a joint at its limit, where bound and disturbance observer only ever ask for less: its
inertia may be 30% off, and is assumed to be at most 20% off."""

TORQUE_STEP = 0.05
"""Share of `torque_max` by which the resolution may change a torque from period to period."""

HORIZON, OBSERVER = "bounds_dt_factor", "disturbance_time"
"""What must be at least, not at most, as large as its limit."""

_SCALES = 1e-4, 1e3  # of a gain
_LONGEST = 1e3  # horizon of the bounds, control periods
_BISECTIONS = 14
_POSTURES, _SEED = 200, 0


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


class ArmInertia:
    """Mass matrices of an arm at random postures within its position limits.

    With M = D^(1/2) Q S^-1 Q' D^(1/2), D = diag(M), the torque M a_ref + lambda D s falls apart
    into n loops of one joint each, which differ in the gain of the integral action only: lambda
    times a number of S. The numbers 1 / S are at least 0 and n in the mean over 1: coupled joints
    have some far above 1.

    Args:
        model: n joints with one coordinate each.
        q_min: lower position limits, shape (n,), rad; perhaps infinite.
        q_max: upper ones, shape (n,), rad.

    Attributes:
        matrices: M, shape (N, n, n), kg m^2.
        factors: smallest and largest number of S anywhere.
        diagonal: largest inertia of each joint, shape (n,), kg m^2.
    """

    def __init__(self, model: pin.Model, q_min: Array, q_max: Array) -> None:
        low, high = np.maximum(q_min, -math.pi), np.minimum(q_max, math.pi)
        data, random = model.createData(), np.random.default_rng(_SEED)
        self.matrices = np.array(
            [pin.crba(model, data, random.uniform(low, high)).copy() for _ in range(_POSTURES)]
        )
        diagonals = np.diagonal(self.matrices, axis1=1, axis2=2)
        self.diagonal: Array = diagonals.max(axis=0)
        scale = 1.0 / np.sqrt(diagonals)
        shares = np.linalg.eigvalsh(self.matrices * scale[:, :, None] * scale[:, None, :])
        self.factors = 1.0 / float(shares.max()), 1.0 / float(shares.min())


def limit_gains(horizon: float, disturbance: Array, braking: Array) -> tuple[Array, Array]:
    """Return kp, 1/s^2, and kd, 1/s, of a joint that rests on its limit: slopes of its bound.

    The bound ends its step with w that T w / 2 + w^2 / (2 B) = x - T v / 2 allows, x from the
    limit. It is at rest where w = T W; there dw = (2 dx - T dv) / T / (1 + 2 W / B).

    Args:
        horizon: T of the bounds, s.
        disturbance: W, shape (n,), rad/s^2.
        braking: limits of acceleration, of which W is not available, shape (n,), rad/s^2.
    """
    flatter = 1.0 / (1.0 + 2.0 * disturbance / np.maximum(braking - disturbance, 1e-9))
    return 2.0 * flatter / horizon**2, (1.0 + flatter) / horizon


class GainCheck:
    """Gains of a controller against the margins of its loops and the resolution of its encoders.

    Args:
        config: of the controller.
        robot: what is declared of the robot, and the horizon of the bounds.

    Attributes:
        inertia: of the arm.
        tasks: kp and kd by the beginning of their names, `pose`, `posture` and `hold`.
        integral: lambda, 1/s; 0 for no integral action.
        steps: of position, rad, and velocity, rad/s, that the resolution makes of what the
            controller knows, shape (n,) each.
    """

    def __init__(self, config: ControllerConfiguration, robot: BoundsConfiguration) -> None:
        gains, declared, dt = config.gains, robot.declared, robot.dt
        model = load_model(config, config.read_urdf())
        self._limits, self._tau_max = robot.limits, config.torque_max
        self._dt, self._horizon, self._declared = dt, robot.horizon, declared
        self._predicts = config.use_estimated_states
        self._observer_time = gains.disturbance_time
        self.inertia = ArmInertia(model, robot.limits.q_min, robot.limits.q_max)
        tasks = {
            "pose": (gains.pose_kp, gains.pose_kd if gains.pose_weight > 0.0 else 0.0),
            "posture": (gains.posture_kp, gains.posture_kd),
            "hold": (0.0, gains.hold_kd),
        }
        self.tasks = {name: pair for name, pair in tasks.items() if pair[1] > 0.0}
        integral, acts = config.integral_settings, config.integral.integral_action != "none"
        self.integral = integral.gain if acts else 0.0
        self._leak = integral.slow_leak_rate, integral.fast_leak_rate, integral.mu
        observers = None
        if self._predicts and robot.velocity_estimation:
            design = declared.observers(dt)
            observers = design.position_gain, design.velocity_gain
        self._links = self._all_links(observers)
        # A position that is off by up to E changes by 2 E at once.
        position, velocity = 2.0 * declared.position_error, 2.0 * declared.velocity_error
        if observers is not None:
            position, velocity = observers[0] * position, observers[1] * position
        if self._predicts:
            position = position + (declared.delay * dt + declared.motor_lag) * velocity
        self.steps = position, velocity

    def _all_links(self, observers: tuple[Array, Array] | None) -> list[Link]:
        """Return loops with shortest and longest delay, slowest motor, both ends of observers."""
        declared = self._declared
        ends: list[tuple[float, float] | None] = [None]
        if observers is not None:
            pairs = sorted(zip(*(each.tolist() for each in observers), strict=True))
            ends = list(dict.fromkeys((pairs[0], pairs[-1])))
        lag, predicted = float(declared.motor_lag.max()), declared.delay
        return [
            Link(self._dt, delay, lag, observer, predicted if self._predicts else None)
            for delay in sorted({declared.delay, declared.delay + declared.delay_jitter})
            for observer in ends
        ]

    def limits(self) -> Iterator[GainLimit]:
        """Yield each gain with its limits: kp and kd of a task grow as its bandwidth does.

        Tasks are judged without the integral action; that with the fastest of them.
        """
        for task, (kp, kd) in self.tasks.items():
            margin = _largest_scale(self._has_margin, kp, kd)
            resolution = _largest_scale(self._is_calm, kp, kd)
            if kp > 0.0:
                yield GainLimit(f"{task}_kp", kp, kp * margin**2, kp * resolution**2)
            yield GainLimit(f"{task}_kd", kd, kd * margin, kd * resolution)
        if gain := self.integral:
            kp, kd = max(self.tasks.values(), key=lambda pair: pair[1])
            margin = _largest_scale(
                lambda s, kp, kd: self.margin(kp, kd, gain * s) >= MARGIN, kp, kd
            )
            step = self._own(gain * self.steps[1])
            resolution = TORQUE_STEP / step if step > 0.0 else math.inf
            yield GainLimit("integral_lambda", gain, gain * margin, gain * resolution)
        if time := self._observer_time:
            # Where commands under way did not act, as the robot stopped itself, the predicted
            # velocity changes at once by what they would have done in all that time. With at least
            # this time constant the estimate is not larger than the change.
            way = self._declared.delay * self._dt if self._predicts else 0.0
            yield GainLimit(OBSERVER, time, way, self._fastest_observer())
        margin, resolution = (
            1.0 / scale if (scale := _last_good(good, 1.0 / _LONGEST, 1.0)) else math.inf
            for good in (
                lambda s: self.limit_margin(1.0 / s) >= LIMIT_MARGIN,
                lambda s: self._calm_on_limits(1.0 / s),
            )
        )
        yield GainLimit(HORIZON, self._horizon / self._dt, margin, resolution)

    def margin(self, kp: float, kd: float, integral: float, observed: bool = False) -> float:
        """Return the least modulus margin, over delays, observers and postures.

        Args:
            kp: stiffness, 1/s^2.
            kd: damping, 1/s.
            integral: lambda, 1/s.
            observed: whether the disturbance observer acts.
        """
        time = self._observer_time if observed else 0.0
        factors = self.inertia.factors if integral > 0.0 else (1.0,)
        return min(
            open_loop(link, Feedback(kp, kd, integral * f, self._leak, time)).modulus_margin()
            for link in self._links
            for f in factors
        )

    def limit_margin(self, factor: float) -> float:
        """Return the least modulus margin of joints at their limits, all that acts there counted.

        Args:
            factor: horizon of the bounds, in control periods.
        """
        kp, kd = self._slopes(factor)
        steepest = int(np.argmax(kd))
        return self.margin(float(kp[steepest]), float(kd[steepest]), self.integral, observed=True)

    def _slopes(self, factor: float) -> tuple[Array, Array]:
        braking = np.minimum(-self._limits.a_min, self._limits.a_max)
        disturbance = self._declared.acceleration_disturbance
        return limit_gains(factor * self._dt, disturbance, braking)

    def _has_margin(self, scale: float, kp: float, kd: float) -> bool:
        return self.margin(kp * scale**2, kd * scale, 0.0) >= MARGIN

    def _is_calm(self, scale: float, kp: float, kd: float) -> bool:
        """Return whether encoders that all step at once, the worst way round, change little."""
        position, velocity = self.steps
        accelerations = kp * scale**2 * position + kd * scale * velocity
        torque = np.abs(self.inertia.matrices) @ accelerations
        return bool((torque.max(axis=0) <= TORQUE_STEP * self._tau_max).all())

    def _calm_on_limits(self, factor: float) -> bool:
        (kp, kd), (position, velocity) = self._slopes(factor), self.steps
        return self._own(kp * position + kd * velocity) <= TORQUE_STEP

    def _own(self, acceleration: Array) -> float:
        """Return the largest torque of joints' accelerations one by one, of `torque_max`."""
        return float((self.inertia.diagonal * acceleration / self._tau_max).max())

    def _fastest_observer(self) -> float:
        """Return the least time constant of the disturbance observer that leaves joints calm."""
        dt = self._dt
        share = TORQUE_STEP / (self._own(self.steps[1] / dt) or math.inf)
        return 0.0 if share >= 1.0 or share == 0.0 else -dt / math.log1p(-share)


def _largest_scale(good: Callable[[float, float, float], bool], kp: float, kd: float) -> float:
    """Return the largest factor for which `good` holds; infinite if there is none in reach."""
    scale = _last_good(lambda s: good(s, kp, kd), *_SCALES)
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
