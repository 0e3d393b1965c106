"""Compiled code kept between runs, and never older than its source.

Numba caches a compiled function until the file with its definition changes; that a function which
it calls, in another file, has changed it does not notice. So all that is cached goes when any of
the sources has changed.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

import numba

_RECORD = "compiled.sha256"


def keep_compiled(*packages: str) -> bool:
    """Drop what was compiled from other sources, before anything of a package is compiled.

    Args:
        packages: directories whose files the last one's functions may call. The cache is beside
            its sources, or in ``NUMBA_CACHE_DIR`` if that is set, or, if it cannot be written
            there, in the user's cache directory.

    Returns:
        Whether nothing is left, so that all that is used has to be compiled.
    """
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(Path(package).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    state = digest.hexdigest()[:16]
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    if elsewhere:
        numba.config.CACHE_DIR = str(Path(elsewhere) / state)
        return not (Path(elsewhere) / state).exists()
    cache = Path(packages[-1]) / "__pycache__"
    record = cache / _RECORD
    try:
        if record.exists() and record.read_text() == state:
            return False
        cache.mkdir(exist_ok=True)
        for pattern in ("*.nbi", "*.nbc"):
            for path in cache.glob(pattern):
                with suppress(FileNotFoundError):  # another process does the same
                    path.unlink()
        record.write_text(state)
    except OSError:
        directory = Path.home() / ".cache" / "viability_bounds" / state
        numba.config.CACHE_DIR = str(directory)
        return not directory.exists()
    return True
