# SPDX-License-Identifier: Apache-2.0
"""Set-up compiles everything, so that neither starts of nodes nor control steps have to."""

import os
import sys
from pathlib import Path

import pytest
import yaml

from viability_bounds_pkg.testing.executables import run_to_end

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config"
PACKAGES = ("viability_bounds_pkg", "torque_safety_controller", "sim_bridge")
OBSTACLES = yaml.safe_load((CONFIG / "obstacles" / "panda_wall.yaml").read_text())

NOT_KEPT = """
import importlib, pkgutil, runpy, sys
from viability_bounds_pkg.compiled import compiled_functions, is_kept

runpy.run_path("scripts/compile.py")["compile_all"]()
for name in sys.argv[1:]:
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, f"{name}."):
        if not module.name.endswith(".moveit_node"):  # its messages may not be there
            importlib.import_module(module.name)
assert len(compiled_functions()) > 20
for function in compiled_functions():
    if not is_kept(function):
        print(function)
"""

COMPILED_BY_NODES = """
import runpy, sys, yaml
from chain import load_values, run_chain
from viability_bounds_pkg.compiled import compiled_functions

runpy.run_path("scripts/compile.py")["compile_all"]()
# What other programs have left does not count.
ahead = {function: set(function.overloads) for function in compiled_functions()}
for robot, changes in yaml.safe_load(sys.argv[1]):
    run_chain(load_values(robot) | changes, {"duration": 0.02, "events": []}, {})
for function in compiled_functions():
    for types in set(function.overloads) - ahead.get(function, set()):
        print(function, *types)
"""

PLAYED = [
    ["baxter_left_arm", {}],
    ["panda", {}],
    ["talos_left_arm", {}],
    ["baxter_left_arm", {"integral_action": "task"}],
    ["panda", OBSTACLES["/**/controller_node"]["ros__parameters"]],
]


def run(*arguments):
    paths = [*(ROOT / "src" / name for name in PACKAGES), ROOT / "reproduction"]
    result = run_to_end(
        *(sys.executable, *arguments),
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, [*paths, *sys.path]))},
        timeout=None,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


@pytest.fixture(scope="module")
def not_kept():
    """Do what setup.sh does, nothing if it was done; return what is not kept then."""
    return run("-c", NOT_KEPT, *PACKAGES)


def test_every_compiled_function_is_kept(not_kept):
    assert not_kept == ""


def test_nodes_compile_nothing():
    assert run("-c", COMPILED_BY_NODES, yaml.safe_dump(PLAYED)) == ""


def test_a_file_that_is_wrong_is_told_and_the_others_are_compiled(tmp_path):
    (tmp_path / "obstacles").mkdir()
    (tmp_path / "obstacles" / "panda_wall.yaml").write_text(yaml.safe_dump(OBSTACLES))
    (tmp_path / "panda.yaml").write_text("nonsense: 3")  # the file of this name is played then
    (tmp_path / "none_such.yaml").write_text("nonsense: 3")
    code = "import sys, pathlib, compile as c; c.CONFIG = pathlib.Path(sys.argv[1]); c.main([])"
    done = run_to_end(
        *(sys.executable, "-c", code, tmp_path),
        cwd=ROOT / "scripts",
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join(map(str, [ROOT / "reproduction", *sys.path]))},
        timeout=None,
    )
    assert done.returncode == 0
    assert "setup: nothing is compiled for none_such.yaml: " in done.stderr
    assert "panda" not in done.stderr
