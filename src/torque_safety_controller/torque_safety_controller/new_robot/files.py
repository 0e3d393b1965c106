# SPDX-License-Identifier: Apache-2.0
"""The files of a new robot, with a comment to each number that says where it comes from."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from decimal import ROUND_UP
from typing import Any

import numpy as np
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

Entry = tuple[str, str, Any]
"""Comment, name and value of a parameter."""

_WIDTH = 99
_HEAD = "# SPDX-License-Identifier: Apache-2.0"

SPEED_KEPT = 0.97
"""Share of the speed limits that the bounds use with imperfect hardware, as for the Panda."""


def parameter_file(
    chain: Chain,
    estimates: Estimates,
    postures: Postures,
    touches: SelfCollisions,
    *,
    source: str,
    base: str,
    gains: dict[str, float],
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
    ends = ", ".join(
        f"{name} [{low:.4g}, {high:.4g}]"
        for name, low, high in zip(chain.joints, e.worst_min, e.worst_max, strict=True)
    )
    shapes = f"{touches.pairs} pairs of shapes looked at"
    if touches.trouble:
        shapes = f"not looked at for collisions ({touches.trouble})"
    robot: list[Entry] = [
        ("", "robot_name", chain.name),
        ("", "robot_description", source),
        (
            f"The joints that move between {base or chain.root} and {', '.join(chain.tips)}; "
            f"{len(chain.locked)} others are locked at 0.",
            "joints",
            list(chain.joints),
        ),
        ("Root of the URDF.", "base_frame", chain.root),
        ("As asked for.", "end_effector_frame", chain.tips[0]),
        (
            "Hz. The margin for a held torque is small enough at this rate; see "
            "acceleration_drift.",
            "rate_hz",
            e.rate_hz,
        ),
    ]
    note = "position_min, position_max and torque_max are left out: those of the URDF count."
    if chain.continuous.any():
        names = [n for n, c in zip(chain.joints, chain.continuous, strict=True) if c]
        note += (
            f" {', '.join(names)} turn without end: they have no position limits, only limits of "
            "speed, acceleration and torque."
        )
    if e.speed_scale < 1.0:
        robot.append((f"{note} Speeds, rad/s: {e.why}", "velocity_max", e.v_max))
        why = ""
    else:
        note += " velocity_max, too."
        why = " " + e.why
    robot += [
        (
            ("" if e.speed_scale < 1.0 else note + " ")
            + f"rad. Found: bent, near the middle of the ranges; motors hold it with "
            f"{postures.held:.0%} of their torque; {shapes}.",
            "start_positions",
            postures.start,
        ),
        (
            f"rad/s^2. What torque leaves in the worst states found, with {RESERVE:.0%} of it "
            f"kept back, rounded towards zero, at most {CAP:g}.{why} Found: {ends}. "
            "Not available in "
            f"{_listed(100 * e.unavailable)} % of 20000 random states.",
            "acceleration_min",
            e.a_min,
        ),
        ("", "acceleration_max", e.a_max),
    ]
    if e.filtered.any():
        gains = {**gains, "safety_filter": True}
    bounds: list[Entry] = [
        ("", "method", "exact"),
        ("Two control periods ahead avoid chatter.", "bounds_dt_factor", 2.0),
        (
            "rad/s^3. Largest jerk found while a torque is held for a control period, plus 10%; "
            "docs/torque_margin.md.",
            "acceleration_drift",
            e.drift,
        ),
        (
            "rad. Error of the simulated position in a physics step of h = 1 ms: a h^2 / 8 with "
            "the largest acceleration a.",
            "position_margin",
            5.0e-6,
        ),
    ]
    notes = {
        "pose_kp": "1/s^2. With critical damping; as for the shipped Panda, within what "
        "gain_limits permits.",
        "posture_weight": "Small beside the pose, which has a weight of 1.",
        "disturbance_time": "s. Tightens the bounds by pushes, friction and payloads: 2.5 control "
        "periods.",
        "safety_filter": f"Limits are available in {SHARE:.0%} of states only; docs/whole_arm.md.",
    }
    control = [(notes.get(name, ""), name, value) for name, value in gains.items()]
    return _text(
        f"{chain.name}: {len(chain.joints)} joints. Written by scripts/new_robot.sh; values are "
        "yours to change. Arrays are in the order of joints.",
        (
            ("/**", robot),
            ("/**/bounds_node", bounds),
            ("/**/controller_node", control),
        ),
    )


def imperfect_file(
    chain: Chain,
    ideal: Estimates,
    estimates: Estimates,
    grade: Grade,
    disturbance: Array,
    gains: dict[str, Any],
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
    n = len(chain.joints)
    step = 2.0 * np.pi / ENCODER_STEPS
    v_max = np.minimum(ideal.v_max, estimates.v_max)
    signs = np.where(np.arange(n) % 2, 1.0, -1.0)
    rate = estimates.rate_hz
    robot: list[Entry] = [
        (
            f"kg m^2. Assumed: the torque limit would accelerate a rotor alone by {ROTOR_SHARE:g} "
            "rad/s^2.",
            "rotor_inertia",
            rotor_inertia(chain),
        ),
        (
            "rad/s^2. As in the robot's own file, estimated with these rotors.",
            "acceleration_min",
            np.maximum(ideal.a_min, estimates.a_min),
        ),
        ("", "acceleration_max", np.minimum(ideal.a_max, estimates.a_max)),
        ("Declared: what you know about the robot; docs/uncertainty.md.",
         "use_estimated_states", True),
        ("rad, half a step of the encoders below.", "position_error",
         np.full(n, float(rounded(np.array([0.5 * step]), ROUND_UP)[0]))),
        ("Control periods.", "delay", 1),
        ("Longest row.", "missed_deadlines", grade.missed),
        ("Hz.", "motor_bandwidth", np.full(n, BANDWIDTH)),
        (
            "rad/s^2. Errors of the torques that last are learned, so that the arm comes to rest "
            "at its goal.",
            "lasting_disturbance",
            np.full(n, 20.0),
        ),
        (
            "rad/s^2. What the errors of the torques below make of the accelerations in 999 of "
            "1000 random states.",
            "acceleration_disturbance",
            disturbance,
        ),
    ]  # fmt: skip
    bounds: list[Entry] = [
        (
            f"{1e3 * grade.horizon / rate:g} ms: rows of missed deadlines, no chatter at limits.",
            "bounds_dt_factor",
            grade.horizon,
        ),
        ("rad. Beyond what is declared; tested, not proven.", "position_margin", 1e-3),
        (f"rad/s. {SPEED_KEPT:g} of the limits, likewise.", "velocity_max",
         rounded(SPEED_KEPT * v_max, "ROUND_DOWN")),
        ("rad/s^3. With the rotors.", "acceleration_drift", estimates.drift),
    ]  # fmt: skip
    control: list[Entry] = [
        (
            "N m. For safety_filter: the errors of the torques below.",
            "torque_reserve",
            rounded(torque_errors(chain, grade), ROUND_UP),
        ),
        *(("", name, value) for name, value in gains.items()),
    ]
    if estimates.filtered.any():
        control.append(("With the rotors, too, limits are missing.", "safety_filter", True))
    hardware: list[Entry] = [
        ("rad. Assumed: 16 bits a turn.", "encoder_resolution",
         np.full(n, float(rounded(np.array([step]), ROUND_UP)[0]))),
        ("Assumed: differences of positions through a filter.", "velocity_source", "encoder"),
        ("Hz.", "velocity_filter_hz", 100.0),
        ("Control periods, assumed.", "state_delay", 0),
        ("", "command_delay", 1),
        ("Hz, assumed.", "motor_bandwidth", np.full(n, BANDWIDTH)),
        ("Assumed.", "torque_constant_error", grade.constant_error * signs),
        ("Share of torque_max, assumed.", "torque_ripple", np.full(n, grade.ripple)),
        ("Share of torque_max, assumed.", "current_noise", np.full(n, grade.noise)),
        ("Assumed.", "missed_probability", 0.02),
        ("Control periods.", "missed_in_row", grade.missed),
        ("Control periods.", "command_timeout", grade.missed),
    ]  # fmt: skip
    return _text(
        f"A {chain.name} like real robots: parameters that are given after config/"
        f"{chain.name}.yaml. A URDF tells nothing of this: all is assumed, and to be replaced by "
        "what you know. docs/simulated_robot.md has the models.",
        (
            ("/**", robot),
            ("/**/bounds_node", bounds),
            ("/**/controller_node", control),
            ("/**/bullet_node", hardware),
        ),
    )


def scenario_file(chain: Chain, estimates: Estimates, postures: Postures) -> str:
    """Return the text of ``config/scenarios/<name>_demo.yaml``: into limits and back."""
    lines = [
        _HEAD,
        *_comment(
            "Into position and speed limits and back. The posture task is stiff and hardly "
            "damped, so that it overshoots its goals, which are at position limits: "
            "the bounds stop it. "
            "Written by scripts/new_robot.sh.",
            "",
        ),
    ]
    events: list[str] = ["  - time: 0.0"]
    events += [
        "    parameters: {node: controller_node, values: {posture_kp: 100.0, posture_kd: 8.0}}"
    ]
    time = 0.0
    braking = np.minimum(-estimates.a_min, estimates.a_max)
    for goal in postures.goals:
        way = np.abs(goal - postures.start)
        leg = float(np.max(way / estimates.v_max + 2.0 * estimates.v_max / braking)) + 1.0
        leg = min(np.ceil(2.0 * leg) / 2.0, 15.0)
        count = int(((goal == chain.q_min) | (goal == chain.q_max)).sum())
        events.append(f"  - time: {time:.1f} # {count} joints at a limit")
        events += _posture(chain, goal)
        time += leg
        events.append(f"  - time: {time:.1f}")
        events += _posture(chain, postures.start)
        time += leg
    lines += [f"duration: {max(time, 1.0):.1f} # s of robot time", "events:", *events]
    return "\n".join(lines) + "\n"


def _posture(chain: Chain, q: Array) -> list[str]:
    values = [f"{name}: {float(each)!r}" for name, each in zip(chain.joints, q, strict=True)]
    return textwrap.wrap(
        "posture: {" + ", ".join(values) + "}",
        _WIDTH,
        initial_indent="    ",
        subsequent_indent="      ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _comment(text: str, indent: str) -> list[str]:
    start = f"{indent}# "
    return textwrap.wrap(
        text, _WIDTH, initial_indent=start, subsequent_indent=start, break_on_hyphens=False
    )


def _text(title: str, sections: Iterable[tuple[str, list[Entry]]]) -> str:
    lines = [_HEAD, *_comment(title, "")]
    for section, entries in sections:
        lines += [f"{section}:", "  ros__parameters:"]
        for note, name, value in entries:
            lines += _comment(note, "    ") if note else []
            lines.append(f"    {name}: {_value(value)}")
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"' if not value or set(value) & set("#{}[],&*!|>%@`'") else value
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _number(value)
    items = value.tolist() if isinstance(value, np.ndarray) else value
    return "[" + ", ".join(map(_value, items)) + "]"


def _number(value: float) -> str:
    text = repr(float(value))
    # YAML 1.1 reads a number with an exponent only with a point.
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _listed(values: Array) -> str:
    return ", ".join(f"{value:.2g}" for value in values)
