"""The torque added to the model's: integral action in one of its modes, and friction's.

Modes are ``none``; ``joints``, every joint stiff, (3)-(14) of [Benallegue2021]; and ``task``,
stiff in the task and free in its null space, (15)-(26). Whatever is changed while the arm moves,
and whatever comes instead of its next state, the torque goes on from where it was. Friction is
compensated beside it, with a budget of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.compensation import FrictionCompensation
from torque_safety_controller.friction.settings import FrictionSettings, no_friction
from torque_safety_controller.integral_feedback.feedback import IntegralFeedback
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.nullspace.compliance import NullspaceCompliance
from torque_safety_controller.nullspace.settings import NullspaceSettings
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

MODES = ("none", "joints", "task")

LONGEST_GAP = 2.5
"""Periods that a step may take, a missed deadline being 2; a longer gap is not integrated over."""

_POSITION_JUMP = 0.05  # rad or m; beyond what the velocities account for
_FADING_TIME = 0.2  # s; of what a mode cannot take over
_NEGLIGIBLE = 1e-9  # N m


@dataclass(frozen=True, eq=False)
class AdditionalSettings:
    """What may change while the controller runs.

    Attributes:
        mode: one of `MODES`.
        joints: of mode ``joints``.
        task: of mode ``task``; None where the task leaves no null space.
        disturbance_max: largest disturbance of each joint that is integrated, shape (n,), N m;
            what friction and a wrong model never are, but a sensor's glitch or a blow may be.
        friction: of the friction compensation; None for none.
    """

    mode: str
    joints: IntegralSettings
    task: NullspaceSettings | None
    disturbance_max: Array
    friction: FrictionSettings | None = None

    def __post_init__(self) -> None:
        if self.friction is None:
            n = len(self.joints.budget)
            object.__setattr__(self, "friction", FrictionSettings(no_friction(n), np.zeros(n)))


class AdditionalTorque:
    """Additional torque of one arm.

    Args:
        settings: may be replaced between steps: the torque does not jump.
        rows: which rows of the pose's Jacobian are the task of mode ``task``.

    Attributes:
        last: what the last step added, shape (n,), N m.
        integral: what of it is the integral action's, shape (n,), N m.
        skipped: steps that were not integrated over: time jumped, or the state did.
        joints: the integral action of mode ``joints``.
        task: that of mode ``task``, or None.
        friction: the friction compensation.
    """

    def __init__(self, settings: AdditionalSettings, rows: slice = slice(0, 6)) -> None:
        n = len(settings.joints.budget)
        self.joints = IntegralFeedback(settings.joints)
        self.task: NullspaceCompliance | None = None
        if settings.task is not None:
            self.task = NullspaceCompliance(settings.task, rows.stop - rows.start)
        self.friction = FrictionCompensation(settings.friction)
        self.skipped = 0
        self._rows = rows
        self._settings = settings
        self._zero = np.zeros(n)
        self.start()
        # Compiled now, not in a control loop.
        zero = self._zero
        _jumped(np.eye(n), zero, zero, zero, zero, zero, 0.0, zero)

    @property
    def settings(self) -> AdditionalSettings:
        """Settings; the next step goes over to them."""
        return self._settings

    @settings.setter
    def settings(self, settings: AdditionalSettings) -> None:
        self._settings = settings
        self.joints.settings = settings.joints
        if self.task is not None and settings.task is not None:
            self.task.settings = settings.task
        self.friction.settings = settings.friction

    @property
    def idle(self) -> bool:
        """Whether nothing is added, so that the model needs no rates of its matrices."""
        integrating = not (self._mode == self._settings.mode == "none" and self._faded)
        return not integrating and self.friction.idle

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Which joints are at their budget, shape (n,)."""
        if self._mode == "joints":
            return self.joints.saturated
        if self._mode == "task" and self.task.limited:
            budget = self.task.settings.budget
            return np.abs(self.task.additional_torque) >= (1.0 - 1e-9) * budget
        return np.zeros(self.last.size, dtype=bool)

    def start(self) -> None:
        """Forget the past: the next step begins with nothing added."""
        self._mode = self._settings.mode
        self._started = False
        self._lost = self._resuming = False
        self._q_last = self._v_last = self._zero
        self.last = self.integral = self._zero
        self._fading = self._zero
        self._faded = True
        self.friction.start()

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
        except ValueError:  # numbers beyond sense
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

    def _next(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> Array | None:
        """Return the torque of this step; None where the state jumped."""
        if not self._started:
            self._begin(robot, v)
        known = 0.0 < elapsed <= LONGEST_GAP * robot.dt and not self._lost
        jumped = known and self._mode != "none" and self._jumped(robot, v, a_last, elapsed)
        if not known or jumped:
            self._skip(robot, v, elapsed)
            self._lost = False
        self._q_last, self._v_last = robot.q.copy(), v.copy()
        if jumped:
            return None
        if known:
            torque = self._of_mode(robot, v, a_last, elapsed)
        else:
            self.skipped += 1
            torque = self._of_mode(robot, v, self._zero, 0.0)
        if self._resuming or not known:
            self._resuming = False
            self._fade(self.integral - torque)
        if not self._faded:
            gap = min(elapsed, LONGEST_GAP * robot.dt) if elapsed > 0.0 else 0.0
            self._fade(self._fading * math.exp(-gap / _FADING_TIME))
            torque = torque + self._fading
        if self._mode != self._settings.mode:
            self._enter(robot, v, torque)
        return torque

    def seed(self, robot: RobotModel, v: Array, torque: Array) -> Array:
        """Begin so that the torque is `torque` now; return that. Friction's fades in.

        The mode that is set takes over what it can, within budgets that are widened as far as
        they must be and for some time; the rest fades.

        Args:
            robot: of the arm, updated with rates.
            v: velocity, shape (n,), rad/s.
            torque: shape (n,), N m, finite.
        """
        self.friction.start()
        self._enter(robot, v, torque)
        self.last = self.integral = torque
        return torque

    def _enter(self, robot: RobotModel, v: Array, torque: Array) -> None:
        """Enter the mode that is set so that it gives `torque` now; see `seed`."""
        self._mode = self._settings.mode
        taken = self._zero
        try:
            self._begin(robot, v)
            if self._mode == "joints":
                taken = self.joints.seed(torque, robot.M, robot.C)
            elif self._mode == "task":
                J, J_dot = robot.J[self._rows], robot.J_dot[self._rows]
                taken = self.task.seed(torque, robot.M, robot.C, J, J_dot, v)
        except ValueError:  # too fast, or numbers beyond sense: all of it fades
            self._started = False
        self._fade(torque - taken)

    def _begin(self, robot: RobotModel, v: Array) -> None:
        """Let the memory of the mode begin, empty, at this state."""
        if self._mode == "joints":
            self.joints.start(v)
        elif self._mode == "task":
            self.task.start(v, robot.J[self._rows])
        self._q_last, self._v_last = robot.q.copy(), v.copy()
        self._started, self._lost = True, False

    def _jumped(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> bool:
        """Return whether nothing that the integral is for can have changed the state so."""
        q_last, v_last, largest = self._q_last, self._v_last, self._settings.disturbance_max
        return _jumped(robot.M, q_last, robot.q, v_last, v, a_last, elapsed, largest)

    def _of_mode(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> Array:
        """Return the torque of the present mode."""
        if self._mode == "joints":
            return self.joints.torque(robot.M, robot.C, v, a_last, elapsed)
        if self._mode == "task":
            J, J_dot = robot.J[self._rows], robot.J_dot[self._rows]
            return self.task.torque(robot.M, robot.C, J, J_dot, v, a_last, elapsed)
        return self._zero

    def _skip(self, robot: RobotModel, v: Array, elapsed: float) -> None:
        gap = elapsed if 0.0 <= elapsed < math.inf else 0.0
        if self._mode == "joints":
            self.joints.skip(v, gap)
        elif self._mode == "task":
            self.task.skip(v, robot.J[self._rows], gap)

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
    """Return whether a joint's velocity or position changed by more than can be.

    Args:
        M: mass matrix, shape (n, n), kg m^2.
        q_last: position, shape (n,), rad.
        q: position in the next step, shape (n,), rad.
        v_last: velocity, shape (n,), rad/s.
        v: velocity in the next step, shape (n,), rad/s.
        a_last: acceleration asked for in between, shape (n,), rad/s^2.
        elapsed: time in between, s.
        disturbance_max: what acts on a joint's own inertia at most, shape (n,), N m.
    """
    for i in range(len(v)):
        impulse = M[i, i] * abs(a_last[i] * elapsed - (v[i] - v_last[i]))
        way = abs(q[i] - q_last[i]) - elapsed * (abs(v[i]) + abs(v_last[i]))
        # A NaN is not within its limits.
        if not (impulse <= disturbance_max[i] * elapsed and way <= _POSITION_JUMP):
            return True
    return False
