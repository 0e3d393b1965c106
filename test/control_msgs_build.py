# SPDX-License-Identifier: Apache-2.0
"""The part of control_msgs that tests need, made from its definitions: there is no wheel of it."""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import importlib.util
import json
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy as np
import rclpy
from rosidl_adapter import convert_to_idl
from rosidl_cli.command.helpers import generate_visibility_control_file

PACKAGE = "control_msgs"
TOLERANCE = "float64 position\nfloat64 velocity\nfloat64 acceleration\n"
DEFINITIONS = {
    "msg/JointTolerance.msg": "string name\n" + TOLERANCE,
    "msg/JointComponentTolerance.msg": """\
uint16 X_AXIS=1
uint16 Y_AXIS=2
uint16 Z_AXIS=3
uint16 TRANSLATION=4
uint16 ROTATION=5
string joint_name
uint16 component
"""
    + TOLERANCE,
    "action/FollowJointTrajectory.action": """\
trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
JointTolerance[] path_tolerance
JointComponentTolerance[] component_path_tolerance
JointTolerance[] goal_tolerance
JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
---
int32 SUCCESSFUL=0
int32 INVALID_GOAL=-1
int32 INVALID_JOINTS=-2
int32 OLD_HEADER_TIMESTAMP=-3
int32 PATH_TOLERANCE_VIOLATED=-4
int32 GOAL_TOLERANCE_VIOLATED=-5
int32 error_code
string error_string
---
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
""",
}
DEPENDENCIES = (
    "action_msgs",
    "builtin_interfaces",
    "geometry_msgs",
    "service_msgs",
    "std_msgs",
    "trajectory_msgs",
    "unique_identifier_msgs",
)
# Both are of use to Fast DDS: one (de)serializes, the other describes types to it.
TYPE_SUPPORTS = ["rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"]
GENERATORS = (
    ("rosidl_generator_type_description", "generate_type_hash"),
    ("rosidl_generator_c", "generate_c"),
    ("rosidl_generator_py", "generate_py", ["rosidl_typesupport_c"]),
    ("rosidl_typesupport_c", "generate_c", TYPE_SUPPORTS),
    ("rosidl_typesupport_fastrtps_c", "generate_typesupport_fastrtps_c"),
    ("rosidl_typesupport_introspection_c", "generate_c"),
)
LIBRARIES = (*DEPENDENCIES, "rosidl", "fastcdr", "rcutils", "rmw")
ROS = Path(rclpy.__file__).parents[4]  # the virtual environment, or the ROS that is sourced
HEADERS = Path(sysconfig.get_path("include"))


class CompilerMissingError(RuntimeError):
    """There is nothing to compile with."""


def import_control_msgs(folder: Path) -> None:
    """Make ``import control_msgs.action, control_msgs.msg`` work in this process.

    Generates and compiles the package in the folder, in seconds, unless that is done or there is a
    control_msgs. Several processes may call it at once.

    Raises:
        CompilerMissingError: gcc, g++ or the headers of Python are not installed.
    """
    found = importlib.util.find_spec(PACKAGE)
    if found and found.origin:  # not just a folder of that name
        return
    # A change of this file, of Python, NumPy or the place of ROS makes it anew.
    inputs = f"{Path(__file__).read_text()} {sys.version} {np.__version__} {ROS}"
    built = folder.resolve() / hashlib.sha256(inputs.encode()).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not built.exists():
            _build(built.parent).rename(built)
    sys.path.append(str(built / "rosidl_generator_py"))
    importlib.invalidate_caches()
    importlib.import_module(f"{PACKAGE}.{PACKAGE}_s__rosidl_typesupport_c")
    for name in TYPE_SUPPORTS:
        ctypes.CDLL(str(built / f"lib{PACKAGE}__{name}.so"))  # so that its name alone finds it


def _build(parent: Path) -> Path:
    """Generate and compile the package in a new folder."""
    if not (shutil.which("gcc") and shutil.which("g++") and (HEADERS / "Python.h").exists()):
        raise CompilerMissingError(
            f"{PACKAGE} cannot be compiled: gcc, g++ or Python.h is not installed"
        )
    for left in parent.glob("unfinished-*"):
        shutil.rmtree(left, ignore_errors=True)
    # Never the same one: a compiler may outlive the process that was ended, and still write.
    folder = Path(tempfile.mkdtemp(prefix="unfinished-", dir=parent))
    _generate(folder)
    _compile(folder)
    return folder


def _generate(folder: Path) -> None:
    """Write Python modules and sources in C and C++, in a folder for each generator."""
    package = folder / "definitions" / PACKAGE
    for name, text in DEFINITIONS.items():
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        convert_to_idl(package, PACKAGE, Path(name), package)
    names = [name.partition(".")[0] for name in DEFINITIONS]
    descriptions = folder / GENERATORS[0][0] / PACKAGE
    arguments = {
        "package_name": PACKAGE,
        "idl_tuples": [f"{package}:{name}.idl" for name in names],
        "include_paths": [f"{name}:{ROS / 'share' / name}" for name in DEPENDENCIES],
        "type_description_tuples": [f"{name}.idl:{descriptions / name}.json" for name in names],
        "target_dependencies": [],
    }
    for generator, function, *options in GENERATORS:
        output = folder / generator / PACKAGE
        templates = ROS / "share" / generator / "resource"
        file = folder / "arguments.json"
        places = {"output_dir": str(output), "template_dir": str(templates)}
        file.write_text(json.dumps(arguments | places))
        getattr(importlib.import_module(generator), function)(str(file), *options)
        for template in templates.glob("*__visibility_control.h.in"):
            header = output / "msg" / template.stem
            generate_visibility_control_file(
                package_name=PACKAGE, template_path=template, output_path=header
            )


def _compile(folder: Path) -> None:
    """Make the module that rclpy imports, a library of all sources."""
    package = folder / "rosidl_generator_py" / PACKAGE
    (package / "__init__.py").touch()
    module = package / f"{PACKAGE}_s__rosidl_typesupport_c.so"
    includes = [HEADERS, np.get_include(), ROS / "include", *folder.glob("rosidl_*")]
    includes += [path for name in LIBRARIES for path in (ROS / "include").glob(f"{name}*")]
    _gcc(
        *("-O0", "-fPIC", *(f"-I{path}" for path in includes)),
        *(path for path in folder.rglob("*.c*") if path.suffix in (".c", ".cpp")),
        *("-o", module, f"-Wl,-soname,{module.name}"),
        *(f"-Wl,-rpath,{ROS / 'lib'}", "-Wl,--as-needed", "-lstdc++"),
        *(path for name in LIBRARIES for path in (ROS / "lib").glob(f"lib{name}*.so")),
    )
    # A type support is looked for in the library of its name, and in what that is linked with.
    for name in TYPE_SUPPORTS:
        library = folder / f"lib{PACKAGE}__{name}.so"
        _gcc("-o", library, f"-Wl,-soname,{library.name}", "-Wl,--no-as-needed", module)


def _gcc(*arguments: str | Path) -> None:
    subprocess.run(["gcc", "-shared", *map(str, arguments)], check=True)
