# SPDX-License-Identifier: Apache-2.0
"""Parameter file and scenario of a new robot, with comments that say where numbers come from."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from torque_safety_controller.new_robot.chain import Chain
from torque_safety_controller.new_robot.estimates import CAP, RESERVE, SHARE, Estimates
from torque_safety_controller.new_robot.postures import Postures
from viability_bounds_pkg.robot.mistakes import SPEED_LIMITS

FILTER = f"""\
    # Limits are available in {SHARE:.0%} of states only; docs/theory/whole_arm.md.
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
    # {rad}. Found: bent, near the middle of the ranges; motors hold it with {held:.0%} of their
    # torque; {checked}.
    start_positions: {start}
    # {rad_s2}. What torque leaves in the worst states found, with {reserve:.0%} of it kept back,
    # rounded towards zero, at most {cap:g}.
{found}
    acceleration_min: {a_min}
    acceleration_max: {a_max}

/**/bounds_node:
  ros__parameters:
    method: exact
    # Two control periods ahead avoid chatter.
    bounds_dt_factor: 2.0
    # {rad_s3}. Largest jerk found while a torque is held for a control period, plus 10%;
    # docs/theory/bounds.md.
    acceleration_drift: {drift}
    # {rad}. Error of the simulated position in a physics step of h = 1 ms: a h^2 / 8 with the
    # largest acceleration a.
    position_margin: 5.0e-06

/**/controller_node:
  ros__parameters:
    # With critical damping; as for the shipped Panda, within what gain_limits permits. The posture
    # counts little beside the pose. disturbance_time, 2.5 control periods, tightens the bounds by
    # pushes, friction and payloads.
{gains}{filter}"""

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
    *,
    checked: str,
    source: str,
    base: str,
    gains: Mapping[str, float],
) -> str:
    """Return the text of ``config/<name>.yaml``.

    Args:
        chain: the arm.
        estimates: its limits.
        postures: of which the start is written.
        checked: of collisions at the start, for the comment.
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
    speeds += _comment(f"Speeds, {unit_of(chain, '/s')}: {e.why}")
    if e.speed_scale < 1.0 or chain.slowed:
        speeds.append(f"    velocity_max: {yaml_line(e.v_max)}")
    if np.isfinite(chain.deceleration_limit).any():
        speeds += _comment(
            f"{unit_of(chain, '/s')} and {unit_of(chain, '/s^2')}: <{SPEED_LIMITS}> of the URDF, "
            "with which the robot stops itself; docs/theory/bounds.md."
        )
        for name in ("velocity_offset", "deceleration_limit"):
            speeds.append(f"    {name}: {yaml_line(getattr(chain, name))}")
    ends = ", ".join(
        f"{name} [{_found(low)}, {_found(high)}]"
        for name, low, high in zip(chain.joints, e.worst_min, e.worst_max, strict=True)
    )
    shares = ", ".join(f"{100.0 * share:.2g}" for share in e.unavailable)
    return _ROBOT.format(
        name=chain.name,
        n=len(chain.joints),
        source=yaml_line(source),
        base=base or chain.root,
        tips=", ".join(chain.tips),
        locked=len(chain.locked),
        joints=yaml_line(list(chain.joints)),
        root=yaml_line(chain.root),
        tip=yaml_line(chain.tips[0]),
        rate=yaml_line(e.rate_hz),
        speeds="\n".join(speeds),
        held=postures.held,
        checked=checked,
        start=yaml_line(postures.start),
        reserve=RESERVE,
        cap=CAP,
        found="\n".join(
            _comment(f"Found: {ends}. Not available in {shares} % of 20000 random states.")
        ),
        a_min=yaml_line(e.a_min),
        a_max=yaml_line(e.a_max),
        drift=yaml_line(e.drift),
        gains=yaml_lines(gains),
        rad=unit_of(chain),
        rad_s2=unit_of(chain, "/s^2"),
        rad_s3=unit_of(chain, "/s^3"),
        filter=FILTER if e.filtered.any() else "",
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
            events += f"  - time: {time:.1f}{note}\n    posture: {yaml_line(posture)}\n"
            time += leg
    return _SCENARIO.format(duration=max(time, 1.0), events=events)


def _found(acceleration: float) -> str:
    """Return an acceleration, or that it is far beyond the cap: its digits tell nothing."""
    if abs(acceleration) < 10.0 * CAP:
        return f"{acceleration:.4g}"
    return (
        f"far {'more' if acceleration > 0.0 else 'less'} than {np.copysign(CAP, acceleration):g}"
    )


def unit_of(chain: Chain, per: str = "") -> str:
    """Return the unit of all joints, such as "rad/s"; a slide's has m in place of rad."""
    if chain.slides.all():
        return f"m{per}"
    return f"rad{per}, m{per} of slides" if chain.slides.any() else f"rad{per}"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(
        text, 99, initial_indent="    # ", subsequent_indent="    # ", break_on_hyphens=False
    )


def yaml_lines(values: Mapping[str, Any]) -> str:
    """Return parameters of a node, a line each."""
    return "".join(f"    {name}: {yaml_line(value)}\n" for name, value in values.items())


def yaml_line(value: Any) -> str:
    """Return a value as YAML in one line."""
    value = value.tolist() if isinstance(value, np.ndarray) else value
    text = yaml.safe_dump(value, default_flow_style=True, width=np.inf, sort_keys=False)
    return text.removesuffix("...\n").strip()
