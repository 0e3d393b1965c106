# SPDX-License-Identifier: Apache-2.0
"""Largest velocity scale at which torque leaves every joint an acceleration interval."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from viability_bounds_pkg.estimation.state_space import Array, LimitEstimateError, StateSpace
from viability_bounds_pkg.estimation.worst_case_search import search_refined, torque_terms

USEFUL_ACCELERATION = 1.0
"""What a suggested velocity scale leaves each joint at least, either way, rad/s^2."""

SAMPLES = 10_000
"""Random states to begin with, and evaluations of each refined search."""


@dataclass(frozen=True)
class VelocityScale:
    """The largest common factor of the velocity limits that leaves every joint an interval.

    Attributes:
        scale: in [0, 1]; 0 when gravity alone takes too much torque.
        joint: the joint that limits it; None when the scale is 1, and the rest is NaN.
        q: the state that limits it, shape (n,), rad.
        v: its velocity, scaled, shape (n,), rad/s.
        static_torque: the torque of that joint that holds the arm at rest in `q`, N m.
    """

    scale: float
    joint: str | None
    q: Array
    v: Array
    static_torque: float


def largest_velocity_scale(
    model: pin.Model,
    space: StateSpace,
    required: float = USEFUL_ACCELERATION,
    *,
    ignore: Container[str] = (),
) -> VelocityScale:
    """Return the largest factor of `space.v_max` that leaves every joint `required` either way.

    No bisection is needed: at scale s, ``h = g(q) + s^2 c(q, v)``, so that each state allows an
    explicit range of s^2. The least over random states is refined by exchange: a refined search
    at that scale adds the worst states it finds, until it finds none that allows less.

    Args:
        model: the robot.
        space: limits; velocities of the result are multiples of its `v_max`.
        required: acceleration that each joint must be able to reach up and down, rad/s^2.
        ignore: names of joints that need not (those overridden).

    Raises:
        LimitEstimateError: `required` is negative.
    """
    if not required >= 0:
        raise LimitEstimateError(f"required must be at least zero, is {required}")
    names = list(model.names)[1:]
    counted = np.array([name not in ignore for name in names])
    q, v = space.states(np.random.default_rng(0).random((SAMPLES, 2 * space.n)))
    found = _unlimited(space.n)
    for attempt in range(20):
        found = min(
            found, _scale_allowed(model, space, q, v, required, counted), key=lambda f: f.scale
        )
        if found.scale == 0.0:
            break
        # Slightly below, or the states already known would be found once more.
        scale = found.scale * (1.0 - 1e-4 if attempt else 1.0)
        scaled = StateSpace(space.q_min, space.q_max, scale * space.v_max, space.tau_max)
        *_, worst = search_refined(model, scaled, SAMPLES, attempt)
        short = np.concatenate([worst.a_max[counted], -worst.a_min[counted]]) < required
        if not short.any():
            return VelocityScale(scale, found.joint, found.q, found.v, found.static_torque)
        q = np.concatenate([worst.q_at_a_max[counted], worst.q_at_a_min[counted]])
        v = np.concatenate([worst.v_at_a_max[counted], worst.v_at_a_min[counted]]) / scale
    return found


def _unlimited(n: int) -> VelocityScale:
    nothing = np.full(n, np.nan)
    return VelocityScale(1.0, None, nothing, nothing, np.nan)


def _scale_allowed(
    model: pin.Model, space: StateSpace, q: Array, v: Array, required: float, counted: Array
) -> VelocityScale:
    """Return the least scale that one of the states, each of shape (batch, n), allows."""
    data = model.createData()
    h, inertia = torque_terms(model, data, q, v)
    gravity, _ = torque_terms(model, data, q, np.zeros_like(v))
    sign = np.array([1.0, -1.0])[:, None, None]
    # Up and down: tau_max - sign (gravity + s^2 (h - gravity)) >= M required.
    slack = space.tau_max - sign * gravity - inertia * required
    growth = sign * (h - gravity)
    with np.errstate(divide="ignore", invalid="ignore"):
        square = np.where(slack < 0, 0.0, np.where(growth > 0, slack / growth, np.inf))
    square = np.where(counted, square, np.inf)
    least = square.min()
    if not least < 1.0:
        return _unlimited(space.n)
    # Where several states allow nothing, name the one whose weight is the most beyond.
    rank = np.where(square == least, slack / inertia, np.inf)
    _, row, j = np.unravel_index(np.argmin(rank), rank.shape)
    scale = float(np.sqrt(least))
    return VelocityScale(
        scale, list(model.names)[1 + j], q[row], scale * v[row], float(gravity[row, j])
    )
