# SPDX-License-Identifier: Apache-2.0
"""Speed and acceleration limits of a new robot that its torque limits allow.

The limits must be available in every state within position and speed limits. Where they are not at
the speeds of the URDF, either the speeds are lowered, or, where a motor is too weak whatever the
speed, the safety filter is chosen, which needs them in most states only
(docs/theory/whole_arm.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import ROUND_DOWN, ROUND_UP

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.new_robot.chain import Chain, NewRobotError
from viability_bounds_pkg.acceleration_limits import (
    largest_velocity_scale,
    limits_from_worst_cases,
    limits_in_share,
    unavailable_share,
)
from viability_bounds_pkg.cli.limits_file import rounded
from viability_bounds_pkg.estimate.drift import acceleration_drift
from viability_bounds_pkg.estimate.worst_case import StateSpace, WorstCases, search_refined

Array = NDArray[np.float64]

CAP = 15.0
"""Largest acceleration limit, rad/s^2, as in the shipped files: more is of little use."""

RESERVE = 0.03
"""Share of the torque that is kept back: the search may miss the worst state by little."""

USEFUL = 3.0
"""Acceleration limit that each joint should have, rad/s^2, as the weakest of the shipped Panda."""

LEAST = 1.0
"""What is put up with where USEFUL cannot be had by lowering speeds, rad/s^2."""

SLOWEST, FAST = 0.5, 1.0
"""Speeds are lowered to this share of the URDF's at most, or while all are above so many rad/s, as
those of unloaded motors are in some URDFs. Below, the safety filter is chosen."""

SHARE = 0.8
"""Share of random states in which limits are available of joints that have none in all states."""

DRIFT_RESERVE = 1.1
"""On the largest drift found, which a search finds from below."""

RATES = (500.0, 1000.0)
"""Control rates that are tried, Hz: the first with which a held torque is precise enough."""

DRIFT_SHARE = 0.2
"""Share of an acceleration limit that the margin for the held torque may take."""

SLOWER = 0.75
"""Factor by which speeds are lowered as long as the drift is too large for the highest rate."""

SLOWEST_FOR_DRIFT = 0.1
"""Share of the URDF's speeds to which they are lowered for this at most, or to `FAST`."""

SEARCH = 10_000  # evaluations
_QUICK = {"samples": 2000, "starts": 4, "rounds": 4}  # of the drift


class _DriftError(NewRobotError):
    """The drift is too large for a control rate."""


@dataclass(frozen=True, eq=False)
class Estimates:
    """Limits of n joints, arrays of shape (n,).

    Attributes:
        v_max: speed limits, rad/s.
        speed_scale: share of the URDF's speeds that they are.
        a_min: lower acceleration limits, rad/s^2.
        a_max: upper ones.
        worst_min: what torque leaves in the worst states found, before the cap.
        worst_max: the same upwards.
        filtered: whether a joint has limits in a share of the states only: the safety filter.
        unavailable: share of random states in which torque does not give the limits.
        rate_hz: control rate.
        drift: largest jerk under held torque at this rate, rad/s^3, with a reserve.
        why: of speeds and filter, sentences for the reader.
    """

    v_max: Array
    speed_scale: float
    a_min: Array
    a_max: Array
    worst_min: Array
    worst_max: Array
    filtered: NDArray[np.bool_]
    unavailable: Array
    rate_hz: float
    drift: Array
    why: str


def estimate(chain: Chain, rate_hz: float | None = None) -> Estimates:
    """Return speed limits, acceleration limits and drift of an arm.

    Args:
        chain: the arm.
        rate_hz: control rate, Hz; None to choose one.

    Raises:
        NewRobotError: a joint is too weak for any limits, or the drift too large for the rate.
    """
    model = chain.model
    space = _space(chain, chain.v_max)
    worst = search_refined(model, space, SEARCH, 0)
    of_whom = "those given" if chain.slowed else "the URDF's"
    scale, reasons, most = 1.0, [], ""
    filtered = np.zeros(len(chain.joints), dtype=bool)
    for required in (USEFUL, LEAST):
        if _room(worst).min() >= required:
            break
        found = largest_velocity_scale(model, space, required)
        if found.scale >= SLOWEST or found.scale * chain.v_max.min() >= FAST:
            scale = float(np.floor(100.0 * found.scale) / 100.0)
            slowest = chain.joints.index(found.joint)
            reasons = [
                f"at higher speeds {found.joint} cannot always accelerate by {required:g} "
                f"{chain.units(slowest)[0]}/s^2 either way"
            ]
            space = _space(chain, rounded(scale * chain.v_max, ROUND_DOWN))
            worst = search_refined(model, space, SEARCH, 0)
            break
    else:
        filtered = _room(worst) < LEAST
    overrides: dict[str, tuple[float, float]] = {}
    if filtered.any():
        overrides, most = _in_most_states(chain, space, filtered)
    while True:
        limits = limits_from_worst_cases(model, space, worst, overrides, CAP)
        a_min, a_max = rounded(limits.a_min, ROUND_DOWN), rounded(limits.a_max, ROUND_DOWN)
        try:
            rate, drift = _drift(chain, space, a_min, a_max, rate_hz)
            break
        except _DriftError:
            # It grows with the square of the speeds.
            scale = float(f"{SLOWER * scale:.2g}")
            if scale < SLOWEST_FOR_DRIFT and scale * chain.v_max.min() < FAST:
                raise
            drifts = "at higher speeds accelerations drift too much for this rate"
            reasons = [*(each for each in reasons if each != drifts), drifts]
            space = _space(chain, rounded(scale * chain.v_max, ROUND_DOWN))
            worst = search_refined(model, space, SEARCH, 0)
    why = most or (
        f"Those {'given' if chain.slowed else 'of the URDF'}: the torque limits leave "
        "accelerations at these speeds."
    )
    if scale < 1.0:
        why = f"{scale:g} of {of_whom}: {'; '.join(reasons)}. {most}".rstrip()
    return Estimates(
        v_max=space.v_max,
        speed_scale=scale,
        a_min=a_min,
        a_max=a_max,
        worst_min=worst.a_min,
        worst_max=worst.a_max,
        filtered=filtered,
        unavailable=unavailable_share(model, space, limits),
        rate_hz=rate,
        drift=drift,
        why=why,
    )


def _space(chain: Chain, v_max: Array) -> StateSpace:
    torque = (1.0 - RESERVE) * chain.tau_max
    return StateSpace.of(chain.model, chain.q_min, chain.q_max, v_max, torque)


def _room(worst: WorstCases) -> Array:
    room: Array = np.minimum(-worst.a_min, worst.a_max)
    return room


def _in_most_states(
    chain: Chain, space: StateSpace, filtered: NDArray[np.bool_]
) -> tuple[dict[str, tuple[float, float]], str]:
    """Return limits of the joints without any in all states, and why they are needed."""
    usual = limits_in_share(chain.model, space, SHARE)
    names = [name for name, each in zip(chain.joints, filtered, strict=True) if each]
    overrides, weak = {}, []
    for name in names:
        j = chain.joints.index(name)
        unit, force = chain.units(j)
        if usual[j] < 0.5 * LEAST:
            weak.append(
                f"joint '{name}': its effort limit of {chain.tau_max[j]:g} {force} does not "
                f"leave {0.5 * LEAST:g} {unit}/s^2 even in {SHARE:.0%} of its states; is "
                "that what the motor can do? Correct the URDF, narrow its position limits there, "
                "or lower its velocity limit"
            )
        value = float(min(usual[j], CAP))
        overrides[name] = (-value, value)
    if weak:
        raise NewRobotError("\n".join(weak))
    why = (
        f"{', '.join(names)}: torque leaves no acceleration limits in all states, so they are "
        f"those of {SHARE:.0%} of random states, and safety_filter holds the arm as a whole."
    )
    return overrides, why


def _drift(
    chain: Chain, space: StateSpace, a_min: Array, a_max: Array, rate_hz: float | None
) -> tuple[float, Array]:
    """Return the control rate and the largest jerk under held torque at that rate."""
    braking = np.minimum(-a_min, a_max)
    rates = RATES if rate_hz is None else (rate_hz,)
    for effort in (_QUICK, {}):  # a quick search that finds too much spares the thorough one
        found = acceleration_drift(chain.model, space, a_min, a_max, **effort)
        drift = rounded(DRIFT_RESERVE * found, ROUND_UP)
        least = drift / 18.0 / braking / DRIFT_SHARE  # rate, Hz
        if (least > rates[-1]).any():
            break
    else:
        return next(rate for rate in rates if (least <= rate).all()), drift
    worst = int(np.argmax(least))
    raise _DriftError(
        f"joint '{chain.joints[worst]}': its acceleration drifts by {drift[worst]:.3g} "
        f"{chain.units(worst)[0]}/s^3 under a held torque, which at {rates[-1]:g} Hz costs "
        f"more than {DRIFT_SHARE:.0%} of its acceleration limit; a higher --rate, or a lower "
        "velocity limit in the URDF"
    )
