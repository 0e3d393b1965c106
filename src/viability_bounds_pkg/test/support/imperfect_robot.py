# SPDX-License-Identifier: Apache-2.0
"""Robots that do their worst within what is declared, watched in continuous time.

States have shape (m, n): m motions of each of n joints. All is chosen for each motion and joint
by itself: errors of the states, of the acceleration, which commands come late or never, and the
accelerations asked for within the bounds.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from adversary import Violations, advance

from viability_bounds_pkg.bounds.torque_margin import TorqueMargins
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.state import State
from viability_bounds_pkg.uncertainty import DeclaredUncertainty, Loop, uncertainty_margins
from viability_bounds_pkg.viability import BoundsSolver

SAMPLES = np.linspace(0.0, 1.0, 9)[1:]
"""Instants within half a period at which a joint with a lag is watched."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A robot, what is declared of it, and the bounds that follow.

    Attributes:
        limits: of n joints.
        dt: control period, s.
        declared: what may go wrong.
        solver: the bounds.
        predicted: whether states are predicted to the instant at which commands act.
    """

    limits: JointLimits
    dt: float
    declared: DeclaredUncertainty
    solver: BoundsSolver
    predicted: bool


def plan(limits, dt, declared, predicted=True, shares=(1.0, 1.0)):
    """Return a plan with the margins that follow from what is declared.

    Args:
        limits: of n joints.
        dt: control period, s.
        declared: what may go wrong.
        predicted: as in `Plan`.
        shares: of the margins E_q and E_v to be kept; below 1 is less than needed.
    """
    errors = State(declared.position_error, declared.velocity_error)
    w = declared.acceleration_disturbance
    margins = uncertainty_margins(declared, dt, limits, w, errors, predicted)
    solver = BoundsSolver(
        limits,
        margins.horizon,
        w,
        position_error=shares[0] * margins.position_error,
        velocity_error=shares[1] * margins.velocity_error,
    )
    return Plan(limits, dt, declared, solver, predicted)


class ImperfectRobot:
    """Joints with a motor lag that start at rest in the middle of their ranges.

    Args:
        plan: what may go wrong.
        motions: how many of each joint.
        rng: random generator.

    Attributes:
        seen: largest violations of the limits.
        lost: states that the bounds took for hopeless.
    """

    def __init__(self, plan: Plan, motions: int, rng: np.random.Generator):
        declared, limits = plan.declared, plan.limits
        self._plan, self._rng = plan, rng
        shape = motions, len(limits)
        middle = 0.5 * (limits.q_min + limits.q_max)
        self.q, self.v = np.tile(middle, (motions, 1)), np.zeros(shape)
        self._a = np.zeros(shape)
        self._lag = declared.motor_lag
        # The command that acts, and those under way, each with the periods until it arrives.
        self._held = np.zeros(shape)
        self._coming = deque([np.zeros(shape), np.full(shape, d)] for d in range(declared.delay))
        self._row = np.zeros(shape, dtype=int)
        self._towards = rng.choice([-1.0, 1.0], shape)
        self.seen, self.lost = Violations(limits), 0

    def run(self, steps: int):
        """Make a number of control periods."""
        for _ in range(steps):
            flip = self._rng.random(self.q.shape) < 0.02
            self._towards = np.where(flip, -self._towards, self._towards)
            self._send(self._answer(self._report()))
            self._move()
        return self

    def _harm(self, share=0.8):
        """Return the signs that harm most, mostly."""
        rng, shape = self._rng, self.q.shape
        return np.where(rng.random(shape) < share, self._towards, rng.choice([-1.0, 1.0], shape))

    def _report(self):
        """Return the state that is told: mostly too far from the limit, and too slow."""
        declared, size = self._plan.declared, np.ones(2)
        if self._rng.random() < 0.3:
            size = self._rng.random(2)
        q = self.q - size[0] * declared.position_error * self._harm()
        return State(q, self.v - size[1] * declared.velocity_error * self._harm())

    def _answer(self, state):
        """Return the command: mostly as fast as the bounds allow."""
        plan, (q, v) = self._plan, state
        if plan.predicted:
            q, v = q + self._lag * v, v + self._lag * self._a
            newest = len(self._coming) - plan.declared.delay
            for command, _ in list(self._coming)[newest:]:
                q, v = q + plan.dt * v + 0.5 * plan.dt**2 * command, v + plan.dt * command
        lower, upper, viable = plan.solver.bounds(q, v)
        self.lost += int((~viable).sum())
        a = np.where(self._harm(0.95) > 0.0, upper, lower)
        between = self._rng.random(a.shape) < 0.05
        return np.where(between, self._rng.uniform(lower, upper), a)

    def _send(self, command):
        """Put a command under way; the less it harms, the later it arrives, or never."""
        declared, rng, shape = self._plan.declared, self._rng, command.shape
        before = self._coming[-1][0] if self._coming else self._held
        harmless = self._towards * (command - before) < 0.0
        wanted = np.where(rng.random(shape) < 0.8, harmless, rng.random(shape) < 0.5)
        missed = wanted & (self._row < declared.missed_deadlines)
        self._row = np.where(missed, self._row + 1, 0)
        late = np.where(wanted | (rng.random(shape) < 0.1), declared.delay_jitter, 0)
        # A missed command never arrives.
        arrival = np.where(missed, 10**6, declared.delay + late)
        self._coming.append([command, arrival])
        for each in self._coming:
            self._held = np.where(each[1] <= 0, each[0], self._held)
            # Once: an older command that is late does not take the place of a newer one.
            each[1] = each[1] - 1
        self._drop_older()

    def _drop_older(self):
        """Forget commands that arrived, and those that a newer one was ahead of."""
        arrived = np.zeros(self.q.shape, dtype=bool)
        for each in reversed(self._coming):
            each[1] = np.where(arrived, 10**6, each[1])
            arrived |= each[1] < 0
            each[1] = np.where(each[1] < 0, 10**6, each[1])
        longest = self._plan.declared.delay + self._plan.declared.delay_jitter
        while len(self._coming) > max(longest, self._plan.declared.delay):
            self._coming.popleft()

    def _move(self):
        """Move for a period, with an error of the acceleration that changes within it."""
        w = self._plan.declared.acceleration_disturbance
        for _ in range(2):
            self._move_with(w * self._harm(), 0.5 * self._plan.dt)

    def _move_with(self, disturbance, time):
        lag, command = self._lag, self._held
        if not lag.any():
            q, v, low, high = advance(self.q, self.v, command + disturbance, time)
            self.q, self.v, self._a = q, v, command
            self.seen.see(low, high, v)
            return
        q, v, a = self.q, self.v, self._a
        for t in SAMPLES * time:
            gone = 1.0 - np.exp(-t / np.maximum(lag, 1e-12))
            rest = lag * (a - command)
            self.v = v + t * (command + disturbance) + rest * gone
            self.q = q + t * v + 0.5 * t**2 * (command + disturbance) + rest * (t - lag * gone)
            self._a = command + (a - command) * (1.0 - gone)
            self.seen.see(self.q, self.q, self.v)


def random_plan(rng, joints, shortest=1e-3, shares=(1.0, 1.0), predicted=True, **kinds):
    """Return a plan for random joints, those for which there are bounds, and their rates.

    Args:
        rng: random generator.
        joints: how many to choose from; the last ones that are left out make it fewer.
        shortest: control period, s; up to ten times as long.
        shares: as for `plan`.
        predicted: as for `plan`.
        kinds: values of `DeclaredUncertainty` that are given; a bandwidth is the lowest.
    """
    dt = shortest * 10.0 ** rng.uniform(0.0, 1.0)
    a_min, a_max = -rng.uniform(2.0, 20.0, joints), rng.uniform(2.0, 20.0, joints)
    half, v_max = rng.uniform(0.2, 2.0, joints), rng.uniform(0.5, 4.0, joints)
    weakest = np.minimum(-a_min, a_max)
    bandwidth = kinds.get("motor_bandwidth", 0.0) * rng.uniform(1.0, 10.0, joints)
    own = {
        "position_error": half * 10.0 ** rng.uniform(-5.0, -2.0, joints),
        "velocity_error": v_max * 10.0 ** rng.uniform(-3.0, -1.5, joints),
        "acceleration_disturbance": weakest * rng.uniform(0.0, 0.3, joints),
        "delay": 0,
        "delay_jitter": 0,
        "missed_deadlines": 0,
    }
    declared = DeclaredUncertainty(**{**own, **kinds, "motor_bandwidth": bandwidth})
    names = tuple(f"joint{j}" for j in range(joints))
    limits = JointLimits(names, -half, half, v_max, a_min, a_max)
    margins = TorqueMargins(*np.zeros((3, joints)))
    good = []
    for j in range(joints):
        own = TorqueMargins(*(each[j : j + 1] for each in margins))
        with suppress(JointLimitsError):
            Loop(limits.of_joint(j), own, dt, 0.0, predicted).bounds(of_joints(declared, [j]))
            good.append(j)
    if not good:
        return random_plan(rng, joints, shortest, shares, predicted, **kinds)
    names = tuple(names[j] for j in good)
    limits = JointLimits(names, -half[good], half[good], v_max[good], a_min[good], a_max[good])
    return plan(limits, dt, of_joints(declared, good), predicted, shares)


def of_joints(declared, joints):
    """Return what is declared of some joints alone."""
    values = {k: v[joints] if np.ndim(v) and len(v) else v for k, v in vars(declared).items()}
    return DeclaredUncertainty(**values)
