# SPDX-License-Identifier: Apache-2.0
"""Mode of the controller, its reason, and the share of the goals that the arm may serve.

Events come in, from states, limits, goals, the user and watchdogs. What follows from them is in
the tables of `modes`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.command_check import CommandCheck
from torque_safety_controller.kept_rate import KeptRate
from torque_safety_controller.modes import CAUSES, CHANGES, Control, Goals, Mode
from torque_safety_controller.ramp import Ramp

Array = NDArray[np.float64]

REST_SPEED = 0.02
"""Speed below which a joint counts as at rest, rad/s."""

REST_PATIENCE = 2.0
"""Longest time to wait for rest before the drives take over, s; a pushed arm may not rest."""

INTEGRAL_KEPT = 0.5
"""For how long the integral action's torque is kept while commands do not act, s. It balances the
friction of a motion, and would push an arm that has stopped since."""


class Order(NamedTuple):
    """What the supervisor asks of a control step.

    Attributes:
        share: of the goals' accelerations, from 0 to 1; the rest brings the arm to rest.
        track: whether goals are served; else the arm is brought to rest.
        obeyed: whether the last commands acted, as far as is known; while they do not, nothing is
            learned from how the arm moves.
        forget_disturbance: whether what was learned of disturbances no longer holds.
        forget_integral: whether the integral action's torque was of a motion that has ended.
    """

    share: float = 1.0
    track: bool = True
    obeyed: bool = True
    forget_disturbance: bool = False
    forget_integral: bool = False


REST = Order(share=0.0, track=False)
"""Brings the arm to rest."""


class Supervisor:
    """Holds mode, reason, control and share of the goals; told of events, it gives orders.

    All times are those of the states' stamps: in lockstep nothing depends on the machine.

    Args:
        dt: control period, s.
        control: ``torque`` or ``position``, at start.
        covered: longest row of states without an answer that the bounds hold for.
        pause: time without an answer after which the robot has stopped itself, s.
        commands: detects commands that do not act; None to presume that they do.
        tell: told mode and reason when one of them has changed.
        warn: told in words when the arm is slowed, when it goes on, and when the machine does not
            keep the control rate.

    Attributes:
        mode, reason: present ones.
        changes: how often they have changed.
        control: which control commands the joints.
    """

    def __init__(
        self,
        dt: float,
        control: str,
        covered: int,
        pause: float,
        commands: CommandCheck | None,
        tell: Callable[[Mode, str], object],
        warn: Callable[[str], object],
    ) -> None:
        self._dt, self._covered, self._pause = dt, covered, pause
        self._commands, self._tell, self._warn = commands, tell, warn
        self._ramp = Ramp(dt)
        self._kept = KeptRate(dt, covered, warn)
        self._slowed_by = ""
        self._giving_back_for = self._ignored_for = 0.0
        self._rows_too_long = self._longest_row = 0
        self.mode, self.reason, self.changes = Mode.STOPPED, "no joint state yet", 0
        self._causes = {"silent": self.reason}
        self._start = Control(control)
        self._set_control(self._start, "as at start")

    # Watchdogs

    def silent(self, reason: str) -> None:
        """No joint state comes, or none that can be used, for long."""
        self._stop("silent", reason)

    def refused(self, reason: str) -> None:
        """Joint states come, but cannot be used."""
        self._stop("refused", reason)

    def _stop(self, cause: str, reason: str) -> None:
        if self.mode is not Mode.STOPPED:
            self._raise(cause, reason)
            self._decide()

    def repeated(self) -> None:
        """A state that was answered comes again, and gets the same answer."""
        self._causes.pop("silent", None)
        self._causes.pop("refused", None)
        self._decide()

    def limits_came(self) -> None:
        """Limits come for a state that was answered without: the next one waits for its own."""
        self._causes.pop("stale", None)

    # States and their answers

    def robot_returned(self, reason: str) -> None:
        """The robot has started, or was away; `reason` to rest before goals count, or empty."""
        self.put_elsewhere()
        if self._commands is not None:
            self._commands.reset()
        if reason:
            self._raise("moves", reason)

    def put_elsewhere(self) -> None:
        """The robot may have been moved: torque control never begins by itself."""
        back = self._start is Control.POSITION and self.control is Control.TORQUE
        control = Control.POSITION if back else CHANGES.get((self.control, "away"))
        if control is not None:
            self._set_control(control, "the robot was silent or started over")

    def state(
        self,
        elapsed: float | None,
        v: Array,
        effort: Array | None,
        limits: bool = True,
        goal: str = "",
        moved: str = "",
    ) -> Order:
        """A usable state is to be answered: return the order for that.

        Args:
            elapsed: since the state answered before, s; None if there is none.
            v: velocity, shape (n,), rad/s.
            effort: torque of the motors, shape (n,), N m; None if it is not known.
            limits: whether the state's acceleration limits are there.
            goal: cause not to serve goals; empty for none.
            moved: which locked joint moves, in words; empty for none.
        """
        causes = self._causes
        for ended in ("silent", "refused", "rival", "moved", "no goal", "stale"):
            causes.pop(ended, None)
        if goal:
            self._raise(goal)
        if moved:
            self._raise("moved", moved)
        if not limits and self.control is not Control.POSITION:
            self._raise("stale")
            self.change("failed", f"handover failed: {CAUSES['stale'].reason}")
        if self.by_drives:
            return REST
        at_rest = max(map(abs, v.tolist())) <= REST_SPEED
        passed = elapsed or 0.0
        if self.control is Control.GIVING_BACK:
            self._giving_back_for += passed
            if at_rest or self._giving_back_for > REST_PATIENCE:
                self.change("at rest", "enable_torque")
                return REST
        missed = self._missed(passed)
        obeyed = self._obeyed(effort, passed)
        if elapsed is not None:
            self._advance(passed, at_rest, obeyed)
        return Order(
            self._ramp.share,
            not any(CAUSES[name].goals is Goals.ASIDE for name in causes),
            obeyed,
            missed or "ignored" in causes,
            passed > self._pause or self._ignored_for > INTEGRAL_KEPT,
        )

    def answered(self, tau: Array | None = None, failure: str = "", planned: bool = True) -> None:
        """The state has been answered.

        Args:
            tau: torque that was sent, shape (n,), N m; None for positions.
            failure: why the QP was not used though it could have been, or empty.
            planned: whether the safety filter knows a plan.
        """
        for name in ("failed", "no plan"):
            self._causes.pop(name, None)
        if failure:
            self._raise("failed", f"solver failed: {failure}")
        if not planned:
            self._raise("no plan")
        if self._commands is not None:
            if tau is None:
                self._commands.reset()
            else:
                self._commands.sent(tau)
        self._decide()

    def _missed(self, elapsed: float) -> bool:
        """Return whether more states were not answered than the bounds cover."""
        row = round(elapsed / self._dt) - 1
        self._longest_row = max(self._longest_row, row)
        if row >= 0 and elapsed <= self._pause:
            self._kept.add(row)
        if row <= self._covered:
            return False
        self._rows_too_long += 1
        what = f"states in a row without an answer, the bounds cover {self._covered}"
        self._slow(f"too many {what}", f"{row} {what}")
        if elapsed > self._pause:
            self._raise("moves", "states were not answered for longer than bounds_timeout")
        return True

    def _obeyed(self, effort: Array | None, elapsed: float) -> bool:
        """Return whether the last commands acted, as far as is known."""
        commands = self._commands
        obeyed = commands is None or effort is None or commands.agrees(effort)
        self._ignored_for = 0.0 if obeyed else self._ignored_for + elapsed
        if commands is None or obeyed or not commands.ignored:
            self._causes.pop("ignored", None)
        else:
            self._raise("ignored")
        return obeyed

    def _advance(self, elapsed: float, at_rest: bool, obeyed: bool) -> None:
        """Let the share fall or rise by the time since the last state."""
        was_slowed, lasting = self._ramp.share < 1.0, set(self._causes) - {"moves"}
        waits = any(CAUSES[name].goals is not Goals.KEPT for name in lasting)
        self._ramp.advance(elapsed, at_rest, waits or not obeyed)
        if self._ramp.share > 0.0:
            self._causes.pop("moves", None)
        if was_slowed and self._ramp.share == 1.0:
            self._warn("the arm goes on")

    # Control

    def enable(self, torque: bool) -> None:
        """The user asks for torque control, or for position control."""
        self.change("enable" if torque else "disable", "enable_torque")

    def change(self, event: str, reason: str) -> None:
        """Change the control by an event of `CHANGES`."""
        if (control := CHANGES.get((self.control, event))) is not None:
            self._set_control(control, reason)
            if event == "failed":
                self._warn(reason)

    @property
    def by_drives(self) -> bool:
        """Whether positions are sent."""
        return self.control in (Control.POSITION, Control.TAKING_OVER)

    def _set_control(self, control: Control, reason: str) -> None:
        self.control, self._giving_back_for = control, 0.0
        self._causes.pop("drives", None)
        self._causes.pop("giving back", None)
        if self.by_drives:
            self._raise("drives", reason)
        elif control is Control.GIVING_BACK:
            self._raise("giving back")

    # What follows

    def _raise(self, name: str, reason: str = "") -> None:
        cause = CAUSES[name]
        reason = self._causes[name] = reason or cause.reason
        if cause.goals is Goals.SLOWED:
            self._causes["moves"] = f"comes to rest: {reason}"
            self._slowed_by = reason
            self._ramp.fall(at_once=True)
        elif cause.goals is Goals.FALLING:
            self._slow(reason, reason)

    def _slow(self, reason: str, line: str) -> None:
        if self._ramp.share == 1.0:
            self._warn(f"{line}: the arm is slowed")
        self._slowed_by = reason
        self._ramp.fall()

    def _decide(self) -> None:
        """Enter the mode of the first cause that lasts."""
        mode, reason = Mode.TRACKING, "goal"
        for name, cause in CAUSES.items():
            if name in self._causes and cause.mode is not None:
                mode, reason = cause.mode, self._causes[name]
                break
        if (mode, reason) != (self.mode, self.reason):
            self.mode, self.reason = mode, reason
            self.changes += 1
            self._tell(mode, reason)

    @property
    def stale(self) -> bool:
        """Whether states are answered without acceleration limits."""
        return "stale" in self._causes

    @property
    def trouble(self) -> str:
        """What to report besides mode and reason; empty if there is nothing."""
        share = self._ramp.share
        return f"slowed to {share:.0%}: {self._slowed_by}" if share < 1.0 else ""

    def values(self) -> dict[str, Any]:
        """Return values for diagnostics."""
        return {
            "mode": self.mode.value,
            "reason": self.reason,
            "mode_changes": self.changes,
            "control": self.control.value,
            "goal_share": self._ramp.share,
            "missed_rows_too_long": self._rows_too_long,
            "missed_row_longest": self._longest_row,
            "commands_ignored": 0 if self._commands is None else self._commands.times,
        }
