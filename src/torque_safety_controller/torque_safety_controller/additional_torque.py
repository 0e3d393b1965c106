# SPDX-License-Identifier: Apache-2.0
"""The torque added to the model's: integral action in one of its modes, and friction's.

Modes are ``none``; ``joints``, every joint stiff, (3)-(14) of [Benallegue2021]; and ``task`` and
``position``, the end effectors' poses or positions stiff and their null space free, (15)-(26),
which are as printed where the anti-windup is. The torque stays continuous when mode or settings
change, and when a state is missing or unusable. Friction is compensated beside it, with a budget
of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.compensation import FrictionCompensation
from torque_safety_controller.friction.settings import FrictionSettings, no_friction
from torque_safety_controller.integral_feedback.action import ArmTerms, IntegralAction
from torque_safety_controller.integral_feedback.feedback import IntegralFeedback
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.integral_feedback.stable_gain import StableGain
from torque_safety_controller.nullspace.compliance import NullspaceCompliance, PrintedCompliance
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

TASKS = {"task": slice(0, 6), "position": slice(0, 3)}
"""Rows of the pose's Jacobian that are stiff in each mode that has a null space."""

MODES = ("none", "joints", *TASKS)

PRINTED = "{} as printed"
"""Key of the action of a mode of `TASKS` with any anti-windup but ``qp``."""

LONGEST_GAP = 2.5
"""Periods that a step may take, a missed deadline being 2; a longer gap is not integrated over."""

_MOST = {"joints": 1.0} | dict.fromkeys(TASKS, 0.5)
"""Product lambda h f that `StableGain` allows in each mode.

It is less with a null space: loops of P K P are unstable earlier in some postures."""

_POSITION_JUMP = 0.05  # rad or m; beyond what the velocities account for
_FADING_TIME = 0.2  # s; of what a mode cannot take over
_NEGLIGIBLE = 1e-9  # N m


@dataclass(frozen=True, eq=False)
class AdditionalSettings:
    """Settings of `AdditionalTorque`; all of them may change while the controller runs.

    Attributes:
        mode: one of `MODES`.
        integral: of the integral action, whatever the mode.
        disturbance_max: largest disturbance of each joint that is integrated, shape (n,), N m;
            what friction and a wrong model never are, but a sensor's glitch or a blow may be.
        friction: of the friction compensation; None for none.
    """

    mode: str
    integral: IntegralSettings
    disturbance_max: Array
    friction: FrictionSettings | None = None


class AdditionalTorque:
    """Additional torque of one arm.

    Args:
        settings: may be replaced between steps: the torque does not jump.
        hands: end effectors whose rows are stacked to one task; a mode of `TASKS` whose rows leave
            no null space is not there.

    Attributes:
        last: what the last step added, shape (n,), N m.
        integral: what of it is the integral action's, shape (n,), N m.
        skipped: steps that were not integrated over: time jumped, or the state did.
        actions: the integral actions by mode, and `PRINTED`.
        friction: the friction compensation.
    """

    def __init__(self, settings: AdditionalSettings, hands: int = 1) -> None:
        n = len(settings.integral.budget)
        self.actions: dict[str, IntegralAction] = {"joints": IntegralFeedback(settings.integral)}
        for mode, rows in TASKS.items():
            m = hands * (rows.stop - rows.start)
            if m < n:
                self.actions[mode] = NullspaceCompliance(settings.integral, m)
                self.actions[PRINTED.format(mode)] = PrintedCompliance(settings.integral, m)
        self._no_friction = FrictionSettings(no_friction(n), np.zeros(n))
        self.friction = FrictionCompensation(settings.friction or self._no_friction)
        self.skipped = 0
        self._zero = np.zeros(n)
        self._stable = StableGain(n)
        self._settings = settings
        self.reset()
        # Compiled now, not in a control loop.
        zero = self._zero
        _jumped(np.eye(n), zero, zero, zero, zero, zero, 0.0, zero)

    @property
    def settings(self) -> AdditionalSettings:
        """Settings; the next step changes over to them."""
        return self._settings

    @settings.setter
    def settings(self, settings: AdditionalSettings) -> None:
        settings.integral.check_joints(len(self._zero))
        if settings.integral.same_as(self._asked):
            settings = replace(settings, integral=self._asked)
        self._settings = settings
        self.friction.settings = settings.friction or self._no_friction

    @property
    def idle(self) -> bool:
        """Whether nothing is added, so that the model needs no rates of its matrices."""
        integrating = not (self._mode == self._settings.mode == "none" and self._faded)
        return not integrating and self.friction.idle

    @property
    def gain(self) -> float:
        """Gain lambda of the integral action, 1/s: what is set, or what is stable."""
        return self._integral_settings.gain

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Which joints are at their budget, shape (n,)."""
        if self._action is None:
            return np.zeros(self.last.size, dtype=bool)
        return self._action.saturated

    def reset(self) -> None:
        """Forget the past: the next step begins with nothing added."""
        self._stable.reset()
        self._select_action(self._settings.integral)
        self._started = False
        self._lost = self._resuming = False
        self._q_last = self._v_last = self._zero
        self.last = self.integral = self._zero
        self._fading = self._zero
        self._faded = True
        self.friction.reset()

    def torque(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> Array:
        """Return what to add in this step, shape (n,), N m; finite whatever comes.

        After a jump in time, or of the state, the torque goes on from the last one, and the
        difference to what the memory asks for fades.

        Args:
            robot: of the arm, updated with rates.
            v: velocity, shape (n,), rad/s.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            elapsed: time since the last step, s.
        """
        try:
            torque = self._next(robot, v, a_last, elapsed)
        except ValueError:  # numbers that are not finite, or no mass matrix
            self._lost = True
            torque = None
        if torque is None:
            self._resuming = True
            self.skipped += 1
            return self.last
        self.integral = torque
        time = elapsed if 0.0 < elapsed <= LONGEST_GAP * robot.dt else 0.0
        self.last = torque + self.friction.torque(robot.M, v, a_last, time, robot.dt)
        return self.last

    def forget(self) -> None:
        """Let the integral action begin anew: what it gives now fades."""
        self._started = False
        self._resuming = True

    def initialise(self, robot: RobotModel, v: Array, torque: Array) -> Array:
        """Begin so that the torque is `torque` now; return that. Friction's fades in.

        The mode that is set takes over what it can, within budgets that are widened as far as
        they must be and for some time; the rest fades.

        Args:
            robot: of the arm, updated with rates.
            v: velocity, shape (n,), rad/s.
            torque: shape (n,), N m, finite.
        """
        self.friction.reset()
        self._select_action(self._borne(robot))
        self._take_over(robot, v, torque, reset=True)
        self.last = self.integral = torque
        return torque

    def _next(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> Array | None:
        """Return the torque of this step; None where the state jumped."""
        arm, action = self._arm(robot, v), self._action
        if not self._started:
            self._begin(robot, arm)
        known = 0.0 < elapsed <= LONGEST_GAP * robot.dt and not self._lost
        jumped = (
            known
            and action is not None
            and _jumped(
                robot.M,
                self._q_last,
                robot.q,
                self._v_last,
                v,
                a_last,
                elapsed,
                self._settings.disturbance_max,
            )
        )
        if action is not None and (jumped or not known):
            action.skip(arm, elapsed if 0.0 <= elapsed < math.inf else 0.0)
        self._lost = False
        self._q_last, self._v_last = robot.q.copy(), v.copy()
        if jumped:
            return None
        if not known:
            self.skipped += 1
        if action is None:
            torque = self._zero
        elif known:
            torque = action.torque(arm, a_last, elapsed)
        else:
            torque = action.torque(arm, self._zero, 0.0)
        if self._resuming or not known:
            self._resuming = False
            self._fade(self.integral - torque)
        if not self._faded:
            gap = min(elapsed, LONGEST_GAP * robot.dt) if elapsed > 0.0 else 0.0
            gap = robot.dt if math.isinf(elapsed) else gap
            self._fade(self._fading * math.exp(-gap / _FADING_TIME))
            torque = torque + self._fading
        changed = self._mode != self._settings.mode or action is not self._chosen()
        integral = self._borne(robot)
        if changed or self._integral_settings is not integral:
            self._select_action(integral)
            self._take_over(robot, v, torque, reset=changed)
        return torque

    def _chosen(self) -> IntegralAction | None:
        """Return the action that the settings ask for."""
        mode = self._settings.mode
        if mode in TASKS and self._settings.integral.anti_windup != "qp":
            mode = PRINTED.format(mode)
        return self.actions.get(mode)

    def _borne(self, robot: RobotModel) -> IntegralSettings:
        """Return the settings of the integral action with a gain that is stable here."""
        asked, mode = self._settings.integral, self._settings.mode
        if mode == "none" or asked.anti_windup == "paper_mass":
            return asked  # K = lambda M does not depend on the posture
        gain = self._stable.of(asked.gain, robot.M, robot.dt, _MOST[mode])
        if gain == asked.gain:
            return asked
        if asked is self._asked and gain == self._integral_settings.gain:
            return self._integral_settings
        return replace(asked, gain=gain)

    def _select_action(self, integral: IntegralSettings) -> None:
        """Let the mode that is set, and these settings, hold from now on."""
        self._mode, self._asked = self._settings.mode, self._settings.integral
        self._integral_settings = integral
        self._action = self._chosen()
        for action in self.actions.values():
            action.settings = self._integral_settings

    def _take_over(self, robot: RobotModel, v: Array, torque: Array, reset: bool) -> None:
        """Let the present action give `torque` now; what it cannot give fades."""
        taken = self._zero
        try:
            arm = self._arm(robot, v)
            if reset:
                self._begin(robot, arm)
            if self._action is not None:
                taken = self._action.initialise(torque, arm)
        except ValueError:  # too fast, or numbers that are not finite: all of it fades
            self._started = False
        self._fade(torque - taken)

    def _begin(self, robot: RobotModel, arm: ArmTerms) -> None:
        """Let the memory of the mode begin, empty, at this state."""
        if self._action is not None:
            self._action.reset(arm)
        self._q_last, self._v_last = robot.q.copy(), arm.v.copy()
        self._started, self._lost = True, False

    def _arm(self, robot: RobotModel, v: Array) -> ArmTerms:
        """Return what the actions need to know of the arm."""
        rows = TASKS.get(self._mode, slice(0, 6))
        J, J_dot = robot.J[rows], robot.J_dot[rows]
        if robot.others:
            J = np.vstack([J, *(hand.J[rows] for hand in robot.others)])
            J_dot = np.vstack([J_dot, *(hand.J_dot[rows] for hand in robot.others)])
        return ArmTerms(robot.M, robot.C, J, J_dot, v)

    def _fade(self, torque: Array) -> None:
        self._fading = torque
        self._faded = bool(np.abs(torque).max() < _NEGLIGIBLE)


@compiled
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
    for i in range(len(v)):
        impulse = M[i, i] * abs(a_last[i] * elapsed - (v[i] - v_last[i]))
        way = abs(q[i] - q_last[i]) - elapsed * (abs(v[i]) + abs(v_last[i]))
        # A NaN is not within its limits.
        if not (impulse <= disturbance_max[i] * elapsed and way <= _POSITION_JUMP):
            return True
    return False
