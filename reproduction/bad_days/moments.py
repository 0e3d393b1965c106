# SPDX-License-Identifier: Apache-2.0
"""What faults at random moments do to an arm in motion, and whether it is as it should be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from figure import verdict

from sim_bridge.bullet.limit_monitor import LimitMonitor

ROBOTS = ("panda", "talos_left_arm")
EVERY = (*ROBOTS, "baxter_left_arm")
STIFF = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
"""Gains by which joint goals drive the joints at their limits."""
RETURN = 0.1  # s after the arm goes on in which torque steps count: later ones are of the motion
HOLD_IN_TIME = 0.1  # s, where the controller brakes
STEP = 0.02  # of tau_max, when the arm goes on
AGAIN = 2.0  # s
BEFORE = RETURN  # s before a fault in which the arm has to be under way
HEADS = (
    *("robot", "fault", "moments", "position, rad", "speed, rad/s", "torque"),
    *("periods to braking", "by", "again, s", "torque step", "before", ""),
)
"""Of a table whose rows have a robot, a fault, and `Seen.cells`."""


def at_rate(by_node: Mapping[str, Mapping[str, Any]], rate: float | None) -> dict[str, Any]:
    """Return what differs for each node at a lower rate than a robot's file is made for.

    The integral gain would be too high, and what the bounds keep back is for what friction does in
    a period, which is longer.

    Args:
        by_node: parameters of each node, by its name, as its file has them.
        rate: of the control loop, Hz; None for the file's own.
    """
    changes: dict[str, Any] = {name: {} for name in by_node}
    own = by_node["bullet_node"]
    if rate is None:
        return changes
    for name in changes:
        changes[name]["rate_hz"] = rate
    share = min(1.0, rate / own["rate_hz"])
    if gain := by_node["controller_node"].get("integral_lambda"):
        changes["controller_node"]["integral_lambda"] = share * gain
    bounds = by_node["bounds_node"]
    v_max, slower = np.array(own["velocity_max"]), np.array(bounds["velocity_max"])
    changes["bounds_node"]["velocity_max"] = (v_max - (v_max - slower) / share).tolist()
    changes["bounds_node"]["position_margin"] = bounds["position_margin"] / share
    if row := own.get("missed_in_row"):  # imperfect: what lasts is as long as it was, in s
        delays = math.floor(share * own["state_delay"]), math.ceil(share * own["command_delay"])
        row = math.ceil(share * row)
        finer = share * share  # encoders, so that estimates of accelerations are as good
        error = [finer * each for each in own["position_error"]]
        for each in changes.values():
            each |= {"delay": sum(delays), "missed_deadlines": row, "position_error": error}
        changes["bounds_node"]["bounds_dt_factor"] = share * bounds["bounds_dt_factor"]
        changes["bullet_node"] |= {
            "encoder_resolution": [finer * each for each in own["encoder_resolution"]],
            "state_delay": delays[0],
            "command_delay": delays[1],
            "missed_in_row": row,
            "command_timeout": row,
        }
    return changes


def parameter_words(node: str, values: Mapping[str, Any]) -> list[str]:
    """Return parameters of a node as words of a command line."""
    pairs = [
        f"{node}:{name}:={str(value).lower() if isinstance(value, bool) else value}"
        for name, value in values.items()
    ]
    return [word for pair in pairs for word in ("-p", pair)]


class Sample(NamedTuple):
    """What an arm does in a control period.

    Attributes:
        t: stamp of its state, s.
        braking: whether it is brought to rest, by the controller or by itself.
        stopped: whether it is by itself.
        tau: torques of its motors, shape (n,), N m.
    """

    t: float
    braking: bool
    stopped: bool
    tau: np.ndarray


@dataclass
class Seen:
    """What one kind of fault did at all its moments.

    Attributes:
        position, speed, torque: worst beyond limits, rad, rad/s, and share of torque_max.
        braking: periods until the arm braked, one for each moment; NaN where it did not.
        by_robot: whether it was the robot's own stop that braked first.
        under_way: whether nothing had braked the arm just before; empty where not looked at.
        again: time until it went on, s.
        steps: largest change of torque in a period as it went on, share of torque_max.
        steps_before: the same in as long a time before the fault, if nothing braked the arm:
            what motion and new goals do by themselves.
        lasted: how long the faults were there, s.
        brakes: whether the arm has to brake; where not, it may for other reasons.
        believed: wrong states that are answered at most before they are told.
        timeout: periods for which the robot holds a command before it stops itself.
    """

    position: float = 0.0
    speed: float = 0.0
    torque: float = 0.0
    braking: list[float] = field(default_factory=list)
    by_robot: list[bool] = field(default_factory=list)
    under_way: list[bool] = field(default_factory=list)
    again: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    steps_before: list[float] = field(default_factory=list)
    lasted: list[float] = field(default_factory=list)
    timeout: int = 0
    brakes: bool = True
    believed: int = 0

    def note_limits(self, monitor: LimitMonitor) -> None:
        """Add what a robot saw at its physics steps."""
        self.position = max(self.position, float(monitor.max_position_violation.max()))
        self.speed = max(self.speed, float(monitor.max_velocity_violation.max()))
        self.torque = max(self.torque, float(monitor.max_torque_ratio.max()))

    def note_moment(
        self,
        trace: Sequence[Sample],
        begin: float,
        end: float,
        dt: float,
        tau_max: np.ndarray,
    ) -> None:
        """Add what the trace shows of a fault.

        Args:
            trace: from before the fault until after the arm went on.
            begin: of the fault, s, by the stamps.
            end: of it.
            dt: control period, s.
            tau_max: torque limits, shape (n,), N m.
        """
        t = np.array([each.t for each in trace])
        braking, stopped = (np.array([each[k] for each in trace], dtype=bool) for k in (1, 2))
        before = (t < begin) & (t >= begin - BEFORE)
        tau = np.array([each.tau for each in trace])
        if before.any():
            self.under_way.append(not braking[before].any())
            if self.under_way[-1]:
                self.steps_before += _largest_step(tau[before], tau_max)
        first = np.flatnonzero((t >= begin) & (t < end) & braking)
        if first.size:
            by_robot = bool(stopped[first[0]])
            # A state shows what the robot has done in the period before it.
            self.braking.append(max(0, round((t[first[0]] - begin) / dt) - by_robot))
            self.by_robot.append(by_robot)
        else:
            self.braking.append(np.nan)
            self.by_robot.append(False)
        self.lasted.append(end - begin)
        after = np.flatnonzero((t >= end) & ~braking)
        self.again.append(float(t[after[0]] - end) if after.size else np.inf)
        if not after.size or (self.brakes and not first.size):
            return
        back = after[0]
        if not (self.brakes or braking[max(back - 1, 0)]):
            return  # it had not been brought to rest, or had gone on before
        last = np.flatnonzero((t > t[back] + RETURN) | ((t > t[back]) & braking))
        stop = last[0] if last.size else len(trace)
        self.steps += _largest_step(tau[max(back - 1, 0) : stop], tau_max)

    def wrong(self, dt: float) -> list[str]:
        """Return what is not as it should be, in words.

        Args:
            dt: control period, s.
        """
        wrong = []
        if self.position > 0.0 or self.speed > 0.0 or self.torque > 1.0 + 1e-9:
            wrong.append("a limit was passed")
        if self.under_way and np.mean(self.under_way) < 0.5:
            wrong.append("mostly at rest before")  # what it shows of limits and steps is little
        stop = self.believed + self.timeout + 1
        in_time = np.where(np.array(self.by_robot), stop, HOLD_IN_TIME / dt)
        if self.brakes and not (np.array(self.braking) <= in_time).all():  # nor where it did not
            wrong.append("braking")
        if max(self.again, default=0.0) > AGAIN:
            wrong.append("not in time again")
        if self.steps and max(self.steps) > STEP:
            wrong.append("torque step")
        return wrong

    def cells(self, dt: float) -> tuple[str, ...]:
        """Return the cells of a row, from the number of moments on; `dt` as in `wrong`."""
        braked, robots, wrong = np.array(self.braking), np.array(self.by_robot), self.wrong(dt)
        some = np.isfinite(braked).any()
        return (
            str(len(braked)),
            f"{self.position:.2g}",
            f"{self.speed:.2g}",
            f"{self.torque:.3f}",
            f"{np.nanmedian(braked):.0f} to {np.nanmax(braked):.0f}" if some else "-",
            "robot" if robots.any() else "controller" if some else "-",
            f"{max(self.again):.2f}" if self.again else "-",
            *(f"{max(each):.3f}" if each else "-" for each in (self.steps, self.steps_before)),
            verdict(not wrong, "kept") + (f": {', '.join(wrong)}" if wrong else ""),
        )


def _largest_step(tau: np.ndarray, tau_max: np.ndarray) -> list[float]:
    """Return the largest change of torques, shape (k, n), between periods; empty without one."""
    tau = tau[np.isfinite(tau).all(axis=1)]
    return [float((np.abs(np.diff(tau, axis=0)) / tau_max).max())] if len(tau) > 1 else []


class Corners:
    """Goals at random: most joints at an end of their range.

    Args:
        values: parameters of a robot.
        rng: random numbers.
    """

    def __init__(self, values: Mapping[str, Any], rng: np.random.Generator) -> None:
        self._rng = rng
        self._low = np.maximum(values["position_min"], -np.pi)
        self._high = np.minimum(values["position_max"], np.pi)

    def draw(self) -> np.ndarray:
        """Return one, shape (n,), rad."""
        n = self._low.size
        at_ends = self._rng.random(n) < 0.7
        ends = np.where(self._rng.random(n) < 0.5, self._low, self._high)
        return np.where(at_ends, ends, self._rng.uniform(self._low, self._high))
