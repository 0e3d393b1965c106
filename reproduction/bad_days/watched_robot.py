# SPDX-License-Identifier: Apache-2.0
"""The simulated robot, telling of each state what moved it, at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.nodes.bullet_node import BulletNode

STOPS = "stopping", "stopped", "brakes"
"""What `BulletNode` says of itself when no command moves it."""


class WatchedRobot(BulletNode):
    """A robot whose states are seen as they are made.

    Messages are read later: where it has stopped itself for one period it may go on again by then.

    Args:
        seen: takes the stamp of a state, s, whether the robot stopped itself in the period before
            it, and the torques that its motors gave, shape (n,), N m.
        node_arguments: of the node.
    """

    def __init__(
        self, seen: Callable[[float, bool, NDArray[np.float64]], None], **node_arguments: Any
    ) -> None:
        self._seen = seen
        super().__init__(**node_arguments)

    def _next_state(self) -> None:
        stamp = 1e-9 * (self._stamp + self._dt_ns)
        self._seen(stamp, self._control() in STOPS, self._robot.state().motor_torque)
        super()._next_state()
