# SPDX-License-Identifier: Apache-2.0
"""Set-up that cannot succeed says why, in a copy of its files and without a network.

That it succeeds beside a sourced ROS 2 is for `test/ubuntu_jazzy.sh` to show.
"""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from viability_bounds_pkg.testing.executables import run_to_end

pytestmark = pytest.mark.packaging
ROOT = Path(__file__).resolve().parents[2]
PYTHON = sys._base_executable
PYBULLET = "pybullet-3.2.7"


@pytest.fixture
def copy(tmp_path):
    """What set-up needs until it builds, and an empty `index` where pip looks for packages."""
    for folder in ("scripts", "requirements"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "index").mkdir()
    return tmp_path


def set_up(copy, **environment):
    """Run set-up in a copy; return its exit code and what it said."""
    away = ("VIRTUAL_ENV", "PYTHONPATH", "ROS_DISTRO", "AMENT_PREFIX_PATH")
    inherited = {name: value for name, value in os.environ.items() if name not in away}
    inherited = {n: value for n, value in inherited.items() if not n.startswith("PIP_")}
    offline = {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_NO_CACHE_DIR": "1"}
    ended = run_to_end(
        *("bash", "-c", "source scripts/setup.sh"),
        cwd=copy,
        env=inherited
        | offline
        | {"PYTHON": PYTHON, "PIP_FIND_LINKS": str(copy / "index")}
        | {name: value for name, value in environment.items() if value is not None},
    )
    return ended.returncode, ended.stdout + ended.stderr


def python_with(folder, name, start):
    """Make a folder for PYTHONPATH with a module or, as `sitecustomize`, code for each start."""
    folder.mkdir()
    (folder / f"{name}.py").write_text(start)
    return str(folder)


def test_an_index_without_the_package(copy):
    code, said = set_up(copy)
    assert code == 1
    assert "setup: installing packages failed: the package index has no versions that fit" in said
    assert "The user requested" in said
    assert "pybullet==3.2.7" in said
    assert "network" not in said


def test_an_environment_that_is_a_link_is_not_wiped(copy, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    (other / "kept").touch()
    (copy / ".venv").symlink_to(other)
    code, said = set_up(copy)
    assert code == 1
    assert f"setup: .venv is a link to '{other}', which would be wiped; remove the link" in said
    assert (other / "kept").exists()


def test_an_index_out_of_reach(copy):
    # Nothing listens at port 9.
    unreachable = {"PIP_NO_INDEX": "0", "PIP_INDEX_URL": "http://127.0.0.1:9/", "PIP_RETRIES": "1"}
    code, said = set_up(copy, **unreachable)
    assert code == 1
    assert "setup: installing packages failed: the package index cannot be reached (net" in said


def test_a_full_disk(copy):
    venv = copy / ".venv"
    venv.mkdir()
    mounted = run_to_end("mount", "-t", "tmpfs", "-o", "size=60m", "none", venv)
    if mounted.returncode:
        pytest.skip(f"no small disk can be made here: {mounted.stderr}")
    try:
        name = copy / "index" / f"{PYBULLET}-py3-none-any.whl"
        with zipfile.ZipFile(name, "w", zipfile.ZIP_DEFLATED) as wheel:
            wheel.writestr("pybullet_data.bin", bytes(100_000_000))
            wheel.writestr(f"{PYBULLET}.dist-info/METADATA", "Name: pybullet\nVersion: 3.2.7\n")
            wheel.writestr(f"{PYBULLET}.dist-info/WHEEL", "Wheel-Version: 1.0\n")
            wheel.writestr(f"{PYBULLET}.dist-info/RECORD", "")
        code, said = set_up(copy)
    finally:
        subprocess.run(["umount", venv], check=True)
    assert code == 1
    assert "setup: installing packages failed: no space is left. .venv needs 2.5 GB" in said
    assert "network" not in said


def test_a_python_that_cannot_make_environments(copy):
    # As on Ubuntu without python3-venv.
    blocked = python_with(
        copy / "path", "sitecustomize", "import sys\nsys.modules['ensurepip']=None"
    )
    code, said = set_up(copy, PYTHONPATH=blocked)
    assert code == 1
    assert "cannot make virtual environments; on Ubuntu: sudo apt install python3-venv" in said


def test_ros_for_another_python(copy):
    path = python_with(
        copy / "path", "rclpy", "raise ImportError('no module _rclpy for this one')"
    )
    code, said = set_up(copy, ROS_DISTRO="jazzy", PYTHONPATH=path)
    assert code == 1
    assert "setup: ROS 2 Jazzy is sourced, but not for" in said
    assert "no module _rclpy for this one. Set PYTHON to the one that ROS uses" in said


def test_another_ros(copy):
    code, said = set_up(copy, ROS_DISTRO="humble")
    assert code == 1
    assert said.strip() == (
        "setup: ROS 2 'humble' is sourced, but this is for Jazzy; open a shell without it."
    )


def test_a_system_package_in_the_way(copy):
    """Libraries of a Pinocchio that cannot be used would be loaded by the wheel's."""
    path = Path(python_with(copy / "path", "rclpy", ""))
    (path / "sensor_msgs").mkdir()
    (path / "sensor_msgs" / "__init__.py").write_text("")
    (path / "sensor_msgs" / "msg.py").write_text("def JointState(position):\n    pass\n")
    (path / "numpy.py").write_text("__version__ = '1.26.4'\n")
    (path / "pinocchio.py").write_text("__version__ = '3.7.0'\n")
    (path / "coal.py").write_text("raise ImportError('no coal here')\n")
    code, said = set_up(copy, ROS_DISTRO="jazzy", PYTHONPATH=str(path))
    assert code == 1
    assert "setup: the system's pinocchio cannot be used (ImportError: no coal here)" in said


def test_the_page_on_installation():
    """Its commands run, and the lines that it explains are those that set-up says."""
    page = (ROOT / "docs" / "start" / "install.md").read_text()
    commands = "".join(re.findall(r"```bash\n(.*?)```", page, re.DOTALL))
    assert "setup.sh" in commands
    ended = run_to_end("bash", "-ec", commands, cwd=ROOT)
    assert ended.returncode == 0, ended.stderr
    said = "".join((ROOT / "scripts" / name).read_text() for name in ("setup.sh", "packages.py"))
    failures = page[page.index("## When it fails") : page.index("## In a ROS workspace")]
    explained = re.findall(r"^\| `(.*?)` \|", failures, re.MULTILINE)
    assert len(explained) > 5
    for line in explained:
        for part in re.split(r" ?\.\.\.,? ?", line):
            assert part in said, line


def test_the_page_names_the_lowest_versions():
    page = (ROOT / "docs" / "start" / "install.md").read_text()
    source = (ROOT / "scripts" / "packages.py").read_text()
    for label, package in {
        "SciPy": "scipy",
        "Numba": "numba",
        "Pinocchio": "pin",
        "ProxSuite": "proxsuite",
        "DAQP": "daqp",
        "Matplotlib": "matplotlib",
    }.items():
        lowest = re.search(rf'Package\("{package}", "\w+", "([\d.]+)"', source)[1]
        assert re.search(rf"\b{label}\s+{lowest}\b", page), label
