# SPDX-License-Identifier: Apache-2.0
"""Loads from the topic ``payload``, for the model of a node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

from geometry_msgs.msg import InertiaStamped

from viability_bounds_pkg.robot.payload import Payload, PayloadError
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.topics import PAYLOAD


class PayloadSubscriber:
    """Subscribes to ``payload``; what came last counts, also when its publisher has gone.

    Args:
        node: listens, and logs what is refused.
        payload: of the node's model.
        changed: called when the arm carries another load than before.

    Attributes:
        payload: as given.
        refused: how many messages were refused, by what of them is wrong.
    """

    def __init__(
        self, node: ArmNode, payload: Payload, changed: Callable[[], object] | None = None
    ) -> None:
        self.payload, self._changed = payload, changed
        self._watch, self._logger = node.publisher_watch, node.get_logger()
        self._topic = node.resolve_topic_name(PAYLOAD.name)
        self.refused: Counter[str] = Counter()
        self._watch.add(self._topic)
        PAYLOAD.subscription(node, self._on_payload, partial(self._refuse, "quality of service"))

    def _on_payload(self, message: InertiaStamped) -> None:
        if not self._watch.admits(self._topic):
            self._refuse("several publishers", f"several nodes publish '{self._topic}'")
            return
        body = message.inertia
        centre = body.com.x, body.com.y, body.com.z
        moments = (
            (body.ixx, body.ixy, body.ixz),
            (body.ixy, body.iyy, body.iyz),
            (body.ixz, body.iyz, body.izz),
        )
        try:
            changed = self.payload.carry(message.header.frame_id, body.m, centre, moments)
        except PayloadError as error:
            self._refuse(error.kind, str(error))
            return
        if changed and self._changed is not None:
            self._changed()

    def _refuse(self, kind: str, reason: str) -> None:
        self.refused[kind] += 1
        # Where the same is sent again and again, one line a second.
        self._logger.warning(f"payload refused: {reason}", throttle_duration_sec=1.0)
