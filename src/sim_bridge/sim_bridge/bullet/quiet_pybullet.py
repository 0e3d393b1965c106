"""PyBullet, without what it prints unasked."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

_flush = ctypes.CDLL(None).fflush


@contextmanager
def silenced(descriptor: int) -> Iterator[None]:
    """Send what C code writes to stdout (1) or stderr (2) nowhere."""
    _flush(None)  # what waits in C's buffers was meant to be seen
    kept = os.dup(descriptor)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, descriptor)
        yield
    finally:
        _flush(None)
        os.dup2(kept, descriptor)
        os.close(kept)
        os.close(nowhere)


with silenced(2):
    import pybullet

__all__ = ["pybullet", "silenced"]
