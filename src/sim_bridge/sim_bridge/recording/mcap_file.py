# SPDX-License-Identifier: Apache-2.0
"""Writes serialized messages to an MCAP file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.writer import Writer

from sim_bridge.recording.message_definition import message_definition


class McapFile:
    """An MCAP file that is being written; `close` completes it.

    Args:
        path: of the file; one that is there is replaced.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="ros2")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}

    def add_topic(self, topic: str, kind: Any) -> None:
        """Declare a topic.

        Args:
            topic: its name.
            kind: class of its messages.
        """
        name, definition = message_definition(kind)
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(
                name, "ros2msg", definition.encode()
            )
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[name])
        self._counts[topic] = 0

    def write(self, topic: str, message: bytes, stamp: int) -> None:
        """Add a message.

        Args:
            topic: declared before.
            message: serialized (CDR).
            stamp: when it was sent, ns.
        """
        self._writer.add_message(
            self._channels[topic],
            log_time=stamp,
            publish_time=stamp,
            sequence=self._counts[topic],
            data=message,
        )
        self._counts[topic] += 1

    def close(self) -> None:
        """Complete the file: without its end it can be read only in part."""
        self._writer.finish()
        self._file.close()
