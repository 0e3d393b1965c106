# SPDX-License-Identifier: Apache-2.0
"""Says which Python packages the system provides, and what was installed. Part of `setup.sh`.

    python3 scripts/packages.py fingerprint            changes when the system's packages change
    python3 scripts/packages.py plan sourced|wheels    writes what is to be installed into .venv
    .venv/bin/python scripts/packages.py leave_out            deletes what nothing here reads
    .venv/bin/python scripts/packages.py report        checks and lists what was installed

Runs without any package. Beside a sourced ROS 2, a package of the system is used where it is new
enough, instead of a wheel. NumPy always is: ROS' message packages are compiled for it.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
REQUIREMENTS = ROOT / "requirements"
VENV = ROOT / ".venv"
MESSAGES = "import rclpy, sensor_msgs.msg\nsensor_msgs.msg.JointState(position=[0.0])"
SHAPES = "import coal\nm.GeometryObject('', 0, m.SE3.Identity(), coal.Sphere(0.1))"


class Package(NamedTuple):
    """A package that this project uses directly.

    Attributes:
        requirement: its name in the requirements.
        module: what is imported.
        lowest: version from which on the system's is used.
        use: code that must run with the module as `m`.
        parts: names of the wheels that belong to it, as a regular expression.
    """

    requirement: str
    module: str
    lowest: str = ""
    use: str = ""
    parts: str = ""


PACKAGES = (
    Package("ros-jazzy-rclpy", "rclpy", use=MESSAGES, parts=r"ros-.*|rclpy|.*-msgs|.*-interfaces"),
    Package("numpy", "numpy", "1.26"),
    Package("scipy", "scipy", "1.11", "import scipy.optimize, scipy.linalg"),
    Package("numba", "numba", "0.59", parts="numba|llvmlite"),
    Package("pin", "pinocchio", "3", SHAPES, parts="(lib)?(pin|pinocchio|coal)|eigenpy|cmeel.*"),
    Package("proxsuite", "proxsuite", "0.6", "m.proxqp"),
    Package("daqp", "daqp", "0.7", "m.Model"),
    Package("pybullet", "pybullet"),
    Package("matplotlib", "matplotlib", "3.8", "import matplotlib.pyplot"),
    Package("PyYAML", "yaml", "6"),
    Package("tqdm", "tqdm", "4"),
)


class ImportedModule(NamedTuple):
    """A module as an interpreter of its own imported it: version, file, or why not."""

    version: str
    file: str
    error: str


def try_import(package: Package) -> ImportedModule:
    """Import and use a package in a process of its own, which a faulty library may end."""
    code = (
        f"import {package.module} as m\n{package.use}\n"
        "print('\\n', getattr(m, '__version__', ''), m.__file__, sep='\\n')"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd="/", check=False
    )
    if ended.returncode:
        last = [line for line in ended.stderr.splitlines() if line.strip()][-1:]
        return ImportedModule("", "", last[0] if last else f"ended with {ended.returncode}")
    version, file = ended.stdout.splitlines()[-2:]
    return ImportedModule(version or distribution_version(package.requirement), file, "")


def distribution_version(name: str) -> str:
    """Return the version of an installed distribution, empty if there is none of this name."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def numbers(version: str) -> list[int]:
    """Return the leading numbers of a version, to compare it."""
    return [int(part) for part in re.findall(r"\d+", version)[:3]]


def fingerprint() -> str:
    """Return a text that changes when a package of the system comes, goes or changes."""
    lines = []
    for package in PACKAGES:
        found = find_spec(package.module)
        if found and found.origin:
            time = Path(found.origin).stat().st_mtime_ns
            version = distribution_version(package.requirement)
            lines.append(f"{package.module} {version} {found.origin} {time}")
    return "\n".join(lines)


def provided() -> dict[str, str]:
    """Return the requirements that the system fulfils, with their versions.

    Raises:
        SystemExit: a package of the system cannot be used, and would be in the way of its wheel.
    """
    found = {}
    first = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    for package in PACKAGES:
        spec = find_spec(package.module)
        if spec is None:
            continue
        module = try_import(package)
        why = module.error or f"{module.version} is older than {package.lowest}"
        if not module.error and numbers(module.version) >= numbers(package.lowest):
            found[package.requirement] = module.version
        elif package.module in ("numpy", "rclpy", "pinocchio") or any(
            Path(spec.origin or "").is_relative_to(path) for path in first
        ):
            raise SystemExit(
                f"the system's {package.module} cannot be used ({why}), and would be in the way "
                "of another one; upgrade or remove it"
            )
        else:
            print(f"setup: the system's {package.module} is not used: {why}")
    if "pin" not in found and any(map(find_spec, ("eigenpy", "coal", "hppfcl"))):
        raise SystemExit(
            "the system's eigenpy or coal cannot be used without its Pinocchio; sudo apt install "
            "ros-jazzy-pinocchio, or remove them"
        )
    if "numpy" not in found:
        raise SystemExit("ROS 2 is sourced, but NumPy is missing: sudo apt install python3-numpy")
    return found


def names(file: str) -> list[str]:
    """Return the lines of a file in `requirements/` without comments."""
    lines = (REQUIREMENTS / file).read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def plan(kind: str) -> None:
    """Write what is to be installed beside a sourced ROS 2, or with ROS 2 as wheels."""
    system = provided() if kind == "sourced" else {}
    pins = [pin for pin in names("constraints.txt") if re.split("[=<>]", pin)[0] not in system]
    pins += [f"{name}=={version}" for name, version in system.items() if version]
    wanted = [name for name in names("common.txt") if name not in system]
    alone = names("pinocchio.txt") if kind == "sourced" and "pin" not in system else []
    if kind == "wheels":
        wanted += names("pinocchio.txt") + names("wheels.txt")
    for name, lines in {"constraints": pins, "requirements": wanted, "no_deps": alone}.items():
        (VENV / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines))


def leave_out() -> None:
    """Delete what `left_out.txt` names of the packages that were installed."""
    for pattern in names("left_out.txt"):
        for path in installed().glob(pattern):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


def installed() -> Path:
    """Return the folder of the packages in the virtual environment that runs this."""
    return next(Path(path) for path in sys.path if Path(path).is_relative_to(f"{sys.prefix}/lib"))


def report() -> None:
    """List the packages: version, from where, size. Check that each runs, and that NumPy is kept.

    Raises:
        SystemExit: a package does not run, or there is another NumPy than planned.
    """
    venv = Path(sys.prefix)
    sizes: dict[str, float] = {}
    for each in metadata.distributions(path=[str(installed())]):
        files = (os.path.join(each.locate_file(""), file) for file in each.files or ())
        size = sum(os.path.getsize(file) for file in files if os.path.exists(file))
        sizes[re.sub("[-_.]+", "-", each.metadata["Name"]).lower()] = size / 1e6
    total = sum(sizes.values())
    pins = (venv / "constraints.txt").read_text().splitlines()
    for package in PACKAGES:
        module = try_import(package)
        if module.error:
            raise SystemExit(f"{package.module} was installed but does not run: {module.error}")
        if package.module == "numpy" and f"numpy=={module.version}" not in {
            pin.split(";")[0] for pin in pins
        }:
            raise SystemExit(f"NumPy is {module.version} ({module.file}), not the one planned")
        if not Path(module.file).is_relative_to(venv):
            print(f"setup: {package.module:12} {module.version:9} system")
            continue
        parts = [n for n in sizes if re.fullmatch(package.parts or package.requirement.lower(), n)]
        megabytes = sum(sizes.pop(name) for name in parts)
        print(f"setup: {package.module:12} {module.version:9} wheel {megabytes:6.0f} MB")
    models = sizes.pop("example-robot-data", 0.0)
    print(f"setup: {'robot descriptions':22} wheel {models:6.0f} MB")
    print(f"setup: {'the rest':22} wheel {sum(sizes.values()):6.0f} MB")
    print(f"setup: {'all of .venv':22}       {total:6.0f} MB")


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tasks = parser.add_subparsers(dest="task", required=True)
    tasks.add_parser("fingerprint")
    tasks.add_parser("plan").add_argument("kind", choices=["sourced", "wheels"])
    tasks.add_parser("leave_out")
    tasks.add_parser("report")
    options = parser.parse_args()
    if options.task == "fingerprint":
        print(fingerprint())
    elif options.task == "plan":
        plan(options.kind)
    elif options.task == "leave_out":
        leave_out()
    else:
        report()


if __name__ == "__main__":
    try:
        main()
    except SystemExit as end:
        raise SystemExit(f"setup: {end}" if isinstance(end.code, str) else end.code) from None
