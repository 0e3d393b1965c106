# SPDX-License-Identifier: Apache-2.0
"""One control step, and the protocol of the parts that a controller is made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import FrictionSettings
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.qp import (
    AccelerationRange,
    ContactForces,
    LinearConstraints,
    Solution,
)
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.supervisor import Order
from torque_safety_controller.tasks.admittance import InteractionSettings
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.task import Task

Array = NDArray[np.float64]

LONGEST_GAP = 2.5
"""Periods that a step may take, a missed deadline being 2; nothing is learned from longer ones."""


@dataclass(frozen=True)
class Settings:
    """Settings of a controller and its parts that are live.

    Attributes:
        gains: of the tasks.
        integral: of the integral action.
        friction: of the friction compensation.
        interaction: of forces at the hand.
    """

    gains: Gains
    integral: IntegralSettings
    friction: FrictionSettings
    interaction: InteractionSettings


class Step:
    """What is known and decided in one control step.

    Parts fill it in, in their order, and read only what parts before them have written.
    Accelerations are the arm's real ones: `disturbance` is what they differ by from the commanded
    ones, and is taken off once, where the QP is built.

    Attributes:
        robot: model of the arm, updated to its state.
        limits: of the accelerations, as they were given; None where they did not come.
        order: of the supervisor.
        elapsed: time since the last step, s.
        tau_max: torque limits, shape (n,), N m.
        a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
        hold_kd: damping of an arm without a goal, 1/s.
        tasks: what the QP serves.
        tracking: whether these are those of the goals.
        stiffness: share of the pose task's stiffness by direction, shape (6,); None for all of it.
        torque: what is added to the model's, shape (n,), N m.
        integral_change: by how much the integral action's has changed, shape (n,), N m.
        disturbance: acceleration on top of the commanded one, shape (n,), rad/s^2.
        bounds: of the accelerations; they are only ever narrowed.
        eased: narrower bounds of the commanded accelerations, kept where they have a solution;
            estimates of disturbances are not to shake a slowed arm; None for none.
        rows: further constraints on the accelerations, by the part that asks for them. Where there
            is no solution, those with an upper limit give way to `fallback`.
        forces: what contacts may exert; None for nothing.
        fallback: acceleration that is allowed if bounds and rows have no solution; None for none.
        planned: whether a plan within all limits is known; it is where nobody looks for one.
        solution: of the QP; None where it has none, so that the arm only brakes.
        failure: why the QP has no solution, or empty.
        a: acceleration commanded, shape (n,), rad/s^2.
        tau: torque commanded, shape (n,), N m.
    """

    # What most steps begin and end with.
    tracking = False
    stiffness: Array | None = None
    eased: AccelerationRange | None = None
    forces: ContactForces | None = None
    fallback: Array | None = None
    planned = True
    solution: Solution | None = None
    failure = ""

    def __init__(
        self,
        robot: RobotModel,
        limits: AccelerationRange | None,
        order: Order,
        elapsed: float,
        tau_max: Array,
        a_last: Array,
        hold_kd: float,
    ) -> None:
        self.robot = robot
        self.limits = limits
        self.order = order
        self.elapsed = elapsed
        self.tau_max = tau_max
        self.a_last = a_last
        self.hold_kd = hold_kd
        self.tasks: list[Task] = []
        self.rows: dict[Part, LinearConstraints] = {}
        self.bounds = _unbounded(robot.n)
        self._nothing = nothing = np.zeros(robot.n)
        self.torque: Array = nothing
        self.integral_change: Array = nothing
        self.disturbance: Array = nothing
        self.a: Array = nothing
        self.tau: Array = nothing

    @property
    def rest(self) -> Array:
        """Acceleration that brings the arm to rest, shape (n,), rad/s^2."""
        rest: Array = -self.hold_kd * self.robot.v
        return rest

    @property
    def learns(self) -> bool:
        """Whether the last command acted for about as long as a control period."""
        return self.order.obeyed and 0.0 < self.elapsed <= LONGEST_GAP * self.robot.dt

    @property
    def relaxation(self) -> Array | None:
        """By how much the QP relaxed the bounds, shape (n,), rad/s^2; None for not at all."""
        return None if self.solution is None else self.solution.relaxation

    def commanded(self, bounds: AccelerationRange) -> AccelerationRange:
        """Return bounds of the commanded accelerations, for bounds of the real ones.

        A disturbance narrows them only: friction, which opposes the motion, must not widen them.
        For one upwards the upper bound is lowered, and else the lower one raised; if they cross,
        the other one follows.
        """
        if self.disturbance is self._nothing:
            return bounds
        lower, upper = np.empty(len(bounds.lower)), np.empty(len(bounds.lower))
        _narrow(self.disturbance, bounds.lower, bounds.upper, lower, upper)
        return AccelerationRange(lower, upper)

    def commanded_rows(self) -> LinearConstraints | None:
        """Return the rows as constraints of the commanded accelerations; None for none."""
        rows = [row for row in self.rows.values() if len(row.G)]
        if not rows:
            return None
        G, lower, upper = rows[0]
        if len(rows) > 1:
            G, lower, upper = map(np.concatenate, zip(*rows, strict=True))
        extra = G @ self.disturbance
        return LinearConstraints(G, lower - extra, upper - extra)

    def relaxation_of(self, part: Part) -> Array | None:
        """Return by how much the QP relaxed the rows of a part, in their units; None for not."""
        relaxed = None if self.solution is None else self.solution.constraint_relaxation
        first = 0
        for owner, rows in self.rows.items():
            if owner is part and relaxed is not None:
                return relaxed[first : first + len(rows.G)]
            first += len(rows.G)
        return None


class Part:
    """Something that a controller can do besides, with a memory of its own.

    A controller calls the parts of its list in their order. Each method does nothing here, so that
    a part has only those that it needs.
    """

    def configure(self, settings: Settings) -> None:
        """Go by changed settings from the next step on."""

    def reset(self, robot: RobotModel) -> None:
        """Forget the past: the arm may be elsewhere. `robot` is updated to its state."""

    def remodel(self, robot: RobotModel) -> None:
        """Go by a model whose masses or placements have changed from the next step on."""

    def prepare(self, step: Step) -> None:
        """Add tasks, rows, torque or forces to a step, or narrow its bounds."""

    def choose(self, step: Step, a: Array) -> Array:
        """Return the acceleration to command in place of the QP's, shape (n,), rad/s^2."""
        return a

    def learn(self, step: Step) -> None:
        """Learn from a step that has been decided: `a`, `tau` and `solution` are in it."""

    def resume(self, step: Step, torque: Array) -> None:
        """Begin from a torque that something else applies: [Benallegue2021], IV-A.

        Args:
            step: with the goals where the arm is.
            torque: what is applied beyond the model's torque, shape (n,), N m.
        """

    def report(self) -> dict[str, Any]:
        """Return values for diagnostics, by name."""
        return {}

    @property
    def trouble(self) -> str:
        """What is wrong at present, in words; empty for nothing."""
        return ""


@lru_cache
def _unbounded(n: int) -> AccelerationRange:
    return AccelerationRange(np.full(n, -np.inf), np.full(n, np.inf))


@njit(cache=True)
def _narrow(disturbance: Array, lower: Array, upper: Array, low: Array, high: Array) -> None:
    """Write bounds of the commanded accelerations to `low` and `high`, see `Step.commanded`."""
    for j in range(low.size):
        e = disturbance[j]
        if e > 0.0:
            high[j] = upper[j] - e
            low[j] = min(lower[j], high[j])
        else:
            low[j] = lower[j] - e
            high[j] = max(low[j], upper[j])


def joints_beyond(model: pin.Model, torque: Array, most: Array) -> str:
    """Return which joints need more torque than they have, in words; empty for none.

    Args:
        model: has the names of the n joints.
        torque: needed, shape (n,), N m.
        most: there is, shape (n,), N m.
    """
    names = list(model.names)[1:]
    return ", ".join(
        f"{name} needs {needed:.1f} of {limit:.1f} N m"
        for name, needed, limit in zip(names, np.abs(torque), most, strict=True)
        if needed > limit
    )


def too_weak_at(model: pin.Model, q: Array, most: Array) -> str:
    """Return which joints cannot hold the arm at `q`, in words; empty for none.

    Args:
        model: of the arm.
        q: positions, shape (n,), rad.
        most: torque that there is, shape (n,), N m.
    """
    torque = pin.computeGeneralizedGravity(model, model.createData(), q)
    return joints_beyond(model, torque, most)


def joints_named(robot: RobotModel, flags: NDArray[np.bool_]) -> str:
    """Return the names of the joints that are flagged, shape (n,); ``none`` for none."""
    names = list(robot.model.names)[1:]
    return ", ".join(name for name, flag in zip(names, flags, strict=True) if flag) or "none"
