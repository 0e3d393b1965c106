# SPDX-License-Identifier: Apache-2.0
"""Reads a robot's parameter file and writes the file with the estimated limits."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Context
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.parameter_files import read_files
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.urdf_joints import units_of

Array = NDArray[np.float64]

NODE = "/**/bounds_node"
"""The node whose parameters the limits are."""

CONTROLLER = "/**/controller_node"
"""The node that must know them, too, to keep distances."""

DIGITS = 4
"""Significant digits written."""


@dataclass(frozen=True)
class Robot:
    """A robot and the limits its parameter file gives.

    Attributes:
        model: Pinocchio's, one degree of freedom a joint, n of them.
        q_min: lower position limits, shape (n,), rad; infinite for continuous joints.
        q_max: upper position limits, shape (n,), rad.
        v_max: velocity limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
        units: of the joints' positions, n of them.
    """

    model: pin.Model
    q_min: Array
    q_max: Array
    v_max: Array
    tau_max: Array
    units: Sequence[str]


def read_robot(path: Path) -> Robot:
    """Return the robot that a ROS 2 parameter file describes.

    Parameters are looked up under ``/**`` and, before that, under the bounds node. Limits that
    the file does not give are those of the URDF.

    Args:
        path: the parameter file.

    Raises:
        ParameterFileError: the file cannot be read, is no parameter file, or a parameter is
            missing or of the wrong type or length.
        SettingError: the URDF cannot be found.
        RobotDescriptionError: it cannot be loaded, or lacks a joint; a rotor inertia is negative.
    """
    config = read_files(LimitedRobotConfiguration, [path], NODE)
    urdf = config.read_urdf()
    return Robot(
        build_model(urdf, config.joints, config.locked, config.rotor_inertia),
        config.position_min,
        config.position_max,
        config.velocity_max,
        config.torque_max,
        units_of(urdf, config.joints),
    )


def overlay(
    joints: Sequence[str], parameters: Mapping[str, Array], notes: Sequence[str], node: str = NODE
) -> str:
    """Return a parameter file that sets `parameters` of one node.

    It is meant as a second ``--params-file``, after the robot's: what a person wrote there, with
    the comments, stays as it is. It names the joints, so that it is refused after another's.

    Args:
        joints: names of the joints.
        parameters: values by name; they must have few enough digits to be written as they are.
        notes: comment lines for the head of the file.
        node: whose parameters they are.
    """
    lines = [f"# {note}" for note in notes]
    lines += [f"{node}:", "  ros__parameters:", f"    joints: {json.dumps(list(joints))}"]
    for name, values in parameters.items():
        lines.append(f"    {name}: [{', '.join(repr(float(value)) for value in values)}]")
    return "\n".join(lines) + "\n"


def rounded(values: Array, rounding: str) -> Array:
    """Return `values` with `DIGITS` significant digits, by a rounding mode of `decimal`."""
    context = Context(DIGITS, rounding)
    return np.array([float(context.create_decimal(repr(value))) for value in values.tolist()])


def check_writable(path: Path) -> None:
    """Raise `OSError` if `path` cannot be written, before the work that it should hold."""
    target = path.resolve()
    if target.is_dir():
        raise IsADirectoryError(f"{path} is a directory")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{path}: no directory {target.parent}")
    if target.exists() and not os.access(target, os.W_OK):
        raise PermissionError(f"{path} is write-protected")
    try:
        # Permissions do not tell everything: the file system may be read-only.
        tempfile.NamedTemporaryFile(prefix=f".{target.name}.", dir=target.parent).close()
    except OSError as error:
        reason = f"directory {target.parent} cannot be written to ({error.strerror})"
        raise OSError(f"{path}: {reason}") from error


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file atomically: at any time the old or the new one is there, complete.

    Raises:
        OSError: the file cannot be written; what was there before still is.
    """
    target = path.resolve()
    fresh = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with fresh.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, fresh)
        fresh.replace(target)
    except OSError as error:
        raise OSError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        fresh.unlink(missing_ok=True)
