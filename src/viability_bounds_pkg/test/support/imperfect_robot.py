# SPDX-License-Identifier: Apache-2.0
"""Robots that do their worst within what is declared, watched in continuous time.

States have shape (m, n): m motions of each of n joints. All is chosen for each motion and joint
by itself: errors of the states, of the acceleration, which commands come late or never, and the
accelerations asked for within the bounds.
"""

from __future__ import annotations

import numpy as np
from adversary import Violations, advance

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.state import State
from viability_bounds_pkg.uncertainty import DeclaredUncertainty, uncertainty_margins
from viability_bounds_pkg.viability import BoundsSolver

JOINTS, MOTIONS = 30, 8


def random_declarations(rng, **kinds):
    """Return limits of random joints, and what is declared of them.

    Args:
        rng: random generator.
        kinds: values of `DeclaredUncertainty`; a bandwidth is the lowest.
    """
    a_min, a_max = -rng.uniform(4.0, 20.0, JOINTS), rng.uniform(4.0, 20.0, JOINTS)
    half, v_max = rng.uniform(0.3, 2.0, JOINTS), rng.uniform(1.0, 4.0, JOINTS)
    names = tuple(f"joint{j}" for j in range(JOINTS))
    bandwidth = kinds.get("motor_bandwidth", 0.0) * rng.uniform(1.0, 10.0, JOINTS)
    own = {
        "position_error": half * 10.0 ** rng.uniform(-5.0, -2.0, JOINTS),
        "velocity_error": v_max * 10.0 ** rng.uniform(-3.0, -1.5, JOINTS),
        "acceleration_disturbance": np.minimum(-a_min, a_max) * rng.uniform(0.0, 0.3, JOINTS),
    }
    declared = {"delay": 0, "delay_jitter": 0, "missed_deadlines": 0, **own, **kinds}
    return (
        JointLimits(names, -half, half, v_max, a_min, a_max),
        DeclaredUncertainty(**{**declared, "motor_bandwidth": bandwidth}),
    )


class ImperfectRobot:
    """Joints that start at rest in the middle of their ranges, controlled by the bounds.

    Args:
        limits: of n joints.
        declared: what may go wrong.
        dt: control period, s.
        rng: random generator.
        predicted: whether states are predicted to the instant at which commands act.
        shares: of the margins E_q and E_v that the bounds keep; below 1 is less than needed.

    Attributes:
        solver: the bounds.
        seen: largest violations of the limits; states that the bounds took for hopeless.
    """

    def __init__(self, limits, declared, dt, rng, predicted=True, shares=(1.0, 1.0)):
        self.declared, self._dt, self._rng, self._predicted = declared, dt, rng, predicted
        errors = State(declared.position_error, declared.velocity_error)
        w = declared.acceleration_disturbance
        margins = uncertainty_margins(declared, dt, limits, w, errors, predicted)
        self.solver = BoundsSolver(
            limits,
            margins.horizon,
            w,
            position_error=shares[0] * margins.position_error,
            velocity_error=shares[1] * margins.velocity_error,
        )
        shape = MOTIONS, len(limits)
        self.q = np.tile(0.5 * (limits.q_min + limits.q_max), (MOTIONS, 1))
        self.v, self.a, self._acting = np.zeros((3, *shape))
        # Commands with the periods in which they arrive, the newest last.
        self._sent = [(np.zeros(shape), np.zeros(shape))] * (declared.delay + 1)
        self._missed = np.zeros(shape)
        self._towards = rng.choice([-1.0, 1.0], shape)
        self.seen = Violations(limits)

    def run(self, steps):
        """Make a number of control periods."""
        for period in range(steps):
            flip = self._rng.random(self.q.shape) < 0.02
            self._towards = np.where(flip, -self._towards, self._towards)
            self._send(self._answer(self._report()), period)
            for command, arrival in self._sent:
                self._acting = np.where(arrival <= period, command, self._acting)
            w = self.declared.acceleration_disturbance
            for _ in range(2):  # within the period the error changes
                self._move(w * self._harm(), 0.5 * self._dt)
        return self

    def _harm(self, share=0.8):
        """Return the signs that harm most, mostly."""
        rng, shape = self._rng, self.q.shape
        return np.where(rng.random(shape) < share, self._towards, rng.choice([-1.0, 1.0], shape))

    def _report(self):
        """Return the state that is told: mostly too far from the limit, and too slow."""
        declared = self.declared
        q = self.q - declared.position_error * self._harm()
        return State(q, self.v - declared.velocity_error * self._harm())

    def _answer(self, state):
        """Return the command: mostly as fast as the bounds allow."""
        lag = self.declared.motor_lag
        if self._predicted:
            state = State(state.q + lag * state.v, state.v + lag * self.a)
            for command, _ in self._sent[len(self._sent) - self.declared.delay :]:
                state = state.after(command, self._dt)
        lower, upper, viable = self.solver.bounds(*state)
        self.seen.lost += int((~viable).sum())
        return np.where(self._harm(0.95) > 0.0, upper, lower)

    def _send(self, command, period):
        """Put a command under way; the less it harms, the later it arrives, or never."""
        declared, rng, shape = self.declared, self._rng, command.shape
        harmless = self._towards * (command - self._sent[-1][0]) < 0.0
        wanted = np.where(rng.random(shape) < 0.8, harmless, rng.random(shape) < 0.5)
        missed = wanted & (self._missed < declared.missed_deadlines)
        self._missed = np.where(missed, self._missed + 1, 0)
        late = np.where(wanted | (rng.random(shape) < 0.1), declared.delay_jitter, 0)
        arrival = np.where(missed, np.inf, period + declared.delay + late)
        # No command that is older than these acts.
        kept = 1 + declared.delay + declared.delay_jitter + declared.missed_deadlines
        self._sent = [*self._sent, (command, arrival)][-kept:]

    def _move(self, disturbance, time):
        """Move for a time, with an error of the acceleration."""
        lag, command = self.declared.motor_lag, self._acting
        if not lag.any():
            self.q, self.v, low, high = advance(self.q, self.v, command + disturbance, time)
            self.a = command
            self.seen.see(low, high, self.q, self.v)
            return
        q, v, a = self.q, self.v, self.a
        for t in np.linspace(0.0, time, 5)[1:]:
            gone = 1.0 - np.exp(-t / lag)
            rest = lag * (a - command)
            self.v = v + t * (command + disturbance) + rest * gone
            self.q = q + t * v + 0.5 * t**2 * (command + disturbance) + rest * (t - lag * gone)
            self.a = command + (a - command) * (1.0 - gone)
            self.seen.see(self.q, self.q, self.q, self.v)
