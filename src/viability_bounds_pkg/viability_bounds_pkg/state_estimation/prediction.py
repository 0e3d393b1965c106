# SPDX-License-Identifier: Apache-2.0
"""What predicts a state: forward dynamics, the motors' lag, and the commands under way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.state import State

Array = NDArray[np.float64]


class ForwardModel:
    """Mean accelerations of an arm under torques held for a period.

    They are those in the middle of the period, to which the last acceleration leads: of second
    order in the period, as the torques of the controller are (`docs/theory/bounds.md`).

    Args:
        model: n joints with one coordinate each.
        dt: control period, s.

    Attributes:
        a: the last acceleration, shape (n,), rad/s^2.
    """

    def __init__(self, model: pin.Model, dt: float) -> None:
        self._model, self._data, self._half = model, model.createData(), 0.5 * dt
        self.a = np.zeros(model.nv)

    def acceleration(self, state: State, tau: Array) -> Array:
        """Return the mean acceleration of the period from `state` on, shape (n,), rad/s^2.

        Args:
            state: at the beginning of the period.
            tau: mean torque, shape (n,), N m.
        """
        self.a = self.acceleration_at(state.after(self.a, self._half), tau)
        return self.a

    def acceleration_at(self, state: State, tau: Array) -> Array:
        """Return the acceleration at an instant, shape (n,), rad/s^2."""
        return np.array(pin.aba(self._model, self._data, state.q, state.v, tau))

    def torque_at(self, state: State) -> Array:
        """Return the torque under which the joints do not accelerate, shape (n,), N m."""
        return np.array(pin.nonLinearEffects(self._model, self._data, state.q, state.v))


class MotorLag:
    """First-order lag of the motors' torques.

    Args:
        time_constant: of each motor, shape (n,), s; 0 without a lag.
        dt: control period, s.

    Attributes:
        any: whether any motor has a lag.
    """

    def __init__(self, time_constant: Array, dt: float) -> None:
        self._lag = time_constant
        self.any = bool(time_constant.any())
        self._remains = np.exp(-dt / np.where(time_constant > 0.0, time_constant, 1e-9 * dt))
        # The mean of an exponential between two values: the integral of the torque's equation,
        # lag tau' = command - tau, over the period.
        self._before = time_constant / dt - self._remains / (1.0 - self._remains)

    def end(self, tau: Array, command: Array) -> Array:
        """Return the torque after a period of `command` from `tau` on, shape (n,), N m."""
        return command + self._remains * (tau - command) if self.any else command

    def mean(self, before: Array, after: Array) -> Array:
        """Return the mean torque of a period between those at its ends, shape (n,), N m."""
        return after + self._before * (before - after) if self.any else after

    def lead(self, state: State, a: Array) -> State:
        """Return (q + lag v, v + lag a): the double integrator that the commands drive.

        Args:
            state: of the joints.
            a: their acceleration, shape (n,), rad/s^2.
        """
        return State(state.q + self._lag * state.v, state.v + self._lag * a)


class CommandsUnderWay:
    """The commands that have been sent but do not act yet, and the one that acted last.

    A state without an answer keeps the command of the one before, as the robot does.

    Args:
        delay: control periods from the instant of a state to that when its command begins to act.
    """

    def __init__(self, delay: int) -> None:
        # The last state's command is not under way yet.
        self._answers: deque[_Answer] = deque(maxlen=delay + 2)
        self.clear()

    def clear(self) -> None:
        """Forget all commands."""
        self._held: Array | None = None
        self._answers.extend(_Answer(-1) for _ in range(self._answers.maxlen or 0))

    def add_state(self, stamp: int, periods: int = 1) -> None:
        """Add a state, which has no answer yet.

        Args:
            stamp: of the state, ns.
            periods: since the last one; those between were lost, and nothing answers them.
        """
        for each in (*[-1] * (periods - 1), stamp):
            if self._answers[0].given:
                self._held = self._answers[0].tau
            self._answers.append(_Answer(each))

    def answer(self, stamp: int, tau: Array | None) -> None:
        """Add a command; of several for one state the first counts, as at the robot.

        Args:
            stamp: of the state that it answers, ns; others are ignored.
            tau: torques, shape (n,), N m; None where the drives control positions.
        """
        for each in self._answers:
            if each.stamp == stamp and not each.given:
                each.given, each.tau = True, tau

    def acting(self) -> list[Array | None]:
        """Return the torques of the period before the last state, and of the next ones.

        As many as the delay is long, and one; None where no torque is known: before the first
        command, when brakes may hold, and where the drives control positions.
        """
        held, torques = self._held, []
        for each in self._answers:
            held = each.tau if each.given else held
            torques.append(held)
        return torques[:-1]

    @property
    def silent(self) -> bool:
        """Whether none of the states whose commands act now or later was answered."""
        return not any(each.given for each in self._answers)


@dataclass
class _Answer:
    """The command that answers a state with a stamp, in ns, if it was given."""

    stamp: int
    given: bool = False
    tau: Array | None = None
