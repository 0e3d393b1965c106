# SPDX-License-Identifier: Apache-2.0
"""What is assumed of the hardware of a new robot, to try it as real ones are (not ideal).

A URDF says nothing of rotors, encoders, delays and motors. What stands here are assumptions, all
to be replaced by what is known; config/imperfect/ has those of the shipped arms, with sources.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from decimal import ROUND_UP

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.new_robot.chain import Chain
from torque_safety_controller.new_robot.estimates import Estimates
from viability_bounds_pkg.cli.limits_file import rounded

Array = NDArray[np.float64]

ROTOR_SHARE = 200.0
"""Acceleration that the torque limit gives a rotor alone, rad/s^2: 120 and 300 for the wrists of
the shipped Panda and Baxter."""

ENCODER_STEPS = 65536
"""Of a turn: 16 bits."""

BANDWIDTH = 100.0
"""Of the motors' torque, Hz."""

_STATES = 4000
_QUANTILE = 0.999
_SEED = 0


@dataclass(frozen=True)
class Grade:
    """How good motors and connection are.

    Attributes:
        constant_error: of the torque constant, share of the torque.
        ripple: share of torque_max.
        noise: share of torque_max, standard deviation.
        missed: longest row of lost commands, control periods.
        horizon: of the bounds, control periods.
    """

    constant_error: float
    ripple: float
    noise: float
    missed: int
    horizon: float


GRADES = (
    Grade(0.02, 0.001, 0.0005, 4, 15.0),
    Grade(0.01, 0.0005, 0.0003, 4, 15.0),
    Grade(0.005, 0.0005, 0.0002, 2, 10.0),
    Grade(0.002, 0.0002, 0.0001, 1, 6.0),
)
"""From the most to the least that is tried: the first that leaves bounds counts."""


def with_rotors(chain: Chain) -> Chain:
    """Return the arm with assumed rotors."""
    model = pin.Model(chain.model)
    model.armature = rotor_inertia(chain)
    return replace(chain, model=model)


def rotor_inertia(chain: Chain) -> Array:
    """Return the inertia of rotors as seen from the joints, shape (n,), kg m^2."""
    return rounded(chain.tau_max / ROTOR_SHARE, ROUND_UP)


def torque_errors(chain: Chain, grade: Grade) -> Array:
    """Return the largest errors of the motors' torques, shape (n,), N m."""
    share = grade.constant_error + grade.ripple + 3.0 * grade.noise
    return np.asarray(share * chain.tau_max)


def acceleration_errors(chain: Chain, estimates: Estimates, grade: Grade) -> Array:
    """Return what errors of the torques make of accelerations in nearly all states.

    Args:
        chain: the arm, with rotors.
        estimates: its limits.
        grade: of its motors.

    Returns:
        The 99.9% quantile over random states within the limits, shape (n,), rad/s^2.
    """
    n, random = len(chain.joints), np.random.default_rng(_SEED)
    low = np.where(chain.continuous, -np.pi, chain.q_min)
    high = np.where(chain.continuous, np.pi, chain.q_max)
    data = chain.model.createData()
    errors = np.empty((_STATES, n))
    for row in errors:
        q, v = random.uniform(low, high), random.uniform(-1.0, 1.0, n) * estimates.v_max
        a = random.uniform(estimates.a_min, estimates.a_max)
        tau = np.clip(pin.rnea(chain.model, data, q, v, a), -chain.tau_max, chain.tau_max)
        spread = grade.ripple * random.uniform(-1.0, 1.0, n) + grade.noise * random.normal(size=n)
        # Any motor may be too strong or too weak.
        constant = grade.constant_error * random.choice((-1.0, 1.0), n)
        wrong = constant * tau + spread * chain.tau_max
        row[:] = np.abs(np.linalg.solve(pin.crba(chain.model, data, q), wrong))
    return rounded(np.quantile(errors, _QUANTILE, axis=0), ROUND_UP)
