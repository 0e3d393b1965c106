# SPDX-License-Identifier: Apache-2.0
"""Command line tool that prints gains beside the largest that a robot allows.

Reads a robot's parameter files: delay, bandwidth of the motors and resolution of the encoders, as
declared for bounds_node, and the gains of controller_node. `docs/guides/tuning.md` derives the
limits.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.loop_margins import (
    ArmInertia,
    Feedback,
    Link,
    limit_gains,
    open_loop,
)
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import CONTROLLER, NODE
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter_files import read_files
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


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="gain_limits",
        description="Print a robot's gains beside the largest that its delay, its motors and the "
        "resolution of its encoders permit.",
        epilog=f"The loop of a joint keeps a modulus margin of {MARGIN:g}, that of a joint at its "
        f"limit {LIMIT_MARGIN:g}; at rest a step of the encoders changes no torque by more than "
        f"{TORQUE_STEP:.0%} of torque_max a period. docs/guides/tuning.md derives both. "
        "Exit code 1: a gain is beyond its limit.",
    )
    parser.add_parameter_files()
    return parser.parse_args(arguments)


def gain_check(files: Sequence[Path]) -> GainCheck:
    """Return the check of the gains in a robot's parameter files."""
    config = read_files(ControllerConfiguration, files, CONTROLLER)
    return GainCheck(config, read_files(BoundsConfiguration, files, NODE))


def _run(options: argparse.Namespace) -> int:
    limits = list(gain_check(options.params_file).limits())
    print(f"{'':18}{'given':>10}{'by margin':>14}{'by resolution':>16}")
    for limit in limits:
        sign = ">=" if limit.smallest else "<="
        margin, resolution = (
            f"{sign} {value:.4g}" if np.isfinite(value) and value > 0.0 else "-"
            for value in (limit.by_margin, limit.by_resolution)
        )
        verdict = "  exceeded" if limit.exceeded else ""
        print(f"{limit.name:18}{limit.value:10.4g}{margin:>14}{resolution:>16}{verdict}")
    return int(any(limit.exceeded for limit in limits))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, 1 if a gain is beyond its limit, or for an error."""
    options = _parse(arguments)
    return run_tool("gain_limits", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
