# SPDX-License-Identifier: Apache-2.0
"""Joint states as reported in, joint states as commands will meet them out."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.observer import Observer, ObserverDesign
from viability_bounds_pkg.state_estimation.prediction import (
    Command,
    CommandsUnderWay,
    ForwardModel,
    MotorLag,
)

Array = NDArray[np.float64]

UNEXPECTED = 10.0
"""Innovation from which on a state is taken for a jump, in what the declared errors explain."""

SUDDEN = 0.1
"""The same at least, in the way of a period at the greatest speed: a robot whose time stood still
for a period, or that hit something, is found by it."""


DISAGREES = 0.1
"""From which difference on the torque that is reported is believed, and not a command, in torque
limits, root sum square over the joints: brakes, or drives that stop by themselves. Less where the
torque reported has less noise."""

BEYOND_NOISE = 3.0
"""The same in root mean squares of the difference in `NOISE_PERIODS` in which commands acted."""

LEAST = 0.03
"""Below this no difference counts, in torque limits: motors are not known that well."""

NOISE_PERIODS = 100

FADING = 0.98
"""Of torques beyond the commanded ones, what is left after a period in which those were obeyed."""

STILL = 0.02
"""Speed of an arm that stands, in speed limits."""


class StateEstimator:
    """Estimates the velocity, and predicts the state at the instant when a command will act.

    A state that comes with stamp k is of an earlier instant, and the command that answers it acts
    at a later one, `delay` periods apart. Between them the commands with the stamps k - delay to
    k - 1 act. In the period before that instant it was command k - delay - 1, unless it was lost:
    the torque that is reported with the state tells. See `docs/state_estimation.md`.

    Args:
        model: n joints with one coordinate each.
        dt: control period, s.
        delay: control periods from the instant of a state to that when its command begins to act.
        motor_lag: time constants of the motors' torques, shape (n,), s; 0 without a lag.
        observers: that estimate the velocities; None takes those that are reported.
        velocity_max: speed limits, shape (n,), rad/s; tells jumps from motion.
        torque_max: torque limits, shape (n,), N m.
        lasting: up to which the observers learn a lasting disturbance, shape (n,), rad/s^2.
        longest_gap: control periods between two states that are bridged by the model.

    Attributes:
        resets: how often it started anew, by reason.
        innovation: largest one seen since then, shape (n,), rad; not those of jumps.
    """

    def __init__(
        self,
        model: pin.Model,
        dt: float,
        delay: int,
        motor_lag: Array,
        observers: ObserverDesign | None,
        velocity_max: Array,
        torque_max: Array,
        lasting: Array,
        longest_gap: int = 1,
    ) -> None:
        zero = np.zeros(model.nv)
        self._dt, self._dt_ns = dt, 1e9 * dt
        self._longest_gap = longest_gap
        self._model = ForwardModel(model, dt)
        self._lag = MotorLag(motor_lag, dt)
        self._commands = CommandsUnderWay(delay)
        self._observer: Observer | None = None
        self._jump = zero
        if observers is not None:
            self._observer = Observer(observers, dt, lasting)
            self._jump = np.maximum(UNEXPECTED * observers.innovation, SUDDEN * dt * velocity_max)
        self._stamp = -1
        self._tau = zero  # of the motors at the instant of the last state
        self._acting: Array | None = None  # the command that acts then
        # What the motors give beyond it, as far as it was not obeyed; None before it is known.
        self._beyond: Array | None = None
        self._noise = (DISAGREES / BEYOND_NOISE) ** 2  # mean square of `_distance`
        self._torque_share = 1.0 / torque_max
        self._still = STILL * velocity_max
        self.resets: Counter[str] = Counter()
        self.innovation = zero.copy()

    def answer(self, stamp: int, tau: Array | None) -> None:
        """Take note of a command, see `CommandsUnderWay.answer`."""
        self._commands.answer(stamp, tau)

    def step(self, stamp: int, reported: State, effort: Array | None) -> State:
        """Return the state at the instant when the command that answers `reported` will act.

        Args:
            stamp: of the reported state, another than that of the last one, ns.
            reported: state of the joints.
            effort: torque of the motors that is reported with it, shape (n,), N m; None where
                there is none.
        """
        periods = self._periods_since_last(stamp)
        self._stamp = stamp
        if not periods:
            return self._start(stamp, reported, effort)
        self._commands.open(stamp, periods)
        acted, *coming = self._commands.acting()
        if effort is not None and acted is not None and self._commands.silent:
            acted = Command(None)  # what the robot does by itself then, the effort tells
        before = self._tau
        self._tau = self._torque(before, acted, reported, effort)
        if effort is not None and self._beyond is None:
            coming = [Command(None)] * len(coming)  # it goes on little by little
        state, mean = reported, self._lag.mean(before, self._tau)
        if self._observer is not None:
            observer = self._observer
            for _ in range(periods):
                observer.predict(self._model.acceleration(observer.state, mean))
            innovation = observer.innovation(reported.q)
            size = np.abs(innovation)
            if not (size <= self._jump).all():
                return self._restart("the state jumped", stamp, reported, effort)
            np.maximum(self.innovation, size, out=self.innovation)
            observer.correct(innovation)
            state = observer.state
        answer = self._predict(state, coming)
        if not np.isfinite(answer).all():
            return self._restart("the model diverged", stamp, reported, effort)
        return answer

    def _torque(
        self, before: Array, command: Command | None, reported: State, effort: Array | None
    ) -> Array:
        """Return the motors' torque now, one period after `before`, shape (n,), N m.

        A command is without the noise of what is reported, which only tells whether it came.
        """
        kept, self._acting = self._acting, None if command is None else command.tau
        if command is None or command.tau is None:
            self._beyond = None
            return self._without_commands(reported, effort)
        acting, beyond = command.tau, self._beyond
        if effort is None:
            self._beyond = None
            return self._lag.end(before, acting)
        off = self._distance(effort, self._lag.end(before, acting))
        if kept is not None and kept is not acting:
            unchanged = self._distance(effort, self._lag.end(before, kept))
            if unchanged < off:
                off, acting = unchanged, kept
                self._acting = kept
        more, limit = effort - acting, LEAST**2
        if beyond is not None:
            limit = min(DISAGREES**2, max(limit, BEYOND_NOISE**2 * self._noise))
        if off >= limit:
            self._beyond = more
            return effort
        if beyond is None:  # the torque before is not that of a command
            self._beyond = np.zeros_like(effort)
            return effort
        self._noise += (off - self._noise) / NOISE_PERIODS
        # A robot that has stopped itself comes back little by little, and what friction holds
        # meanwhile was learned with its torques.
        least, most = np.minimum(more, 0.0), np.maximum(more, 0.0)
        self._beyond = np.minimum(np.maximum(FADING * beyond, least), most)
        return self._lag.end(before, acting + self._beyond)

    def _without_commands(self, reported: State, effort: Array | None) -> Array:
        """Return the torque of a robot that moves or holds itself, shape (n,), N m.

        Where its motors give hardly any, brakes hold it, whose torque is in no effort: then the
        joints are taken to keep their velocity.
        """
        if effort is None or self._distance(effort, np.zeros(len(effort))) < LEAST**2:
            return self._model.torque_at(reported)
        return effort

    def _distance(self, effort: Array, expected: Array) -> float:
        share = self._torque_share * (effort - expected)
        return float(share @ share)

    def _periods_since_last(self, stamp: int) -> int:
        """Return how many periods a state is after the last one; 0 to start anew."""
        if self._stamp < 0:
            return 0
        periods = max(1, round((stamp - self._stamp) / self._dt_ns))
        if stamp > self._stamp and periods <= self._longest_gap:
            return periods
        self.resets["stamps jumped"] += 1
        return 0

    def _restart(self, why: str, stamp: int, reported: State, effort: Array | None) -> State:
        self.resets[why] += 1
        return self._start(stamp, reported, effort)

    def _start(self, stamp: int, reported: State, effort: Array | None) -> State:
        """Start anew from a reported state; nothing is known to be under way."""
        self._commands.clear()
        self._commands.open(stamp)
        self._model.a = np.zeros(len(self._tau))
        self._acting = self._beyond = None
        self._tau = self._without_commands(reported, effort)
        if self._observer is not None:
            still = (np.abs(reported.v) <= self._still).all()
            # The joints of an arm that stands do not accelerate: friction is in the way.
            held = -self._model.acceleration_at(reported, self._tau) if still else None
            self._observer.start(reported, held)
        answer = self._predict(reported, self._commands.acting()[1:])
        return answer if np.isfinite(answer).all() else reported

    def _predict(self, state: State, coming: list[Command | None]) -> State:
        """Return a state after the commands under way, those without torques for that of now."""
        model, lag, tau = self._model, self._lag, self._tau
        learned = 0.0 if self._observer is None else self._observer.disturbance
        beyond = 0.0 if self._beyond is None else self._beyond
        accelerations = [model.a]
        for command in coming:
            sent = None if command is None else command.tau
            after = tau if sent is None else lag.end(tau, sent + beyond)
            accelerations.append(model.acceleration(state, lag.mean(tau, after)))
            state = state.after(model.a + learned, self._dt)
            tau = after
        if lag.any:
            state = lag.lead(state, model.acceleration_at(state, tau) + learned)
        # That of the period which the next state ends.
        model.a = accelerations[min(1, len(coming))]
        return state
