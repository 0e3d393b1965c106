"""Compiled code kept between runs, and never older than its source.

Numba caches a compiled function until the file with its definition changes; that a function which
it calls, in another file, has changed it does not notice. Here every state of the sources has a
cache of its own.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from contextlib import suppress
from pathlib import Path

import numba

_KEPT = 7 * 86_400.0  # s; caches of other states of the sources


def keep_compiled(*packages: str) -> None:
    """Let functions that are compiled from now on be cached for the sources as they are.

    Args:
        packages: directories whose files such functions may call. The cache is in the last, or
            in ``NUMBA_CACHE_DIR`` if that is set, or, if it cannot be written to, where Numba
            puts it.
    """
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(Path(package).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    given = os.environ.get("NUMBA_CACHE_DIR")
    root = Path(given) if given else Path(packages[-1]) / "__pycache__" / "compiled"
    chosen = root / digest.hexdigest()[:16]
    with suppress(OSError):
        chosen.mkdir(parents=True, exist_ok=True)
        chosen.touch()
        for other in () if given else root.iterdir():
            if time.time() - other.stat().st_mtime > _KEPT:
                shutil.rmtree(other, ignore_errors=True)
        numba.config.CACHE_DIR = str(chosen)
