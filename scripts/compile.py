# SPDX-License-Identifier: Apache-2.0
"""Compiles ahead what the nodes use, so that no start has to wait for it. Part of `setup.sh`.

The robots of `config/` make a few control steps: each function is compiled for the types that it
is called with, and Numba keeps the results beside the sources. What a robot uses besides is
compiled when its nodes start for the first time.
"""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path

import yaml
from direct import DirectLoop

from viability_bounds_pkg.exceptions import ArmSafetyError

CONFIG = Path(__file__).resolve().parent.parent / "config"


def main() -> None:
    """Play a few steps of each robot; with ``--all`` also beside a wall, by mode of integral."""
    parser = argparse.ArgumentParser(prog="compile.py", description=__doc__)
    parser.add_argument("--all", action="store_true", help="also what these robots do not use")
    options = parser.parse_args()
    for path in sorted(CONFIG.glob("*.yaml")):
        if path.stem == "fr3" and find_spec("franky_sim") is None:
            continue  # its URDF comes with `setup.sh --franka`
        try:
            loop = DirectLoop(path.stem)
            loop.run(2.0 * loop.dt)
        except ArmSafetyError as error:  # a file of the user's; its nodes will say so, too
            print(f"setup: nothing is compiled for {path.name}: {error}", file=sys.stderr)
    (wall,) = yaml.safe_load((CONFIG / "obstacles" / "panda_wall.yaml").read_text()).values()
    for mode in ("joints", "task") if options.all else ():
        loop = DirectLoop("panda", wall["ros__parameters"] | {"integral_action": mode})
        loop.run(2.0 * loop.dt)


if __name__ == "__main__":
    main()
