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
    ForwardModel,
    MotorLag,
    TorquesUnderWay,
)

Array = NDArray[np.float64]

UNEXPECTED = 10.0
"""Innovation from which on a state is taken for a jump, in what the declared errors explain."""

SUDDEN = 0.1
"""The same at least, in the way of a period at the greatest speed: a robot whose time stood still
for a period, or that hit something, is found by it."""


class StateEstimator:
    """Estimates the velocity, and predicts the state at the instant when a command will act.

    A state that comes with stamp k is of an earlier instant, and the command that answers it acts
    at a later one, `delay` periods apart. Between them the commands with the stamps k - delay to
    k - 1 act. The torque that is reported with a state is that of the period before its instant:
    it leads the observer to it, whatever commands were lost. `docs/state_estimation.md` has the
    derivation.

    Args:
        model: n joints with one coordinate each.
        dt: control period, s.
        delay: control periods from the instant of a state to that when its command begins to act.
        motor_lag: time constants of the motors' torques, shape (n,), s; 0 without a lag.
        observers: that estimate the velocities; None takes those that are reported.
        velocity_max: speed limits, shape (n,), rad/s; tells jumps from motion.
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
        longest_gap: int = 1,
    ) -> None:
        zero = np.zeros(model.nv)
        self._dt, self._dt_ns = dt, 1e9 * dt
        self._longest_gap = longest_gap
        self._model = ForwardModel(model, dt)
        self._lag = MotorLag(motor_lag, dt)
        self._commands = TorquesUnderWay(delay)
        self._observer: Observer | None = None
        self._jump = zero
        if observers is not None:
            self._observer = Observer(observers, dt, State(zero, zero))
            self._jump = np.maximum(UNEXPECTED * observers.innovation, SUDDEN * dt * velocity_max)
        self._stamp = -1
        self._tau = zero
        self.resets: Counter[str] = Counter()
        self.innovation = zero.copy()

    def answer(self, stamp: int, tau: Array | None) -> None:
        """Take note of a command, see `TorquesUnderWay.answer`."""
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
        acted, *coming = self._commands.torques()
        if effort is not None and self._commands.silent:
            coming = [None] * len(coming)
        before = self._tau
        if effort is not None:
            self._tau = effort
        elif acted is not None:
            self._tau = self._lag.end(before, acted)
        else:
            self._tau = self._model.torque_at(reported)
        state = reported
        if self._observer is not None:
            observer, mean = self._observer, self._lag.mean(before, self._tau)
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
        self._tau = self._model.torque_at(reported) if effort is None else effort
        if self._observer is not None:
            self._observer.state = reported
        answer = self._predict(reported, self._commands.torques()[1:])
        return answer if np.isfinite(answer).all() else reported

    def _predict(self, state: State, coming: list[Array | None]) -> State:
        """Return a state after the commands that are under way, None for the torque as it is."""
        model, lag, tau = self._model, self._lag, self._tau
        accelerations = [model.a]
        for command in coming:
            after = tau if command is None else lag.end(tau, command)
            accelerations.append(model.acceleration(state, lag.mean(tau, after)))
            state = state.after(model.a, self._dt)
            tau = after
        if lag.any:
            state = lag.lead(state, model.acceleration_at(state, tau))
        # That of the period which the next state ends.
        model.a = accelerations[min(1, len(coming))]
        return state
