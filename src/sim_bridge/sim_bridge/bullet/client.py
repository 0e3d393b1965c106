"""PyBullet's functions for one world of one's own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from sim_bridge.bullet.quiet_pybullet import pybullet


class BulletClient:
    """PyBullet's functions, bound to a private physics client without a window."""

    def __init__(self) -> None:
        self.id = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        bound = partial(getattr(pybullet, name), physicsClientId=self.id)
        setattr(self, name, bound)  # found directly from now on
        return bound
