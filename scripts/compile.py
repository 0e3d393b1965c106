# SPDX-License-Identifier: Apache-2.0
"""Compiles ahead what the nodes and tools use, so that no start has to wait for it.

Part of `setup.sh`. The robots of `config/` play a few control steps with everything switched on:
each function is compiled for the types it is called with there, and Numba keeps the results. What
is kept from the same sources is not compiled again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import yaml
from direct import DirectLoop

from sim_bridge.bullet.obstacles import Obstacle
from torque_safety_controller.anti_windup import project_to_limits
from viability_bounds_pkg.cli.command_line import INTERRUPTED
from viability_bounds_pkg.compiled import compilations, compiled_functions, is_kept
from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError

CONFIG = Path(__file__).resolve().parent.parent / "config"
TABLE = Obstacle("table", "box", (0.2, 0.6, 0.1), (0.30702, 0.0, 0.42237), (0.0, 0.0, 0.0, 1.0))
"""5 mm below Panda's fingertips at its start."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile everything, and say how far it is; return the exit code, 130 after SIGINT."""
    argparse.ArgumentParser(
        prog="compile.py", description=(__doc__ or "").splitlines()[0]
    ).parse_args(arguments)
    try:
        compile_all()
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


def compile_all() -> None:
    """Let each function be called with the types that it has in use."""
    (wall,) = yaml.safe_load((CONFIG / "obstacles" / "panda_wall.yaml").read_text()).values()
    with progress():
        for path in sorted(CONFIG.glob("*.yaml")):
            try:
                play(path.stem, {})
            except ArmSafetyError as error:  # a file of the user's; its nodes will say so, too
                print(f"setup: nothing is compiled for {path.name}: {error}", file=sys.stderr)
        play("panda", wall["ros__parameters"])
        touch()
        project_to_limits(np.zeros(1), np.zeros(1), np.ones(1))


def play(robot: str, changes: dict[str, Any]) -> None:
    """Play some control steps with each kind of integral action."""
    loop = DirectLoop(robot, changes)
    for mode in ("joints", "task", "none"):
        with suppress(SettingError):  # six joints have no null space left of the task
            loop.change(integral_action=mode)
            loop.run(2.0 * loop.dt)


def touch() -> None:
    """Let an arm without torque fall on a table."""
    loop = DirectLoop("panda")
    loop.robot.obstacles.add(TABLE)
    for _ in range(100):
        loop.robot.step(np.zeros(loop.model.nv), loop.config.substeps)


@contextmanager
def progress() -> Iterator[None]:
    """Show on stderr how many functions are compiled."""
    functions, done = compiled_functions(), Event()
    terminal = sys.stderr.isatty()

    def show() -> None:
        # Lines that overwrite each other, or few.
        while not done.wait(0.2 if terminal else 5.0):
            if compilations():
                text = f"setup: compiling {sum(map(is_kept, functions))} of {len(functions)} ..."
                print(text, end="\r" if terminal else "\n", file=sys.stderr, flush=True)

    thread = Thread(target=show)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        if compilations():
            print(f"setup: compiled {compilations()} functions      ", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
