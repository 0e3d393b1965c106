# SPDX-License-Identifier: Apache-2.0
"""How the arm is slowed when something goes wrong, and goes on when the cause has gone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from torque_safety_controller.controller import ControlOutput
from torque_safety_controller.node.streams.states import StateStream
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.safety.command_watch import CommandWatch
from torque_safety_controller.safety.handover import REST_SPEED
from torque_safety_controller.safety.rate_watch import RateWatch
from torque_safety_controller.supervisor import Order

_PAUSED = "states were not answered for longer than bounds_timeout"
_IGNORED = "the motors do not give the torques that were sent"
STUCK = f"{_IGNORED}, and theirs stay the same to the last bit"

_INTEGRAL_KEPT = 0.5
"""For how long the integral action's torque is kept while commands do not act, s. It balances the
friction of a motion; the arm that has stopped since then would be pushed by it."""

_LITTLE = 0.1
"""Share of its goals with which an arm has hardly gone on: to nothing at once would be a jolt."""


class Recovery:
    """Sets the share of the goals by which the controller may move the arm.

    `docs/stopping.md`, "The controller's part", says why.

    Args:
        states: of the robot.
        config: of the controller.
        covered: longest row of unanswered states that the bounds hold for.
        on_way: commands of which one acts, at most.
        warn: takes what to log.

    Attributes:
        why: the arm was braked, until it goes on; empty when it does.
        order: what the controller is to do with the newest state.
        rate: share of the goals.
        motors: whether they do as they are told.
    """

    def __init__(
        self,
        states: StateStream,
        config: ControllerConfiguration,
        covered: int,
        on_way: int,
        warn: Callable[[str], None],
    ) -> None:
        self._states, self._warn = states, warn
        self.order = Order()
        self._pause = config.bounds_timeout
        self._tolerance = config.effort_tolerance
        self.why = ""
        self.rate = RateWatch(config.dt, covered)
        self.motors = CommandWatch(config.effort_tolerance * config.torque_max, on_way)

    def sees_motors(self) -> bool:
        """Slow the arm while its motors do not give the torques that were sent.

        Returns:
            Whether the newest state is to be answered: what it says of the motors has not frozen.
        """
        motors, states = self.motors, self._states
        self.order = Order()
        if self._tolerance <= 0.0 or not states.copy_effort(motors.effort):
            return True  # as far as is known
        doubted, elapsed = motors.doubted, states.elapsed()
        obeyed = motors.look(self.rate.slowed, elapsed or 0.0)
        self.order = Order(obeyed=obeyed)
        if not motors.ignored:
            if motors.in_row:
                self.rate.wait()  # until it is known whether commands act again
            return True
        self.order = Order(
            obeyed=obeyed,
            forget_disturbance=True,
            forget_integral=motors.ignored_for > _INTEGRAL_KEPT,
        )
        if motors.stuck:
            self.why = STUCK
        elif doubted:  # perhaps commands act again: no jolt
            self.rate.ease(elapsed)
        else:
            self.rate.slow(_IGNORED, gently=self.rate.share < _LITTLE)
            self._warn(f"{_IGNORED}: the arm is slowed")
        return not motors.stuck

    def look(self) -> None:
        """Slow the arm if too many states were not answered; else let it go on."""
        rate, order = self.rate, self.order
        before, elapsed = rate.too_long, self._states.elapsed() or 0.0
        if news := rate.note(elapsed, self._at_rest):
            self._warn(news)
        if rate.too_long > before:  # the robot may have stopped itself, and much has changed
            order = order._replace(forget_disturbance=True)
            if elapsed > self._pause:
                # The robot has stopped: what it balanced was of a motion.
                order = order._replace(forget_integral=True)
                self.why = _PAUSED
                self.slow()  # also where a row of so few states takes it down gently
        self.order = order._replace(share=rate.share)

    @property
    def _at_rest(self) -> bool:
        return bool(np.abs(self._states.v).max() <= REST_SPEED)

    def slow(self) -> None:
        """Let the goals have no effect, after something went wrong."""
        if self.why:
            self.rate.slow(self.why)

    def note(self, step: ControlOutput) -> None:
        """Take a step of the controller towards its goals: the arm goes on if it rests."""
        if step.tracking and (self.rate.share > 0.0 or self._at_rest):
            self.why = ""

    def values(self) -> dict[str, Any]:
        """Return values for diagnostics."""
        return {
            "goal_share": self.rate.share,
            "missed_rows_too_long": self.rate.too_long,
            "missed_row_longest": self.rate.longest,
            "commands_ignored": self.motors.times,
            "effort_difference": self.motors.seen * self._tolerance,
        }
