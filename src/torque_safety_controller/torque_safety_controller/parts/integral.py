# SPDX-License-Identifier: Apache-2.0
"""Integral action of one arm: extra torque on top of inverse dynamics, continuous whatever comes.

Modes are ``joints``, every joint stiff, (3)-(14) of [Benallegue2021]; and ``task`` and
``position``, the end effectors' poses or positions stiff and their null space free, (15)-(26),
which are as printed where the anti-windup is. The torque does not jump when settings change, or
when a state is missing or unusable.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback import (
    TASKS,
    ArmTerms,
    IntegralFeedback,
    IntegralLaw,
    IntegralSettings,
)
from torque_safety_controller.integral_feedback.nullspace import NullspaceCompliance
from torque_safety_controller.integral_feedback.printed import PrintedCompliance
from torque_safety_controller.integral_feedback.stable_gain import StableGain
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import LONGEST_GAP, Part, Settings, Step, joints_named

Array = NDArray[np.float64]

_POSITION_JUMP = 0.05  # rad or m; beyond what the velocities account for
_FADING_TIME = 0.2  # s; of what the memory cannot hold


class FadingTorque:
    """Torque taken over at a handover, which fades; what there is without integral action.

    Args:
        settings: as of `IntegralAction`.

    Attributes:
        settings: as they are set.
        last: torque of the last step, shape (n,), N m.
        skipped: steps that were not integrated over: time jumped, or the state did.
        saturated: which joints are at their budget, shape (n,).
    """

    def __init__(self, settings: IntegralSettings) -> None:
        self.settings = settings
        self.skipped = 0
        self._zero = np.zeros(len(settings.budget))
        self.saturated = np.zeros(len(settings.budget), dtype=bool)
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next step begins with nothing added."""
        self.last = self._fading = self._zero

    @property
    def gain(self) -> float:
        """Lambda that is used, 1/s: what is set, or what is stable; 0 for none."""
        return 0.0

    def forget(self) -> None:
        """Let the integral begin anew: what it gives now fades."""

    def torque(self, robot: RobotModel, a_last: Array, elapsed: float) -> Array:
        """Return what to add in this step, shape (n,), N m; finite whatever comes.

        After a jump in time, or of the state, the torque goes on from the last one, and the
        difference to what the memory asks for fades.

        Args:
            robot: of the arm, updated to its state.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            elapsed: time since the last step, s.
        """
        if self._fading is not self._zero:
            self.last = self._faded(elapsed, robot.dt)
        return self.last

    def resume(self, robot: RobotModel, torque: Array) -> None:
        """Begin so that the torque is `torque` now.

        The memory holds what it can of it within the budgets; the rest fades.

        Args:
            robot: of the arm, updated to its state.
            torque: shape (n,), N m, finite.
        """
        self.last = self._fading = torque

    def _faded(self, elapsed: float, period: float) -> Array:
        """Let the time pass for what fades, and return it; infinite time is a period."""
        gap = min(elapsed, LONGEST_GAP * period) if elapsed > 0.0 else 0.0  # also for a NaN
        gap = period if math.isinf(elapsed) else gap
        self._fading = self._fading * math.exp(-gap / _FADING_TIME)
        return self._fading


class IntegralAction(FadingTorque):
    """Torque of the integral of acceleration errors.

    Args:
        mode: one of `MODES` but ``none``.
        settings: their numbers may be replaced between steps: the torque does not jump.
        disturbance_max: largest disturbance of each joint that is integrated, shape (n,), N m;
            what friction and a wrong model never are, but a sensor's glitch or a blow may be.
        hands: end effectors whose rows are stacked to one task.

    Attributes:
        law: what gives the torque of a step.

    Raises:
        TaskShapeError: the task leaves no null space.
    """

    def __init__(
        self, mode: str, settings: IntegralSettings, disturbance_max: Array, hands: int = 1
    ) -> None:
        self._rows = TASKS.get(mode)
        # Less with a null space: loops of P K P are unstable earlier in some postures.
        self._largest_product = 1.0 if self._rows is None else 0.5
        self.law: IntegralLaw
        if self._rows is None:
            self.law = IntegralFeedback(settings)
        else:
            kind = PrintedCompliance if settings.as_printed else NullspaceCompliance
            self.law = kind(settings, hands * self._rows.stop)
        self._disturbance_max = disturbance_max
        super().__init__(settings)

    def reset(self) -> None:
        """See `FadingTorque`."""
        super().reset()
        self._stable = StableGain(self._largest_product)
        self._asked = self.law.settings = self.settings
        self._started = self._lost = self._resuming = False
        self._q_last = self._v_last = self._zero

    @property
    def gain(self) -> float:
        """See `FadingTorque`."""
        return self.law.settings.gain

    def forget(self) -> None:
        """See `FadingTorque`."""
        self._started = False
        self._resuming = True

    def torque(self, robot: RobotModel, a_last: Array, elapsed: float) -> Array:
        """See `FadingTorque`."""
        try:
            torque = self._next(robot, a_last, elapsed)
        except ValueError:  # numbers that are not finite, or no mass matrix
            self._lost = True
            torque = None
        if torque is None:
            self._resuming = True
            self.skipped += 1
        else:
            self.last = torque
        self.saturated = self.law.saturated
        return self.last

    def resume(self, robot: RobotModel, torque: Array) -> None:
        """See `FadingTorque`."""
        self._started = False
        self._stable.check_next()
        self.law.settings = self._wanted(robot)
        self._hold(robot, torque)
        self.last = torque

    def _next(self, robot: RobotModel, a_last: Array, elapsed: float) -> Array | None:
        """Return the torque of this step; None where the state jumped."""
        arm, law = self._arm(robot), self.law
        if not self._started:
            self._start(robot, arm)
        known = 0.0 < elapsed <= LONGEST_GAP * robot.dt and not self._lost
        last = self._q_last, robot.q, self._v_last, robot.v
        jumped = known and _jumped(arm.M, *last, a_last, elapsed, self._disturbance_max)
        self._lost = False
        self._q_last, self._v_last = robot.q.copy(), robot.v.copy()
        if jumped or not known:
            law.skip(arm, elapsed if 0.0 <= elapsed < math.inf else 0.0)
            self._stable.check_next()
        if jumped:
            return None
        if known:
            torque = law.torque(arm, a_last, elapsed)
        else:
            self.skipped += 1
            self._resuming = True
            torque = law.torque(arm, self._zero, 0.0)
        if self._resuming:
            self._resuming = False
            self._fading = self.last - torque
        torque = torque + self._faded(elapsed, robot.dt)
        settings = self._wanted(robot)
        if settings is not law.settings:
            law.settings = settings
            self._hold(robot, torque)
        return torque

    def _wanted(self, robot: RobotModel) -> IntegralSettings:
        """Return the settings with a gain that is stable here; those in use unless they differ."""
        asked, used = self.settings, self.law.settings
        gain = self._stable.gain(asked.gain, robot.M, robot.dt)
        if asked is not self._asked:
            self._asked = asked
            if not asked.same_as(replace(used, gain=asked.gain)):
                return replace(asked, gain=gain)
        return used if gain == used.gain else replace(used, gain=gain)

    def _hold(self, robot: RobotModel, torque: Array) -> None:
        """Let the memory give `torque` now; what it cannot give fades."""
        held = self._zero
        try:
            arm = self._arm(robot)
            if not self._started:
                self._start(robot, arm)
            held = self.law.initialise(torque, arm)
        except ValueError:  # too fast, or numbers that are not finite: all of it fades
            self._started = False
        self._fading = torque - held

    def _start(self, robot: RobotModel, arm: ArmTerms) -> None:
        """Let the memory begin, empty, at this state."""
        self.law.reset(arm)
        self._q_last, self._v_last = robot.q.copy(), arm.v.copy()
        self._started, self._lost = True, False

    def _arm(self, robot: RobotModel) -> ArmTerms:
        """Return what the law needs to know of the arm."""
        rows = self._rows
        if rows is None:
            return ArmTerms(robot.M, robot.C, robot.J, robot.J_dot, robot.v)
        J, J_dot = robot.J[rows], robot.J_dot[rows]
        if robot.others:
            hands = (robot, *robot.others)
            J = np.concatenate([hand.J[rows] for hand in hands])
            J_dot = np.concatenate([hand.J_dot[rows] for hand in hands])
        return ArmTerms(robot.M, robot.C, J, J_dot, robot.v)


class Integral(Part):
    """Adds the torque of the integral action, which takes over other torques without a step.

    Args:
        action: in one of its modes.
        robot: of the arm.

    Attributes:
        action: as given.
    """

    def __init__(self, action: FadingTorque, robot: RobotModel) -> None:
        self.action, self._robot = action, robot

    def configure(self, settings: Settings) -> None:
        """See `Part.configure`."""
        self.action.settings = settings.integral

    def reset(self, robot: RobotModel) -> None:
        """See `Part.reset`."""
        self.action.reset()

    def prepare(self, step: Step) -> None:
        """Add the torque to that of the model, and say by how much it has changed."""
        action = self.action
        if step.order.forget_integral:
            action.forget()
        before, time = action.last, step.elapsed if step.order.obeyed else math.inf
        torque = action.torque(step.robot, step.a_last, time)
        step.torque = step.torque + torque
        if torque is not before:
            step.integral_change = torque - before

    def resume(self, step: Step, torque: Array) -> None:
        """See `Part.resume`."""
        self.action.resume(step.robot, torque)

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {
            "joints_at_integral_budget": joints_named(self._robot, self.action.saturated),
            "integral_skipped_steps": self.action.skipped,
            "integral_lambda": self.action.gain,
        }


def make_integral(
    mode: str, settings: IntegralSettings, disturbance_max: Array, hands: int = 1
) -> FadingTorque:
    """Return the integral action of a mode; see `IntegralAction`."""
    if mode == "none":
        return FadingTorque(settings)
    return IntegralAction(mode, settings, disturbance_max, hands)


@njit(cache=True)
def _jumped(
    M: Array,
    q_last: Array,
    q: Array,
    v_last: Array,
    v: Array,
    a_last: Array,
    elapsed: float,
    disturbance_max: Array,
) -> bool:
    """Return whether velocity or position of a joint changed by more than is possible.

    At most `disturbance_max`, shape (n,), N m, acts on a joint's own inertia besides `a_last`.
    """
    for j in range(v.size):
        impulse = M[j, j] * abs(a_last[j] * elapsed - (v[j] - v_last[j]))
        way = abs(q[j] - q_last[j]) - elapsed * (abs(v[j]) + abs(v_last[j]))
        # A NaN is not within its limits.
        if not (impulse <= disturbance_max[j] * elapsed and way <= _POSITION_JUMP):
            return True
    return False
