# SPDX-License-Identifier: Apache-2.0
"""Plants faults in copies of the tree and tells which of them the tests notice.

    python scripts/plant_faults.py                     all of `test/planted_faults.yaml`
    python scripts/plant_faults.py -k integral         those whose line contains a word
    python scripts/plant_faults.py -n 2                so many at a time
    python scripts/plant_faults.py --tree DIRECTORY    in another checkout, set up

Run `source scripts/setup.sh` before. Ends with 1 when a fault is missed, or when its place is not
found exactly once: then the table has to follow the sources. A test that fails has noticed a fault
only if it passes without it.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "test" / "planted_faults.yaml"
PACKAGES = ("viability_bounds_pkg", "torque_safety_controller", "sim_bridge")
COPIED = ("src", "test", "config", "reproduction", "conftest.py", "pyproject.toml", "README.md")
ENDED_BY = "ended by"
MOST_CPU = 180  # s, for each fault; a test that takes it up has noticed the fault

PLUGIN = '''"""What was compiled stays: the fault is in no compiled function."""
import json, os
from viability_bounds_pkg import compiled

digests = json.loads(os.environ["PLANTED_DIGESTS"])
compiled._digest = digests.__getitem__
'''

PLAIN = '''"""Nothing is compiled, which takes longer than most tests of a fault."""
import functools
from viability_bounds_pkg import compiled


def plain(function=None, **options):
    return plain if function is None else function


compiled.compiled = plain
compiled.bound = lambda function, *arguments, numbers=0: functools.partial(function, *arguments)
'''


def sources(tree: Path) -> list[Path]:
    """Return the modules that faults may be in."""
    return [path for name in PACKAGES for path in (tree / "src" / name / name).rglob("*.py")]


def places(tree: Path, fault: dict[str, Any]) -> list[Path]:
    """Return a path for each time that the text to replace is found."""
    return [p for p in sources(tree) for _ in range(p.read_text().count(fault["old"]))]


def tests(tree: Path, fault: dict[str, Any]) -> list[str]:
    """Return the test files of a fault, relative to the tree."""
    names = set(fault["tests"].split())
    found = [*tree.glob("src/*/test/**/*.py"), *tree.glob("test/**/*.py")]
    return sorted(str(path.relative_to(tree)) for path in found if path.name in names)


def in_compiled(tree: Path, fault: dict[str, Any]) -> bool:
    """Return whether a fault is in a file with compiled functions."""
    (path,) = places(tree, fault)
    return "@compiled" in path.read_text()


def run(
    tree: Path,
    fault: dict[str, Any],
    digests: dict[str, str],
    plain: bool = False,
    only: str = "",
) -> tuple[str, str]:
    """Return "caught", "missed" or what went wrong, and by which test.

    Args:
        tree: checkout.
        fault: row of the table.
        digests: by which compiled code is known; none: it is compiled anew.
        plain: compile nothing.
        only: the one test to run; none for all that the row names.
    """
    with tempfile.TemporaryDirectory(prefix="fault_") as directory:
        copy = Path(directory)
        for name in COPIED:
            if (tree / name).is_dir():
                shutil.copytree(tree / name, copy / name)
            else:
                shutil.copy2(tree / name, copy / name)
        (path,) = places(copy, fault)
        text = path.read_text()
        path.write_text(text.replace(fault["old"], fault["new"]))
        paths = [copy, *(copy / "src" / name for name in PACKAGES), copy / "reproduction"]
        paths += [each for each in (copy / "reproduction").iterdir() if each.is_dir()]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([*map(str, paths), os.environ.get("PYTHONPATH", "")]),
            "PLANTED_DIGESTS": json.dumps(digests),
        }
        options = ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", "-m", "not packaging"]
        if plain:
            (copy / "planted.py").write_text(PLAIN)
            options += ["-p", "planted"]
        elif digests and "@compiled" not in text:
            (copy / "planted.py").write_text(PLUGIN)
            options += ["-p", "planted"]
        chosen = [only] if only else tests(tree, fault)
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, *chosen],
            cwd=copy,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        resource.prlimit(process.pid, resource.RLIMIT_CPU, (MOST_CPU, MOST_CPU))
        printed, _ = process.communicate()
        if process.returncode < 0:
            return "caught", f"{ENDED_BY} {signal.Signals(-process.returncode).name}"
        if process.returncode == 0:
            return "missed", ""
        by = re.search(r"^FAILED (\S+::\w+)", printed, re.MULTILINE)
        if by is None:
            return "not run", printed[-300:]
        return "caught", by[1]


def judge(tree: Path, fault: dict[str, Any], digests: dict[str, str]) -> tuple[str, str]:
    """Return what becomes of a fault, as `run` does, or "not told": its test fails without it."""
    sound = fault | {"new": fault["old"]}
    for plain in (True, False) if in_compiled(tree, fault) else (False,):
        outcome, by = run(tree, fault, digests, plain)
        if outcome != "caught":
            continue
        if by.startswith(ENDED_BY):
            if plain:  # which takes long without a fault, too
                continue
            return outcome, by
        if run(tree, sound, digests, plain, by)[0] == "missed":
            return outcome, by.rpartition("/")[2]
        outcome, by = "not told", f"{by} fails without it"
    return outcome, by


def main() -> int:
    """Plant faults, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-k", default="", help="only faults that contain this word")
    parser.add_argument("-n", type=int, default=1, help="faults at a time")
    parser.add_argument("--tree", type=Path, default=ROOT, help="checkout to plant them in")
    options = parser.parse_args()
    tree = options.tree.resolve()
    faults = [fault for fault in yaml.safe_load(TABLE.read_text()) if options.k in str(fault)]
    lost = [f for f in faults if len(places(tree, f)) != 1 or not tests(tree, f)]
    for fault in lost:
        print(f"{len(places(tree, fault))} places, {len(tests(tree, fault))} tests: {fault}")
    digests = {}
    if tree == ROOT:
        from viability_bounds_pkg.compiled import _digest

        digests = {name: _digest(name) for name in PACKAGES}
    outcomes: list[str] = []
    found = [fault for fault in faults if fault not in lost]
    with ThreadPoolExecutor(options.n) as pool:
        results = pool.map(lambda fault: judge(tree, fault, digests), found)
        for fault, (outcome, by) in zip(found, results, strict=True):
            outcomes.append(outcome)
            (path,) = places(tree, fault)
            print(f"{outcome:8}{path.stem:26}{fault['what']:62}{by}", flush=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    caught = outcomes.count("caught")
    minutes = (used.ru_utime + used.ru_stime) / 60.0
    print(f"{caught} of {len(faults)} caught, {minutes:.0f} min of CPU")
    return int(caught < len(faults))


if __name__ == "__main__":
    sys.exit(main())
