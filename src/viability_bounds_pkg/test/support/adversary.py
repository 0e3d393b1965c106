# SPDX-License-Identifier: Apache-2.0
"""Motions that do their worst within the bounds, watched in continuous time.

States have shape (m, n): m motions of each of n joints, all with the same step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from joint_cases import column, position_window

VIOLATION = 1e-9
"""Largest violation of a limit in continuous time, rad and rad/s."""


def advance(q, v, a, dt):
    """Return the state after dt, and the lowest and highest position on the way."""
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.where(a != 0.0, -v / a, -1.0)
    turn = np.where((turn > 0.0) & (turn < dt), turn, dt)
    at_turn = q + turn * v + 0.5 * turn**2 * a
    q_next = q + dt * v + 0.5 * dt**2 * a
    low = np.minimum(np.minimum(q, q_next), at_turn)
    high = np.maximum(np.maximum(q, q_next), at_turn)
    return q_next, v + dt * a, low, high


def choose(q, v, lower, upper, limits, rng):
    """Return accelerations within the bounds; one motion after the other chooses differently."""
    nearer_above = limits.q_max - q < q - limits.q_min
    ways = [
        upper,
        lower,
        np.where(v > 0.0, upper, lower),
        np.where(nearer_above, upper, lower),
        np.where(rng.random(q.shape) < 0.5, lower, upper),
        rng.uniform(lower, upper),
    ]
    return np.choose(np.arange(len(q))[:, None] % len(ways), ways)


def too_fast(limits, q, v):
    """Return by how much velocities exceed what is allowed at their positions, rad/s."""
    lowest, highest = limits.velocities(q)
    return np.maximum(v - highest, lowest - v)


class Violations:
    """Largest violations of the limits seen, rad and rad/s; states lost from the kernel."""

    def __init__(self, limits):
        self.limits = limits
        self.position = self.speed = -np.inf
        self.lost = 0

    def see(self, low, high, q, v):
        """Look at the lowest and highest position on the way, and at a state."""
        position = np.maximum(high - self.limits.q_max, self.limits.q_min - low)
        self.position = max(self.position, position.max())
        self.speed = max(self.speed, too_fast(self.limits, q, v).max())

    @property
    def worst(self):
        return max(self.position, self.speed)


def states_in_kernel(solver, case, count, rng):
    """Return viable states of one joint, half of them on the kernel's edge or at rest.

    One in ten positions is a limit.
    """
    low, high = position_window(case)
    q = rng.uniform(low, high, count)
    place = rng.integers(0, 20, count)
    q[place == 0], q[place == 1] = low, high
    slowest, fastest = (speed[:, 0] for speed in solver.velocity_range(column(q)))
    v = rng.uniform(slowest, fastest)
    kind = rng.integers(0, 6, count)
    v[kind == 0], v[kind == 1], v[kind == 2] = slowest[kind == 0], fastest[kind == 1], 0.0
    return column(q), column(v)


def states_outside(solver, case, count, rng):
    """Return states beyond the position limits, too fast, or too fast to stop in time.

    They are so far outside that some hundred steps bring them back.
    """
    _, _, v_max, a_min, a_max, dt = case
    low, high = position_window(case)
    span = 300.0 * dt
    reach = min(0.3 * (high - low), 0.5 * min(-a_min, a_max) * span**2)
    excess = min(v_max, min(-a_min, a_max) * span)
    fastest = min(v_max, (high - low) / dt)
    q = column(rng.uniform(low - reach, high + reach, 4 * count))
    v = column(rng.uniform(-fastest - excess, fastest + excess, 4 * count))
    outside = ~solver.bounds(q, v).viable[:, 0]
    assert outside.sum() >= count
    return q[outside][:count], v[outside][:count]


def drive(solver, q, v, steps, rng, shortest=1.0):
    """Let joints that are in the kernel choose among the bounds; return what was violated.

    Args:
        solver: the bounds.
        q, v: states to start from.
        steps: their number.
        rng: random generator.
        shortest: each step ends after a share of the time that the bounds are for, at least this.
    """
    seen = Violations(solver.limits)
    for _ in range(steps):
        lower, upper, viable = solver.bounds(q, v)
        seen.lost += int((~viable).sum())
        a = choose(q, v, lower, upper, solver.limits, rng)
        q, v, low, high = advance(q, v, a, solver.steps * rng.uniform(shortest, 1.0))
        seen.see(low, high, q, v)
    return seen


class Returned(NamedTuple):
    """How motions from outside the kernel went; rad and rad/s."""

    stray: int  # joints that did not get back
    again: float  # largest violation of a limit by a joint that had been back
    position: float  # the furthest that any went beyond where braking at its limit takes it
    speed: float  # the most that any was faster than at the start or than its limit


def bring_back(solver, q, v, most_steps, rng):
    """Let joints that are outside the kernel choose among the bounds until all are in it."""
    limits = solver.limits
    # The way that braking at its limit takes, from each state.
    stop_above = q + np.where(v > 0.0, v * v / (2.0 * -limits.a_min), 0.0)
    stop_below = q - np.where(v < 0.0, v * v / (2.0 * limits.a_max), 0.0)
    stop_above = np.maximum(limits.q_max, stop_above)
    stop_below = np.minimum(limits.q_min, stop_below)
    fastest = np.maximum(limits.v_max, np.abs(v))
    back = np.zeros(q.shape, dtype=bool)
    position = speed = again = -np.inf
    for _ in range(most_steps):
        lower, upper, viable = solver.bounds(q, v)
        back |= viable
        if back.all():
            break
        a = choose(q, v, lower, upper, limits, rng)
        q, v, low, high = advance(q, v, a, solver.steps)
        position = max(position, np.maximum(high - stop_above, stop_below - low).max())
        speed = max(speed, (np.abs(v) - fastest).max())
        outside = np.maximum(high - limits.q_max, limits.q_min - low)
        outside = np.maximum(outside, too_fast(limits, q, v))
        again = max(again, outside.max(where=back, initial=-np.inf))
    return Returned(int((~back).sum()), again, position, speed)
