# SPDX-License-Identifier: Apache-2.0
"""Writes serialized messages to an MCAP file, with the definitions of their types.

The definitions are made from the Python classes, because the .msg files are elsewhere in each
installation. Comments, constants and defaults are not in them; readers need the fields alone.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from mcap.writer import Writer

_PRIMITIVES = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}
"""Where the names of the interface definition language differ from those of .msg files."""

_RULE = "=" * 80


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


def message_definition(kind: Any) -> tuple[str, str]:
    """Return name and definition of a message type.

    Args:
        kind: its class.

    Returns:
        Its name, as in ``sensor_msgs/msg/JointState``, and its fields, with those of all types in
        it, in the format of ``ros2msg``.
    """
    texts: dict[str, str] = {}
    name = _name(kind)
    _describe(kind, texts)
    text = texts.pop(name)
    for each, fields in texts.items():
        text += f"{_RULE}\nMSG: {each.replace('/msg/', '/')}\n{fields}"
    return name, text


def _name(kind: Any) -> str:
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def _describe(kind: Any, texts: dict[str, str]) -> None:
    """Add the fields of a type, and of those in it, to `texts`."""
    if (name := _name(kind)) in texts:
        return
    texts[name] = ""
    for field, written in kind.get_fields_and_field_types().items():
        element, length = _split(written)
        if "/" in element:
            package, inner = element.split("/")
            _describe(getattr(import_module(f"{package}.msg"), inner), texts)
        texts[name] += f"{_PRIMITIVES.get(element, element)}{length} {field}\n"


def _split(written: str) -> tuple[str, str]:
    """Return the type of an element, and its number in brackets, empty if it is one alone."""
    if found := re.fullmatch(r"sequence<(.*?)(?:, (\d+))?>", written):
        return _unbounded(found[1]), f"[<={found[2]}]" if found[2] else "[]"
    if found := re.fullmatch(r"(.*)\[(\d+)\]", written):
        return _unbounded(found[1]), f"[{found[2]}]"
    return _unbounded(written), ""


def _unbounded(element: str) -> str:
    """Return the type of a string with a bound in the form of .msg files."""
    return re.sub(r"string<(\d+)>", r"string<=\1", element)
