# SPDX-License-Identifier: Apache-2.0
"""Programs to compare with, in environments of their own: their wheels need other versions.

An environment is made when it is missing. Data goes there and back in npz files; then the program
is asked for times, a block for each question, so that both sides are measured in turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
TSID = (".venv-tsid", ("tsid==1.7.1", "pin==3.4.*", "cmeel-urdfdom==4.*", "cmeel-tinyxml2==10.*"))
"""What works together: the wheels do not say which URDF and XML libraries they were built for."""
PLACO = (".venv-placo", ("placo==0.10.2",))

Arrays = dict[str, np.ndarray]
Ask = Callable[[], tuple[float, ...]]


@contextmanager
def worker(
    environment: tuple[str, Sequence[str]], given: Arrays, *words: str
) -> Iterator[tuple[Arrays, Ask]]:
    """Run a program on arrays; yield what it found, and a function that lets it time a block.

    Args:
        environment: name of the folder, and what pip installs into it.
        given: the input of `rival_worker.py`.
        words: its task and the name of the rival.
    """
    python = _interpreter(*environment)
    with tempfile.TemporaryDirectory() as directory:
        source, target = (str(Path(directory) / name) for name in ("in.npz", "out.npz"))
        np.savez(source, **given)
        # Not our packages, nor a Pinocchio that ROS may have brought.
        clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "LD_LIBRARY_PATH")}
        process = subprocess.Popen(
            [python, str(ROOT / "benchmarks" / "rival_worker.py"), source, target, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=clean,
        )
        assert process.stdin is not None and process.stdout is not None

        def ask() -> tuple[float, ...]:
            process.stdin.write("\n")
            process.stdin.flush()
            return tuple(float(word) for word in process.stdout.readline().split())

        try:
            if process.stdout.readline() != "ready\n":
                sys.exit(f"{words} failed; remove {environment[0]} to have it made again")
            with np.load(target) as found:
                yield dict(found), ask
        finally:
            process.stdin.close()
            process.wait()


def _interpreter(name: str, requirements: Sequence[str]) -> str:
    """Return the interpreter of an environment, after making it if need be."""
    folder = ROOT / name
    python, stamp = folder / "bin" / "python", folder / ".installed"
    wanted = "\n".join((*requirements, sys.version))
    if not stamp.exists() or stamp.read_text() != wanted:
        print(f"installing {requirements[0]} into {name}", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        pip += ["--only-binary", ":all:"]
        if subprocess.run([*pip, *requirements], check=False).returncode != 0:
            sys.exit(f"{requirements[0]} cannot be installed here: there are wheels for some only")
        stamp.write_text(wanted)
    return str(python)
