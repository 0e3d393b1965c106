# SPDX-License-Identifier: Apache-2.0
"""A new robot like real ones: what is assumed of rotors, encoders, delays and motors.

A URDF says nothing of them. ``config/imperfect/`` has those of the shipped arms, with sources.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from decimal import ROUND_DOWN, ROUND_UP
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.new_robot.chain import Chain
from torque_safety_controller.new_robot.estimates import Estimates
from torque_safety_controller.new_robot.files import FILTER, unit_of, yaml_line, yaml_lines
from viability_bounds_pkg.cli.limits_file import rounded
from viability_bounds_pkg.estimate.worst_case import StateSpace

Array = NDArray[np.float64]

ROTOR_SHARE = 200.0
"""Acceleration that the torque limit gives a rotor alone, rad/s^2: 120 and 300 for the wrists of
the shipped Panda and Baxter."""

STEP = 9.6e-5
"""Of the encoders, rad, 16 bits a turn; or m, of slides."""

BANDWIDTH = 100.0
"""Of the motors' torques, Hz."""

LASTING = 20.0
"""Error of accelerations that may be learned, rad/s^2, as in config/imperfect/panda.yaml."""

_STATES = 4000
_SHARE = 0.999  # of them
_SEED = 0


class Errors(NamedTuple):
    """Errors of the motors, shares of the torque limit, and of the connection.

    Attributes:
        constant: error of the torque constant, of the torque.
        friction: Coulomb's.
        ripple: amplitude.
        noise: standard deviation; three of them at most.
        missed: longest row of lost commands, control periods.
        horizon: of the bounds, control periods.
    """

    constant: float
    friction: float
    ripple: float
    noise: float
    missed: int
    horizon: float


ERRORS = (
    Errors(0.02, 0.01, 0.001, 0.0005, 4, 15.0),
    Errors(0.01, 0.005, 0.0005, 0.0003, 4, 15.0),
    Errors(0.005, 0.002, 0.0005, 0.0002, 2, 10.0),
    Errors(0.002, 0.001, 0.0002, 0.0001, 1, 6.0),
)
"""From the largest to the least that are tried: the first that leave the arm enough count."""

QUICKEST = 10.0
"""Acceleration limit for each rad/s of the speed limit, 1/s: top speed in 0.1 s. More would only
make margins larger, as of a slow lift."""

ROOM = 0.5
"""Share of the acceleration limits that the errors of the torques may take."""


_FILE = """\
# SPDX-License-Identifier: Apache-2.0
# A {name} like real robots: parameters that are given after {name}.yaml. A URDF says nothing of
# this: all is assumed, to be replaced by what you know. docs/guides/simulation.md has the models.
# Written by scripts/new_robot.sh.
/**:
  ros__parameters:
    # Of the rotors, assumed: torque_max would accelerate each alone by {rotor_share:g} {rad_s2}.
    rotor_inertia: {rotors}
    # {rad_s2}. As in {name}.yaml, with these rotors.
    acceleration_min: {a_min}
    acceleration_max: {a_max}
{speeds}    # ---- Declared: what the user knows about the robot; docs/theory/bounds.md. ----
    use_estimated_states: true
    # {rad}. Half a step of the encoders below.
    position_error: {half_step}
    delay: 1 # control periods
    missed_deadlines: {missed} # longest row
    motor_bandwidth: {bandwidth} # Hz
    # {rad_s2}. Errors of the torques that last are learned: the arm comes to rest at its goal.
    lasting_disturbance: {lasting}
    # {rad_s2}. What the errors of the torques below make of the accelerations in 999 of 1000
    # random states.
    acceleration_disturbance: {disturbance}

/**/bounds_node:
  ros__parameters:
    # Control periods: rows of missed deadlines, and no chatter at the limits; by gain_limits.
    bounds_dt_factor: {horizon}
    acceleration_drift: {drift} # {rad_s3}, with the rotors

/**/controller_node:
  ros__parameters:
    # Against the errors of the torques below, which torque_reserve leaves to safety_filter.
    integral_action: joints
    torque_reserve: {reserve}
    # What gain_limits permits.
{gains}{filter}
/**/bullet_node:
  ros__parameters:
    # All assumed. Encoders: 16 bits a turn; velocities are their differences.
    encoder_resolution: {step} # {rad}
    velocity_source: encoder
    # A command acts within the next control period.
    state_delay: 0 # control periods
    command_delay: 1 # control periods
    motor_bandwidth: {bandwidth} # Hz
    # What calibration and compensation leave.
    torque_constant_error: {constant}
    friction_coulomb: {friction} # {force}
    torque_ripple: {ripple} # share of torque_max
    current_noise: {noise} # share of torque_max
    missed_probability: 0.02
    missed_in_row: {missed}
    command_timeout: {missed} # control periods; missed_deadlines covers no longer row
"""


def with_rotors(chain: Chain, v_max: Array) -> Chain:
    """Return an arm with assumed rotors, kg m^2, and speed limits, shape (n,), rad/s."""
    model = pin.Model(chain.model)
    model.armature = rounded(chain.tau_max / ROTOR_SHARE, ROUND_UP)
    return replace(chain, model=model, v_max=v_max)


def torque_errors(chain: Chain, errors: Errors) -> Array:
    """Return how far torques may be from those commanded, shape (n,), N m."""
    share = errors.constant + errors.friction + errors.ripple + 3.0 * errors.noise
    return rounded(share * chain.tau_max, ROUND_UP)


def acceleration_errors(chain: Chain, estimates: Estimates, errors: Errors) -> Array:
    """Return what errors of the torques make of accelerations in 999 of 1000 random states.

    Args:
        chain: the arm, with rotors.
        estimates: its limits.
        errors: of its motors.

    Returns:
        Shape (n,), rad/s^2.
    """
    n, tau_max = len(chain.joints), chain.tau_max
    random, data = np.random.default_rng(_SEED), chain.model.createData()
    space = StateSpace.of(chain.model, chain.q_min, chain.q_max, estimates.v_max, tau_max)
    states = zip(*space.states(random.random((_STATES, 2 * n))), strict=True)
    found = np.empty((_STATES, n))
    for row, (q, v) in zip(found, states, strict=True):
        a = random.uniform(estimates.a_min, estimates.a_max)
        tau = np.clip(pin.rnea(chain.model, data, q, v, a), -tau_max, tau_max)
        # Each may act either way.
        constant, friction = random.choice((-1.0, 1.0), (2, n))
        others = errors.ripple * random.uniform(-1.0, 1.0, n) + errors.noise * random.normal(
            size=n
        )
        wrong = errors.constant * constant * tau
        wrong += (errors.friction * friction + others) * tau_max
        row[:] = np.abs(np.linalg.solve(pin.crba(chain.model, data, q), wrong))
    return rounded(np.quantile(found, _SHARE, axis=0), ROUND_UP)


def imperfect_file(
    chain: Chain,
    estimates: Estimates,
    errors: Errors,
    disturbance: Array,
    gains: Mapping[str, float],
) -> str:
    """Return the text of ``config/imperfect/<name>.yaml``.

    Args:
        chain: the arm, with rotors.
        estimates: its limits.
        errors: of its motors and connection.
        disturbance: of `acceleration_errors`.
        gains: that differ from those of the exact robot, and `bounds_dt_factor`.
    """
    one = np.ones(len(chain.joints))
    arrays = {
        "rotors": chain.model.armature,
        "a_min": estimates.a_min,
        "a_max": estimates.a_max,
        "half_step": 0.5 * STEP * one,
        "bandwidth": BANDWIDTH * one,
        "lasting": LASTING * one,
        "disturbance": disturbance,
        "drift": estimates.drift,
        "reserve": torque_errors(chain, errors),
        "step": STEP * one,
        "constant": errors.constant * np.where(np.arange(len(one)) % 2, 1.0, -1.0),
        "friction": rounded(errors.friction * chain.tau_max, ROUND_DOWN),
        "ripple": errors.ripple * one,
        "noise": errors.noise * one,
    }
    slower = f"    velocity_max: {yaml_line(estimates.v_max)} # {unit_of(chain, '/s')}\n"
    return _FILE.format(
        name=chain.name,
        rotor_share=ROTOR_SHARE,
        speeds=slower if estimates.speed_scale < 1.0 else "",
        missed=errors.missed,
        horizon=gains["bounds_dt_factor"],
        gains=yaml_lines({n: value for n, value in gains.items() if n != "bounds_dt_factor"}),
        filter=FILTER if estimates.filtered.any() else "",
        rad=unit_of(chain),
        rad_s2=unit_of(chain, "/s^2"),
        rad_s3=unit_of(chain, "/s^3"),
        force="N m, N of slides" if chain.slides.any() else "N m",
        **{name: yaml_line(values) for name, values in arrays.items()},
    )
