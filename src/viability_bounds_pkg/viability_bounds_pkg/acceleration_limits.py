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
control period are made for: the zero-order hold error of the acceleration grows with it (see
`discretisation_margin`).

Using larger ones (`overrides`) gives the guarantee up in the states where torque does not suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from viability_bounds_pkg.estimation.state_space import Array, LimitEstimateError, StateSpace
from viability_bounds_pkg.estimation.velocity_scale import (
    USEFUL_ACCELERATION,
    VelocityScale,
    largest_velocity_scale,
)
from viability_bounds_pkg.estimation.worst_case_search import (
    WorstCases,
    acceleration_room,
    search_by_sampling,
    search_refined,
)

SEARCHES: dict[str, Callable[[pin.Model, StateSpace, int, int], Iterator[WorstCases]]] = {
    "sampling": search_by_sampling,
    "refined": search_refined,
}
DEFAULT_SAMPLES = {"sampling": 1_000_000, "refined": 10_000}


@dataclass(frozen=True)
class AccelerationLimits:
    """Estimated acceleration limits and the worst cases they rest on.

    Attributes:
        names: joints.
        a_min: lower limits, caps and overrides applied, shape (n,), rad/s^2, negative.
        a_max: upper limits, shape (n,), rad/s^2, positive.
        worst: the tightest limits that the torque limits leave, their states and history.
        overridden: joints whose limits were set by hand.
    """

    names: tuple[str, ...]
    a_min: Array
    a_max: Array
    worst: WorstCases
    overridden: frozenset[str]


class EmptyIntervalError(LimitEstimateError):
    """The torque limits leave a joint no acceleration interval in some state.

    Args:
        joint: index of the joint.
        model: the robot.
        space: what was searched.
        worst: the outcome of the search.
        suggestion: the velocity scale that gives every such joint an interval, or the posture
            whose weight alone is too much.

    Attributes:
        joint: its name.
        a_min: tightest lower limit found, rad/s^2; not negative, or `a_max` is not positive.
        a_max: tightest upper limit found, rad/s^2.
        q: the state that empties the interval, shape (n,), rad.
        v: its velocity, shape (n,), rad/s.
        torque_max: the torque available, N m.
        suggestion: as given.
        velocity_max: the velocity limits so scaled, shape (n,), rad/s.
    """

    def __init__(
        self,
        joint: int,
        model: pin.Model,
        space: StateSpace,
        worst: WorstCases,
        suggestion: VelocityScale,
    ) -> None:
        side = "a_max" if worst.a_max[joint] <= 0 else "a_min"
        self.joint = model.names[1 + joint]
        self.a_min, self.a_max = float(worst.a_min[joint]), float(worst.a_max[joint])
        self.q: Array = getattr(worst, f"q_at_{side}")[joint]
        self.v: Array = getattr(worst, f"v_at_{side}")[joint]
        self.torque_max = float(space.tau_max[joint])
        self.suggestion = suggestion
        self.velocity_max = suggestion.scale * space.v_max
        if suggestion.scale == 0.0:
            remedy = (
                f"lower velocities do not help: joint {suggestion.joint} takes "
                f"{abs(suggestion.static_torque):.3g} N m just to hold still at "
                f"q = {_text(suggestion.q)}, which leaves less than {USEFUL_ACCELERATION:g} "
                "rad/s^2; narrow the position limits or override "
            )
        else:
            remedy = (
                f"velocity limits scaled by {suggestion.scale:.3f}, to "
                f"{_text(self.velocity_max)} rad/s, leave every joint "
                f"{USEFUL_ACCELERATION:g} rad/s^2 either way; else narrow the position limits or "
                "override "
            )
        super().__init__(
            f"joint {self.joint}: its torque of {self.torque_max:.4g} N m leaves no acceleration "
            f"interval: {side} = {getattr(self, side):.3g} rad/s^2 at "
            f"q = {_text(self.q)}, v = {_text(self.v)}; {remedy}the joint's acceleration limits "
            f"(--override {self.joint}=MIN,MAX), or take those of most states, with the "
            "controller's safety_filter (--share)"
        )


def _text(values: Array) -> str:
    return "[" + ", ".join(f"{value:.3g}" for value in values) + "]"


def available_torque(tau_max: ArrayLike, torque_reserve: ArrayLike) -> Array:
    """Return `tau_max` less the torque kept back, shape (n,), N m.

    Raises:
        LimitEstimateError: the reserve is negative, or leaves nothing.
    """
    tau_max = np.asarray(tau_max, dtype=np.float64)
    reserve = np.broadcast_to(np.asarray(torque_reserve, dtype=float), tau_max.shape)
    if not np.all((reserve >= 0) & (reserve < tau_max)):
        raise LimitEstimateError("torque_reserve must be at least zero and below tau_max")
    left: Array = tau_max - reserve
    return left


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
    torque_reserve: ArrayLike = 0.0,
    overrides: Mapping[str, tuple[float, float]] | None = None,
    cap: ArrayLike | None = None,
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
        torque_reserve: torque kept back for others, such as an integral term, scalar or shape
            (n,), N m.
        overrides: limits (a_min, a_max) of joints to use instead of what is found, rad/s^2.
        cap: the greatest magnitude of the limits of the other joints, scalar or shape (n,),
            rad/s^2; infinite for none.

    Raises:
        EmptyIntervalError: a joint without override is left no interval.
        LimitEstimateError: bad arguments, or a joint that moves no inertia.
    """
    if method not in SEARCHES:
        raise LimitEstimateError(f"method must be one of {', '.join(SEARCHES)}, is {method!r}")
    if samples is None:
        samples = DEFAULT_SAMPLES[method]
    space = StateSpace.of(model, q_min, q_max, v_max, available_torque(tau_max, torque_reserve))
    check_adjustments(model, overrides, cap)
    *_, worst = SEARCHES[method](model, space, samples, seed)
    return limits_from_worst_cases(model, space, worst, overrides, cap)


def check_adjustments(
    model: pin.Model,
    overrides: Mapping[str, tuple[float, float]] | None,
    cap: ArrayLike | None,
) -> None:
    """Raise `LimitEstimateError` unless `overrides` and `cap` make sense for `model`."""
    names = list(model.names)[1:]
    for joint, (low, high) in (overrides or {}).items():
        if joint not in names:
            raise LimitEstimateError(
                f"override of unknown joint {joint!r}; there are: {', '.join(names)}"
            )
        if not (np.isfinite([low, high]).all() and low < 0 < high):
            raise LimitEstimateError(
                f"joint {joint}: override must be finite with min < 0 < max, "
                f"is ({low:g}, {high:g}) rad/s^2"
            )
    if cap is not None:
        values = np.asarray(cap, dtype=float)
        if values.shape not in ((), (len(names),)) or not np.all(values > 0):
            raise LimitEstimateError(f"cap must be positive, one value or {len(names)}")


def limits_from_worst_cases(
    model: pin.Model,
    space: StateSpace,
    worst: WorstCases,
    overrides: Mapping[str, tuple[float, float]] | None = None,
    cap: ArrayLike | None = None,
) -> AccelerationLimits:
    """Apply overrides and caps to the limits that a search of `space` found.

    Arguments and errors as of `estimate_acceleration_limits`.
    """
    check_adjustments(model, overrides, cap)
    overrides = dict(overrides or {})
    names = tuple(model.names)[1:]
    for j, joint in enumerate(names):
        if joint in overrides or worst.a_min[j] < 0 < worst.a_max[j]:
            continue
        suggestion = largest_velocity_scale(model, space, ignore=overrides)
        raise EmptyIntervalError(j, model, space, worst, suggestion)
    bound = np.broadcast_to(np.inf if cap is None else np.asarray(cap, dtype=float), len(names))
    a_min, a_max = np.maximum(worst.a_min, -bound), np.minimum(worst.a_max, bound)
    for joint, (low, high) in overrides.items():
        a_min[names.index(joint)], a_max[names.index(joint)] = low, high
    return AccelerationLimits(names, a_min, a_max, worst, frozenset(overrides))


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
    return acceleration_room(model, model.createData(), space, q, v)
