# SPDX-License-Identifier: Apache-2.0
"""Estimates the velocity, and predicts the state at the instant when a command will act."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.motor_torque import MotorTorque
from viability_bounds_pkg.state_estimation.observer import Observer, ObserverDesign
from viability_bounds_pkg.state_estimation.prediction import (
    CommandsUnderWay,
    ForwardModel,
    MotorLag,
)

Array = NDArray[np.float64]

JUMP_FACTOR = 10.0
"""Innovation beyond which a state has jumped, in what the declared errors explain."""

JUMP_SHARE = 0.1
"""The same at least, in the way of a period at the speed limit: a robot whose time stood still for
a period, or that hit something, is found by it."""

AT_REST = 0.02
"""Speed of an arm that stands, in speed limits."""


class StateEstimator:
    """Estimates the velocity, and predicts the state at the instant when a command will act.

    A state with stamp k is of an earlier instant, and the command that answers it acts at a later
    one, `delay` periods apart. Between them the commands with the stamps k - delay to k - 1 act.
    In the period before that instant it was command k - delay - 1. See `docs/theory/estimator.md`.

    Args:
        model: n joints with one coordinate each.
        dt: control period, s.
        delay: control periods from the instant of a state to that when its command begins to act.
        motor_lag: time constants of the motors' torques, shape (n,), s; 0 without a lag.
        observers: that estimate the velocities; None uses those that are reported.
        velocity_max: speed limits, shape (n,), rad/s; tells jumps from motion.
        torque_max: torque limits, shape (n,), N m.
        lasting: up to which the observers learn a lasting disturbance, shape (n,), rad/s^2.
        longest_gap: control periods between two states that are bridged by the model.

    Attributes:
        resets: how often it restarted from a reported state, by reason.
        innovation: largest one seen since the start, shape (n,), rad; not those of jumps.
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
        self._dt, self._dt_ns = dt, 1e9 * dt
        self._longest_gap = longest_gap
        self._model = ForwardModel(model, dt)
        self._lag = MotorLag(motor_lag, dt)
        self._motors = MotorTorque(self._model, self._lag, torque_max)
        self._commands = CommandsUnderWay(delay)
        self._observer: Observer | None = None
        self._jump = np.zeros(model.nv)
        if observers is not None:
            self._observer = Observer(observers, dt, lasting)
            shortest = JUMP_SHARE * dt * velocity_max
            self._jump = np.maximum(JUMP_FACTOR * observers.innovation, shortest)
        self._stamp = -1
        self._at_rest = AT_REST * velocity_max
        self.resets: Counter[str] = Counter()
        self.innovation = np.zeros(model.nv)

    def answer(self, stamp: int, tau: Array | None) -> None:
        """Add a command that was sent, see `CommandsUnderWay.answer`."""
        self._commands.answer(stamp, tau)

    def step(self, stamp: int, reported: State, effort: Array | None) -> State:
        """Return the state at the instant when the command that answers `reported` will act.

        Args:
            stamp: of the reported state, another than that of the last one, ns.
            reported: state of the joints.
            effort: torque of the motors that is reported with it, shape (n,), N m; None where
                there is none.
        """
        periods, reason = self._periods_since_last(stamp)
        self._stamp = stamp
        if not periods:
            return self._restart(reason, stamp, reported, effort)
        commands, motors = self._commands, self._motors
        commands.add_state(stamp, periods)
        acted, *coming = commands.acting()
        if effort is not None and commands.silent:
            acted = None  # what the robot does by itself then, the effort tells
        before = motors.tau
        motors.update(acted, reported, effort)
        if effort is not None and motors.excess is None:
            coming = [None] * len(coming)  # it resumes little by little
        state = reported
        if self._observer is not None:
            tau = self._lag.mean(before, motors.tau)
            for _ in range(periods):
                self._observer.predict(self._model.acceleration(self._observer.state, tau))
            innovation = self._observer.innovation(reported.q)
            size = np.abs(innovation)
            if not (size <= self._jump).all():
                return self._restart("the state jumped", stamp, reported, effort)
            np.maximum(self.innovation, size, out=self.innovation)
            self._observer.correct(innovation)
            state = self._observer.state
        answer = self._predict(state, coming)
        if not np.isfinite(answer).all():
            return self._restart("the model diverged", stamp, reported, effort)
        return answer

    def _periods_since_last(self, stamp: int) -> tuple[int, str]:
        """Return how many periods a state is after the last one; 0 and why to restart."""
        if self._stamp < 0:
            return 0, ""
        periods = max(1, round((stamp - self._stamp) / self._dt_ns))
        if stamp > self._stamp and periods <= self._longest_gap:
            return periods, ""
        return 0, "stamps jumped"

    def _restart(self, reason: str, stamp: int, reported: State, effort: Array | None) -> State:
        """Restart from a reported state, with no commands under way; return the answer to it."""
        if reason:  # else it is the first
            self.resets[reason] += 1
        self._commands.clear()
        self._commands.add_state(stamp)
        self._model.a = np.zeros_like(reported.q)
        self._motors.start(reported, effort)
        if self._observer is not None:
            at_rest = (np.abs(reported.v) <= self._at_rest).all()
            # The joints of an arm that stands do not accelerate: friction is in the way.
            a = self._model.acceleration_at(reported, self._motors.tau)
            self._observer.start(reported, -a if at_rest else None)
        answer = self._predict(reported, self._commands.acting()[1:])
        return answer if np.isfinite(answer).all() else reported

    def _predict(self, state: State, coming: list[Array | None]) -> State:
        """Return a state after the commands under way; unknown ones keep the torque of now."""
        model, lag, tau = self._model, self._lag, self._motors.tau
        learned = 0.0 if self._observer is None else self._observer.disturbance
        excess = 0.0 if self._motors.excess is None else self._motors.excess
        accelerations = [model.a]
        for command in coming:
            after = tau if command is None else lag.end(tau, command + excess)
            accelerations.append(model.acceleration(state, lag.mean(tau, after)))
            state = state.after(model.a + learned, self._dt)
            tau = after
        if lag.any:
            state = lag.lead(state, model.acceleration_at(state, tau) + learned)
        # That of the period which the next state ends.
        model.a = accelerations[min(1, len(coming))]
        return state
