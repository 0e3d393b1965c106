# SPDX-License-Identifier: Apache-2.0
"""Parameters that several nodes share: which robot it is, rate and frames; its model."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    joint_amounts,
    joint_numbers,
    number,
    numbers,
    switch,
    text,
    texts,
)
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import RobotDescriptionError, read_urdf
from viability_bounds_pkg.robot.mistakes import (
    SPEED_LIMITS,
    inertial_mistakes,
    inertial_oddities,
    speed_limit,
)
from viability_bounds_pkg.robot.urdf_joints import (
    LIMITS_OF_URDF,
    joint_elements,
    urdf_limit,
    urdf_limits,
)

Array = NDArray[np.float64]

TOPIC = "topic"
"""Value of ``robot_description`` that asks for what the topic of that name carries."""

_TURNS_MAX = 2.0
"""Turns of a joint with limits from which on its angles are surely degrees."""

_ANGLES = ("position_min", "position_max", "start_positions", "collision_posture")
_SLACK = 1e-3
"""Relative excess over limits of the URDF that rounding explains."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotConfiguration:
    """Which robot it is; arrays of shape (n,) in the order of its n joints."""

    NOT_NEEDED: ClassVar[frozenset[str]] = frozenset()
    """Limits that may be missing from the parameters and from the URDF."""

    robot_description: str = text("URDF: path, package:// URI, or 'topic': from that topic")
    joints: tuple[str, ...] = texts(
        "joints that move, from base to tip; the order of all arrays",
        note="at least one name, each once",
    )
    locked_joints: tuple[str, ...] = texts("locked joints that are not at zero", default=())
    locked_positions: Array = numbers(
        "their positions, rad", default=(), note="one for each of 'locked_joints'"
    )
    position_min: Array = joint_numbers(
        "lower position limits, rad; -.inf for continuous joints; those of the URDF if empty",
        default=(),
    )
    position_max: Array = joint_numbers(
        "upper position limits, rad; .inf for continuous joints; those of the URDF if empty",
        default=(),
        note="above position_min",
    )
    velocity_offset: Array = joint_numbers(
        "c of the speed limit max(0, sqrt(2 d r) - c) at the distance r to a position limit, "
        "rad/s; none if empty",
        NOT_NEGATIVE,
        default=(),
        note="together with deceleration_limit",
    )
    deceleration_limit: Array = joint_numbers(
        "d of this speed limit, rad/s^2; .inf or empty for none",
        default=(),
        note="> 0; together with velocity_offset",
    )
    torque_max: Array = joint_numbers(
        "torque limits of the motors, N m; those of the URDF if empty", POSITIVE, default=()
    )
    rotor_inertia: Array = joint_amounts(
        "inertia of the rotors as seen from the joints, kg m^2; none if empty"
    )

    def __post_init__(self) -> None:
        """Take limits that are not given from the URDF; check them and the locked joints."""
        self._complete()
        names, positions = self.locked_joints, self.locked_positions
        if len(names) != len(positions):
            allowed = f"{len(names)} numbers, one for each of 'locked_joints'"
            raise SettingError("locked_positions", positions, allowed)
        if not np.isfinite(positions).all():
            raise SettingError("locked_positions", positions, "finite numbers")
        if len({*names, *self.joints}) < len(names) + len(self.joints):
            allowed = "none of 'joints', each once"
            raise SettingError("locked_joints", names, allowed)
        low, high = self.position_min, self.position_max
        if np.isposinf(low).any():
            raise SettingError("position_min", low, "numbers below .inf")
        if not (low < high).all():
            raise SettingError("position_max", high, "above position_min everywhere")
        self._check_speed_limits()

    def _check_speed_limits(self) -> None:
        """Check the speed limits that depend on position; fill in what stands for none."""
        n, given = len(self.joints), len(self.velocity_offset)
        if given != len(self.deceleration_limit):
            name = "deceleration_limit" if given else "velocity_offset"
            raise SettingError(name, getattr(self, name), f"{n} numbers, as the other is given")
        if not given:
            object.__setattr__(self, "velocity_offset", np.zeros(n))
            object.__setattr__(self, "deceleration_limit", np.full(n, np.inf))
        c, d = self.velocity_offset, self.deceleration_limit
        if not (d > 0.0).all():
            raise SettingError("deceleration_limit", d, "numbers > 0, or .inf for none")
        if (np.isinf(d) & (c > 0.0)).any():
            raise SettingError("velocity_offset", c, "0 where deceleration_limit is .inf")
        if not (c * c / d < self.position_max - self.position_min).all():
            allowed = "smaller: somewhere between its position limits each joint must have a speed"
            raise SettingError("velocity_offset", c, allowed)

    def _complete(self) -> None:
        """Fill limits that are not given with those of the URDF."""
        missing = [name for name in LIMITS_OF_URDF if len(getattr(self, name, "given")) == 0]
        source = self.robot_description
        if source in ("", TOPIC):
            allowed = "a list of numbers"
            if source == TOPIC:
                allowed += ", where the URDF comes from its topic"
            for name in missing:
                if name not in self.NOT_NEEDED:
                    raise SettingError(name, None, allowed)
            return
        for name in missing:
            limits = urdf_limits(source, self.joints)[name]
            if None not in limits:
                object.__setattr__(self, name, np.array(limits, dtype=float))
            elif name not in self.NOT_NEEDED:
                lacking = f"{LIMITS_OF_URDF[name]} limit of {self.joints[limits.index(None)]}"
                raise SettingError(name, None, f"given, as the URDF has no {lacking}")

    @cached_property
    def continuous(self) -> NDArray[np.bool_]:
        """Whether a joint turns without end, as it has no position limits, shape (n,)."""
        return np.isneginf(self.position_min) & np.isposinf(self.position_max)

    @property
    def locked(self) -> dict[str, float]:
        """Where joints are locked that are not at zero, rad by name."""
        return dict(zip(self.locked_joints, map(float, self.locked_positions), strict=True))

    def read_urdf(self) -> str:
        """Return the text of the URDF that ``robot_description`` names.

        Raises:
            SettingError: there is none.
        """
        source = self.robot_description
        try:
            return read_urdf(source)
        except RobotDescriptionError as error:
            raise SettingError("robot_description", source, f"a URDF ({error})") from error


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitedRobotConfiguration(RobotConfiguration):
    """A robot with velocity limits."""

    velocity_max: Array = joint_numbers(
        "speed limits, rad/s; those of the URDF if empty", POSITIVE, default=()
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ControlRate:
    """Rate of a control loop."""

    rate_hz: float = number("rate of the control loop, Hz", Range(1.0, 1e4))

    @property
    def dt(self) -> float:
        """Control period, s."""
        return 1.0 / self.rate_hz


@dataclass(frozen=True, eq=False, kw_only=True)
class StateSource:
    """Which joint states a node works on."""

    use_estimated_states: bool = switch(
        "use estimated_joint_states of estimator_node instead of joint_states", default=False
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class TaskFrames:
    """Frames of pose goals."""

    base_frame: str = text("frame of pose goals; fixed to the URDF's root")
    end_effector_frame: str = text(
        "frame that pose goals move; for two hands 'left_hand right_hand'"
    )

    @property
    def end_effectors(self) -> tuple[str, ...]:
        """Names of the frames that pose goals move, at least one."""
        return tuple(self.end_effector_frame.split()) or ("",)


def check_with_urdf(config: RobotConfiguration, urdf: str) -> list[str]:
    """Return what is unusual about parameters of a robot, a line each.

    Args:
        config: its parameters.
        urdf: text of its URDF.

    Raises:
        SettingError: a joint that the URDF does not have, or angles that must be degrees.
    """
    elements = joint_elements(urdf, config.joints)
    lines = [line for j, joint in enumerate(elements) for line in _unusual(config, j, joint)]
    root = ElementTree.fromstring(urdf)
    lines += _unusual_locked(config, root)
    return lines + inertial_oddities(root, config.joints)


def _unusual_locked(config: RobotConfiguration, root: ElementTree.Element) -> Iterator[str]:
    joints = {each.get("name", ""): each for each in root.iterfind("joint")}
    for name, q in config.locked.items():
        joint = joints.get(name)
        low, high = (
            None if joint is None else urdf_limit(joint, key) for key in ("lower", "upper")
        )
        if low is None or high is None or low - _SLACK <= q <= high + _SLACK:
            continue
        yield (
            f"parameter 'locked_positions' is {q:g} for {name}, outside its limits in the URDF, "
            f"{low:g} to {high:g}"
        )


def _unusual(config: RobotConfiguration, j: int, joint: ElementTree.Element) -> Iterator[str]:
    name = config.joints[j]
    for parameter in _ANGLES if joint.get("type") == "revolute" else ():
        values = getattr(config, parameter, ())
        turns = abs(values[j]) / math.tau if len(values) else 0.0
        if _TURNS_MAX < turns < math.inf:
            allowed = f"rad; {values[j]:g} of {name} are {turns:.0f} turns: degrees?"
            raise SettingError(parameter, values, allowed)
    if joint.get("type") == "prismatic" and config.continuous[j]:
        raise SettingError("position_max", config.position_max, f"finite for {name}: it slides")
    for parameter, key in LIMITS_OF_URDF.items():
        values, of_urdf = getattr(config, parameter, ()), urdf_limit(joint, key)
        if not len(values) or of_urdf is None or math.isinf(of_urdf):
            continue
        excess = of_urdf - values[j] if key == "lower" else values[j] - of_urdf
        if excess > _SLACK * max(1.0, abs(of_urdf)):
            yield (
                f"parameter '{parameter}' is {values[j]:g} for {name}, beyond the {of_urdf:g} "
                "of the URDF"
            )
    with suppress(ValueError):
        c, d = speed_limit(joint)
        if config.velocity_offset[j] < c or config.deceleration_limit[j] > d:
            yield (
                f"<{SPEED_LIMITS}> of {name} in the URDF, {c:g} and {d:g}, is narrower than "
                "'velocity_offset' and 'deceleration_limit'"
            )
    start = getattr(config, "start_positions", None)
    low, high = config.position_min[j], config.position_max[j]
    if start is not None and not low <= start[j] <= high:
        yield (
            f"parameter 'start_positions' is {start[j]:g} for {name}, outside its position "
            f"limits, {low:g} to {high:g}"
        )


def load_model(config: RobotConfiguration, urdf: str) -> pin.Model:
    """Return the model of the arm.

    Args:
        config: which robot it is.
        urdf: text of its URDF.

    Raises:
        SettingError: a URDF that does not load, a joint that it does not have, or a moving link
            without an inertia, or with an impossible one.
    """
    rotors = dict(zip(config.joints, config.rotor_inertia, strict=False))
    try:
        model = build_model(urdf, config.joints, config.locked, config.rotor_inertia)
        if wrong := inertial_mistakes(ElementTree.fromstring(urdf), config.joints, rotors):
            raise RobotDescriptionError("; ".join(wrong))
        return model
    except RobotDescriptionError as error:
        allowed = {"joints": "joints of the URDF, base to tip", "robot_description": "a URDF"}
        said = f"{allowed.get(error.parameter, 'what fits the URDF')} ({error})"
        raise SettingError(error.parameter, getattr(config, error.parameter), said) from error
