# SPDX-License-Identifier: Apache-2.0
"""Acceleration limits that the torque limits can always provide, or nearly so.

Section IV of [DelPrete2018] bounds accelerations by worst-case constants, estimated offline from
the torque limits (Algorithm 4). This module runs the search, applies the user's overrides and
caps, and says what to do where torque leaves no interval.

Using smaller limits than the ones found is always safe. The viability kernel
``v <= sqrt(2 (-a_min) (q_max - q))`` shrinks with ``-a_min``: each of its states can stop in time
with the smaller deceleration, and a torque that gives the larger one gives the smaller one too.
What is lost is speed near the position limits. `cap` does that, and is wise for light joints
such as wrists, whose torque would allow hundreds of rad/s^2 that neither the gears nor the
control period are made for: the drift of the acceleration under a held torque grows with it (see
`estimate.drift`).

Using larger ones (`overrides`) gives the guarantee up in the states where torque does not suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from viability_bounds_pkg.estimate.torque_terms import Bodies
from viability_bounds_pkg.estimate.worst_case import (
    Array,
    LimitEstimateError,
    StateSpace,
    WorstCases,
    acceleration_room,
    search_by_sampling,
    search_refined,
)

SEARCHES: dict[str, Callable[..., WorstCases]] = {
    "sampling": search_by_sampling,
    "refined": search_refined,
}
DEFAULT_SAMPLES = {"sampling": 1_000_000, "refined": 10_000}

USEFUL_ACCELERATION = 1.0
"""What a suggested velocity scale leaves each joint at least, either way, rad/s^2."""

SCALE_EVALUATIONS = 10_000
"""Evaluations of each search for a velocity scale."""


@dataclass(frozen=True)
class AccelerationLimits:
    """Estimated acceleration limits and the worst cases they rest on.

    Attributes:
        names: joints.
        a_min: lower limits, caps and overrides applied, shape (n,), rad/s^2, negative.
        a_max: upper limits, shape (n,), rad/s^2, positive.
        worst: the tightest limits that the torque limits leave, and their states.
        overridden: joints whose limits were set by hand.
    """

    names: tuple[str, ...]
    a_min: Array
    a_max: Array
    worst: WorstCases
    overridden: frozenset[str]


class EmptyIntervalError(LimitEstimateError):
    """The torque limits leave a joint no acceleration interval in some state.

    Attributes:
        joint: its name.
        scale: of the velocity limits with which every such joint has an interval; 0 where the
            weight alone takes too much torque.
    """

    def __init__(self, message: str, joint: str, scale: float) -> None:
        self.joint, self.scale = joint, scale
        super().__init__(message)


def estimate_acceleration_limits(
    model: pin.Model,
    q_min: ArrayLike,
    q_max: ArrayLike,
    v_max: ArrayLike,
    tau_max: ArrayLike,
    samples: int | None = None,
    seed: int = 0,
    *,
    method: str = "sampling",
    overrides: Mapping[str, tuple[float, float]] | None = None,
    cap: float = np.inf,
) -> AccelerationLimits:
    """Return worst-case acceleration limits: Algorithm 4 of [DelPrete2018].

    For each joint, the others not accelerating, the least of ``(tau_max - h) / M[j, j]`` and the
    greatest of ``(-tau_max - h) / M[j, j]`` over the states searched. Both methods find states
    worse than any they saw before, never the certain worst: the limits err to the optimistic
    side. Uniform sampling does so by much, because the worst states are corners of a space of
    2 n dimensions that it hardly ever comes near.

    Args:
        model: the robot, each joint with one degree of freedom, n of them.
        q_min: lower position limits, shape (n,), rad; where infinite, the angle is searched from
            -pi to pi.
        q_max: upper position limits, shape (n,), rad.
        v_max: velocity limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
        samples: evaluations of the dynamics (the paper's N); 1e6 for "sampling" and 1e4 for
            "refined" unless given.
        seed: of the random generator; the same seed gives the same limits.
        method: "sampling" as in the paper, or "refined" (see `search_refined`).
        overrides: limits (a_min, a_max) of joints to use instead of what is found, rad/s^2.
        cap: the greatest magnitude of the limits of the other joints, rad/s^2.

    Raises:
        EmptyIntervalError: a joint without override is left no interval.
        LimitEstimateError: bad arguments, or a joint that moves no inertia.
    """
    if method not in SEARCHES:
        raise LimitEstimateError(f"method must be one of {', '.join(SEARCHES)}, is {method!r}")
    space = StateSpace.of(model, q_min, q_max, v_max, tau_max)
    count = DEFAULT_SAMPLES[method] if samples is None else samples
    worst = SEARCHES[method](model, space, count, seed)
    return limits_from_worst_cases(model, space, worst, overrides, cap)


def limits_from_worst_cases(
    model: pin.Model,
    space: StateSpace,
    worst: WorstCases,
    overrides: Mapping[str, tuple[float, float]] | None = None,
    cap: float = np.inf,
) -> AccelerationLimits:
    """Apply overrides and caps to the limits that a search of `space` found.

    Arguments and errors as of `estimate_acceleration_limits`.
    """
    overrides = dict(overrides or {})
    names = tuple(model.names)[1:]
    for joint, (low, high) in overrides.items():
        if joint not in names:
            known = ", ".join(names)
            raise LimitEstimateError(f"override of unknown joint {joint!r}; there are: {known}")
        if not (np.isfinite([low, high]).all() and low < 0 < high):
            raise LimitEstimateError(
                f"joint {joint}: override must be finite with min < 0 < max, "
                f"is ({low:g}, {high:g})"
            )
    if not cap > 0.0:
        raise LimitEstimateError(f"cap must be positive, is {cap:g}")
    for j, joint in enumerate(names):
        if joint not in overrides and not worst.a_min[j] < 0 < worst.a_max[j]:
            raise _empty_interval(model, space, worst, j, overrides)
    a_min, a_max = np.maximum(worst.a_min, -cap), np.minimum(worst.a_max, cap)
    for joint, (low, high) in overrides.items():
        a_min[names.index(joint)], a_max[names.index(joint)] = low, high
    return AccelerationLimits(names, a_min, a_max, worst, frozenset(overrides))


_PER = "/s", "/s^2"
_FORCE = {"rad": "N m", "m": "N"}
"""Unit of a joint's torque, or force, by that of its position."""


def _empty_interval(
    model: pin.Model, space: StateSpace, worst: WorstCases, j: int, overrides: Container[str]
) -> EmptyIntervalError:
    """Return the error for joint j: the state that leaves it no interval, and what would help."""
    joint = model.names[1 + j]
    side, limit, value = 1, "a_min", worst.a_min[j]
    if worst.a_max[j] <= 0:
        side, limit, value = 0, "a_max", worst.a_max[j]
    found = largest_velocity_scale(model, space, ignore=overrides)
    units = [_unit(model, k) for k in range(model.nv)]
    speed, acceleration = (" or ".join(dict.fromkeys(u + per for u in units)) for per in _PER)
    remedy = (
        f"velocity limits scaled by {found.scale:.3f}, to {_text(found.scale * space.v_max)} "
        f"{speed}, leave every joint {USEFUL_ACCELERATION:g} {acceleration} either way; else"
    )
    if found.scale == 0.0:
        gravity = pin.computeGeneralizedGravity(model, model.createData(), found.q)
        k = list(model.names).index(found.joint) - 1
        weight = f"{abs(gravity[k]):.3g} {_FORCE[units[k]]}"
        remedy = (
            f"lower velocities do not help: joint {found.joint} takes {weight} just to hold "
            f"still at q = {_text(found.q)};"
        )
    unit = units[j]
    message = (
        f"joint {joint}: its torque of {space.tau_max[j]:.4g} {_FORCE[unit]} leaves no "
        f"acceleration interval: {limit} = {value:.3g} {unit}/s^2 at "
        f"q = {_text(worst.q[side, j])}, v = {_text(worst.v[side, j])}; {remedy} narrow the "
        f"position limits or override the joint's acceleration limits (--override "
        f"{joint}=MIN,MAX), or take those of most states, with the controller's safety_filter "
        "(--share)"
    )
    return EmptyIntervalError(message, joint, found.scale)


def _unit(model: pin.Model, joint: int) -> str:
    slides = model.joints[1 + joint].shortname().startswith("JointModelP")
    return "m" if slides else "rad"


def _text(values: Array) -> str:
    return "[" + ", ".join(f"{value:.3g}" for value in values) + "]"


class VelocityScale(NamedTuple):
    """The largest common factor of the velocity limits that leaves every joint an interval.

    Attributes:
        scale: in [0, 1]; 0 when gravity alone takes too much torque.
        joint: the joint that limits it; empty when the scale is 1, and the rest is NaN.
        q: the state that limits it, shape (n,), rad.
        v: its velocity, scaled, shape (n,), rad/s.
    """

    scale: float
    joint: str
    q: Array
    v: Array


def largest_velocity_scale(
    model: pin.Model,
    space: StateSpace,
    required: float = USEFUL_ACCELERATION,
    *,
    ignore: Container[str] = (),
) -> VelocityScale:
    """Return the largest factor of `space.v_max` that leaves every joint `required` either way.

    With h = g(q) + c(q, v), where c grows with the square of the speeds, each state in which a
    joint can accelerate by r, and by r_0 at rest, allows to scale speeds by
    ``sqrt((r_0 - required) / (r_0 - r))``. A refined search finds the worst states; it is repeated
    at the scale that they allow, until it finds none that allows less.

    Args:
        model: the robot.
        space: limits; velocities of the result are multiples of its `v_max`.
        required: acceleration that each joint must be able to reach up and down, at least 0,
            rad/s^2.
        ignore: names of joints that need not (those overridden).
    """
    n, names = space.n, list(model.names)[1:]
    counted = np.array([name not in ignore for name in names])
    nothing = np.full(n, np.nan)
    found = VelocityScale(1.0, "", nothing, nothing)
    for attempt in range(20):
        scaled = StateSpace(space.q_min, space.q_max, found.scale * space.v_max, space.tau_max)
        worst = search_refined(model, scaled, SCALE_EVALUATIONS, attempt)
        lacking = counted & (worst.room < required)
        if found.scale == 0.0 or not lacking.any():
            break
        q = worst.q.reshape(-1, n)
        at_rest = acceleration_room(model, Bodies.of(model), space, q, np.zeros_like(q))
        at_rest = np.einsum("sjsj->sj", at_rest.reshape(2, n, 2, n))  # of the joint and the side
        spare = np.maximum(at_rest - required, 0.0)
        square = np.divide(
            spare, spare + required - worst.room, out=np.ones((2, n)), where=lacking
        )
        # Where several states allow nothing, name the one whose weight is the most beyond.
        side, j = np.unravel_index(
            np.argmin(np.where(square == square.min(), at_rest, np.inf)), (2, n)
        )
        # Slightly below, or the same states would be found once more.
        factor = float(np.sqrt(square[side, j]) * (1.0 - 1e-4))
        found = VelocityScale(
            factor * found.scale, names[j], worst.q[side, j], factor * worst.v[side, j]
        )
    return found


def unavailable_share(
    model: pin.Model,
    space: StateSpace,
    limits: AccelerationLimits,
) -> Array:
    """Return the share of 20,000 random states in which torque does not allow a joint's limits.

    Shape (n,): nearly zero for limits that were found, large for an override that gravity alone
    forbids. `space` is the box of states, with the torque available.
    """
    wanted = np.stack([limits.a_max, -limits.a_min])
    share: Array = np.mean(np.any(_random_room(model, space) < wanted, axis=1), axis=0)
    return share


def limits_in_share(model: pin.Model, space: StateSpace, share: float) -> Array:
    """Return accelerations that torque allows, either way, in a share of random states.

    For joints that have no interval in all states: the safety filter needs no more than that.

    `space` is the box of states, with the torque available; `share` is in (0, 1). Shape (n,),
    rad/s^2; not positive where there are none.
    """
    either = _random_room(model, space).min(axis=1)
    limits: Array = np.quantile(either, 1.0 - share, axis=0, method="lower")
    return limits


def _random_room(model: pin.Model, space: StateSpace) -> Array:
    """Return how far accelerations can go up and down in random states, shape (k, 2, n)."""
    q, v = space.states(np.random.default_rng(0).random((20_000, 2 * space.n)))
    return acceleration_room(model, Bodies.of(model), space, q, v)
