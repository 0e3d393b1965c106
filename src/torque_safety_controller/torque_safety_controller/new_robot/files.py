# SPDX-License-Identifier: Apache-2.0
"""The files of a new robot, with a comment to each number that says where it comes from."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from decimal import ROUND_DOWN, ROUND_UP
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from torque_safety_controller.new_robot.chain import Chain
from torque_safety_controller.new_robot.estimates import CAP, RESERVE, SHARE, Estimates
from torque_safety_controller.new_robot.hardware import (
    BANDWIDTH,
    ENCODER_STEPS,
    ROTOR_SHARE,
    Grade,
    rotor_inertia,
    torque_errors,
)
from torque_safety_controller.new_robot.postures import Postures, SelfCollisions
from viability_bounds_pkg.cli.limits_file import rounded

Array = NDArray[np.float64]

SPEED_KEPT = 0.97
"""Share of the speed limits that the bounds use with imperfect hardware, as for the Panda."""

_FILTER = f"""\
    # Limits are available in {SHARE:.0%} of states only; docs/whole_arm.md.
    safety_filter: true
"""

_ROBOT = """\
# SPDX-License-Identifier: Apache-2.0
# {name}: {n} joints. Written by scripts/new_robot.sh; values are yours to change. Arrays are in
# the order of joints.
/**:
  ros__parameters:
    robot_name: {name}
    robot_description: {source}
    # The joints that move between {base} and {tips}; {locked} others are locked at 0.
    joints: {joints}
    base_frame: {root} # root of the URDF
    end_effector_frame: {tip} # as asked for
    # Hz. The margin for a held torque is small enough at this rate; see acceleration_drift.
    rate_hz: {rate}
    # position_min, position_max and torque_max are left out: those of the URDF count.
{speeds}
    # rad. Found: bent, near the middle of the ranges; motors hold it with {held:.0%} of their
    # torque; {shapes}.
    start_positions: {start}
    # rad/s^2. What torque leaves in the worst states found, with {reserve:.0%} of it kept back,
    # rounded towards zero, at most {cap:g}.
{found}
    acceleration_min: {a_min}
    acceleration_max: {a_max}

/**/bounds_node:
  ros__parameters:
    method: exact
    # Two control periods ahead avoid chatter.
    bounds_dt_factor: 2.0
    # rad/s^3. Largest jerk found while a torque is held for a control period, plus 10%;
    # docs/torque_margin.md.
    acceleration_drift: {drift}
    # rad. Error of the simulated position in a physics step of h = 1 ms: a h^2 / 8 with the
    # largest acceleration a.
    position_margin: 5.0e-06

/**/controller_node:
  ros__parameters:
    # With critical damping; as for the shipped Panda, within what gain_limits permits. The posture
    # counts little beside the pose. disturbance_time, 2.5 control periods, tightens the bounds by
    # pushes, friction and payloads.
{gains}{filter}"""

_IMPERFECT = """\
# SPDX-License-Identifier: Apache-2.0
# A {name} like real robots: parameters that are given after config/{name}.yaml. A URDF tells
# nothing of this: all is assumed, and to be replaced by what you know. docs/simulated_robot.md has
# the models.
/**:
  ros__parameters:
    # kg m^2. Assumed: the torque limit would accelerate a rotor alone by {rotor_share:g} rad/s^2.
    rotor_inertia: {rotors}
    # rad/s^2. As in the robot's own file, estimated with these rotors.
    acceleration_min: {a_min}
    acceleration_max: {a_max}
    # Declared: what you know about the robot; docs/uncertainty.md.
    use_estimated_states: true
    position_error: {half_step} # rad, half a step of the encoders below
    delay: 1 # control periods
    missed_deadlines: {missed} # longest row
    motor_bandwidth: {bandwidth} # Hz
    # rad/s^2. Errors of the torques that last are learned, so that the arm comes to rest at its
    # goal.
    lasting_disturbance: {lasting}
    # rad/s^2. What the errors of the torques below make of the accelerations in 999 of 1000 random
    # states.
    acceleration_disturbance: {disturbance}

/**/bounds_node:
  ros__parameters:
    # {horizon_ms:g} ms: rows of missed deadlines, no chatter at limits.
    bounds_dt_factor: {horizon}
    position_margin: 0.001 # rad, beyond what is declared; tested, not proven
    # rad/s. {speed_kept:g} of the limits, likewise.
    velocity_max: {v_max}
    acceleration_drift: {drift} # rad/s^3, with the rotors

/**/controller_node:
  ros__parameters:
    torque_reserve: {torque_errors} # N m, for safety_filter: the errors of the torques below
{gains}{filter}
/**/bullet_node:
  ros__parameters:
    encoder_resolution: {step} # rad, assumed: 16 bits a turn
    velocity_source: encoder # assumed: differences of positions through a filter
    velocity_filter_hz: 100.0
    state_delay: 0 # control periods, assumed
    command_delay: 1
    motor_bandwidth: {bandwidth} # Hz, assumed
    torque_constant_error: {constant_error} # assumed
    torque_ripple: {ripple} # share of torque_max, assumed
    current_noise: {noise} # share of torque_max, assumed
    missed_probability: 0.02 # assumed
    missed_in_row: {missed} # control periods
    command_timeout: {missed} # control periods
"""

_SCENARIO = """\
# SPDX-License-Identifier: Apache-2.0
# Into position and speed limits and back. The posture task is stiff and hardly damped, so that it
# overshoots its goals, which are at position limits: the bounds stop it. Written by
# scripts/new_robot.sh.
duration: {duration:.1f} # s of robot time
events:
  - time: 0.0
    parameters: {{node: controller_node, values: {{posture_kp: 100.0, posture_kd: 8.0}}}}
{events}"""


def parameter_file(
    chain: Chain,
    estimates: Estimates,
    postures: Postures,
    touches: SelfCollisions,
    *,
    source: str,
    base: str,
    gains: Mapping[str, float],
) -> str:
    """Return the text of ``config/<name>.yaml``.

    Args:
        chain: the arm.
        estimates: its limits.
        postures: of which the start is written.
        touches: what was looked at for the start.
        source: of the URDF, as `robot_description` has it.
        base: link from which on joints move; empty for the root.
        gains: of the controller, by name.
    """
    e = estimates
    speeds = []
    if chain.continuous.any():
        names = [n for n, c in zip(chain.joints, chain.continuous, strict=True) if c]
        speeds = _comment(
            f"{', '.join(names)} turn without end: they have no position limits, only limits of "
            "speed, acceleration and torque."
        )
    speeds += _comment(f"Speeds, rad/s: {e.why}")
    if e.speed_scale < 1.0:
        speeds.append(f"    velocity_max: {_yaml(e.v_max)}")
    ends = ", ".join(
        f"{name} [{low:.4g}, {high:.4g}]"
        for name, low, high in zip(chain.joints, e.worst_min, e.worst_max, strict=True)
    )
    shares = ", ".join(f"{100.0 * share:.2g}" for share in e.unavailable)
    shapes = f"{touches.pairs} pairs of shapes looked at"
    if touches.trouble:
        shapes = f"not looked at for collisions ({touches.trouble})"
    return _ROBOT.format(
        name=chain.name,
        n=len(chain.joints),
        source=_yaml(source),
        base=base or chain.root,
        tips=", ".join(chain.tips),
        locked=len(chain.locked),
        joints=_yaml(list(chain.joints)),
        root=_yaml(chain.root),
        tip=_yaml(chain.tips[0]),
        rate=_yaml(e.rate_hz),
        speeds="\n".join(speeds),
        held=postures.held,
        shapes=shapes,
        start=_yaml(postures.start),
        reserve=RESERVE,
        cap=CAP,
        found="\n".join(
            _comment(f"Found: {ends}. Not available in {shares} % of 20000 random states.")
        ),
        a_min=_yaml(e.a_min),
        a_max=_yaml(e.a_max),
        drift=_yaml(e.drift),
        gains=_lines(gains),
        filter=_FILTER if e.filtered.any() else "",
    )


def imperfect_file(
    chain: Chain,
    ideal: Estimates,
    estimates: Estimates,
    grade: Grade,
    disturbance: Array,
    gains: Mapping[str, Any],
) -> str:
    """Return the text of ``config/imperfect/<name>.yaml``.

    Args:
        chain: the arm, with rotors.
        ideal: its limits without rotors and imperfections.
        estimates: its limits with rotors.
        grade: of motors and connection.
        disturbance: what errors of torques make of accelerations, shape (n,), rad/s^2.
        gains: that differ from those of the ideal robot.
    """
    one = np.ones(len(chain.joints))
    step = 2.0 * np.pi / ENCODER_STEPS
    v_max = np.minimum(ideal.v_max, estimates.v_max)
    arrays = {
        "rotors": rotor_inertia(chain),
        "a_min": np.maximum(ideal.a_min, estimates.a_min),
        "a_max": np.minimum(ideal.a_max, estimates.a_max),
        "half_step": rounded(0.5 * step * one, ROUND_UP),
        "bandwidth": BANDWIDTH * one,
        "lasting": 20.0 * one,
        "disturbance": disturbance,
        "v_max": rounded(SPEED_KEPT * v_max, ROUND_DOWN),
        "drift": estimates.drift,
        "torque_errors": rounded(torque_errors(chain, grade), ROUND_UP),
        "step": rounded(step * one, ROUND_UP),
        "constant_error": grade.constant_error * np.where(np.arange(len(one)) % 2, 1.0, -1.0),
        "ripple": grade.ripple * one,
        "noise": grade.noise * one,
    }
    return _IMPERFECT.format(
        name=chain.name,
        rotor_share=ROTOR_SHARE,
        missed=grade.missed,
        horizon=grade.horizon,
        horizon_ms=1e3 * grade.horizon / estimates.rate_hz,
        speed_kept=SPEED_KEPT,
        gains=_lines(gains),
        filter=_FILTER if estimates.filtered.any() else "",
        **{name: _yaml(values) for name, values in arrays.items()},
    )


def scenario_file(chain: Chain, estimates: Estimates, postures: Postures) -> str:
    """Return the text of ``config/scenarios/<name>_demo.yaml``: into limits and back."""
    events, time = "", 0.0
    braking = np.minimum(-estimates.a_min, estimates.a_max)
    for goal in postures.goals:
        way = np.abs(goal - postures.start)
        leg = float(np.max(way / estimates.v_max + 2.0 * estimates.v_max / braking)) + 1.0
        leg = min(np.ceil(2.0 * leg) / 2.0, 15.0)
        count = int(((goal == chain.q_min) | (goal == chain.q_max)).sum())
        for q, note in ((goal, f" # {count} joints at a limit"), (postures.start, "")):
            posture = dict(zip(chain.joints, q.tolist(), strict=True))
            events += f"  - time: {time:.1f}{note}\n    posture: {_yaml(posture)}\n"
            time += leg
    return _SCENARIO.format(duration=max(time, 1.0), events=events)


def _comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, 99, initial_indent="    # ", subsequent_indent="    # ", break_on_hyphens=False
    )


def _lines(values: Mapping[str, Any]) -> str:
    return "".join(f"    {name}: {_yaml(value)}\n" for name, value in values.items())


def _yaml(value: Any) -> str:
    """Return a value as YAML in one line."""
    value = value.tolist() if isinstance(value, np.ndarray) else value
    text = yaml.safe_dump(value, default_flow_style=True, width=np.inf, sort_keys=False)
    return text.removesuffix("...\n").strip()
