# SPDX-License-Identifier: Apache-2.0
"""PyBullet's functions for one private physics client, without its unrequested output."""

from __future__ import annotations

import ctypes
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_flush = ctypes.CDLL(None).fflush


@contextmanager
def silenced(descriptor: int) -> Iterator[None]:
    """Discard what C code writes to stdout (1) or stderr (2)."""
    _flush(None)  # what waits in C's buffers was written before
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


__all__ = ["BulletClient", "JointInfo", "finite_vector", "pybullet", "silenced"]


def finite_vector(
    name: str, value: ArrayLike, size: int, *, signed: bool = True
) -> NDArray[np.float64]:
    """Return `value` as an array of `size` finite numbers, not negative unless `signed`.

    Raises:
        ValueError: it is not.
    """
    array = np.asarray(value, dtype=float)
    if array.shape != (size,) or not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{name} must be {size} finite numbers, not {value!r}")
    if not signed and np.any(array < 0.0):
        raise ValueError(f"{name} must not be negative: {array}")
    return array


class JointInfo(NamedTuple):
    """A joint as PyBullet numbers and names it."""

    id: int
    name: str
    kind: int  # pybullet.JOINT_REVOLUTE and so on
    link: str  # that it moves


class BulletClient:
    """PyBullet's functions, bound to a private physics client without a window."""

    def __init__(self) -> None:
        self.id: int = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        bound = partial(getattr(pybullet, name), physicsClientId=self.id)
        setattr(self, name, bound)  # found directly from now on
        return bound

    def load_urdf(self, text: str, **options: Any) -> int:
        """Load a robot fixed to the ground; return its body id.

        Args:
            text: of the URDF; PyBullet itself reads files only.
            options: of `pybullet.loadURDF`.
        """
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "robot.urdf"
            path.write_text(text, encoding="utf-8")
            body: int = self.loadURDF(str(path), useFixedBase=True, **options)
            return body

    def joint_infos(self, body: int) -> list[JointInfo]:
        """Return the joints of a body, fixed ones too."""
        infos = [self.getJointInfo(body, i) for i in range(self.getNumJoints(body))]
        return [JointInfo(i[0], i[1].decode(), i[2], i[12].decode()) for i in infos]
