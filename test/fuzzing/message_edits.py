# SPDX-License-Identifier: Apache-2.0
"""Changes that make odd messages of valid ones, for messages of any type.

An `Edit` says what happens to which part of a message; parts are counted through the whole
message, so that the same edit fits every type. `edits` is the hypothesis strategy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

from fuzzing.edit import Edit, with_values
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

NUMBERS = (
    math.nan,
    math.inf,
    -math.inf,
    1e308,
    -1e308,
    1.7976931348623157e308,
    1e300,
    5e-324,
    -5e-324,
    1e-300,
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-9,
    1e6,
    -1e6,
    1e12,
    57.29577951308232,
    2.0**53,
)
"""For fields of floats."""

FACTORS = (57.29577951308232, 0.017453292519943295, -1.0, 0.0, 1e3, 1e300, 1e-300, 1.0 + 1e-12)
"""For all numbers of a list: degrees for radians first."""

NO_UTF8 = "\ufffd\ufffd"
"""Stands in a name for bytes that are no UTF-8, see `to_bytes`."""

NAMES = (
    "",
    " ",
    "nobody",
    "panda_joint1",
    "panda_hand",
    "panda_link0",
    "world",
    "/",
    "..",
    "%s%n{}{0}",
    "\n\x1b[31m",
    "\u0645\u0641\u0635\u0644",
    "\U0001f9be",
    "a\u0301",
    f"joint{NO_UTF8}",
    "x" * 5000,
)
"""For fields of strings."""

SIZES = (0, 1, 2, 3, 6, 8, 13, 14, 3000)
"""For lists."""

TIMES = (
    0,
    1,
    -1,
    -1_000_000,
    1_000_000,
    2_000_000,
    -400_000_000,
    400_000_000,
    3_000_000_000,
    -3_000_000_000,
    3_600_000_000_000,
)
"""By how much stamps leap, ns."""

STAMPS = (
    (0, 0),
    (-1, 999_999_999),
    (-5, 0),
    (-(2**31), 0),
    (2**31 - 1, 2**32 - 1),
    (1, 2**32 - 1),
)
"""Seconds and nanoseconds of stamps that say nothing, or more than a clock does."""

WHOLE = (0, 1, 2, 3, 5, -1, 255, 2**31 - 1, -(2**31), 2**32 - 1)
"""For fields of integers, as far as they hold them."""

_INTEGER = re.compile(r"(u?)int(\d+)")
_LIST = re.compile(r"(?:sequence<(?P<of>[^,]+)(?:, \d+)?>|(?P<of_array>[^\[]+)\[\d+\])")


class _Part(NamedTuple):
    """A field of a message or of one that is in it."""

    holder: Any
    name: str
    type: str
    """Of its elements where it is a list, as in ``get_fields_and_field_types``."""
    is_list: bool
    fixed: bool
    """Whether it is a list that cannot change its length."""

    @property
    def value(self) -> Any:
        return getattr(self.holder, self.name)

    def put(self, value: Any) -> None:
        setattr(self.holder, self.name, value)


def edited(message: Any, changes: Sequence[Edit]) -> Any:
    """Return a copy of a message with changes; those that fit no part of it change nothing."""
    copy = deserialize_message(serialize_message(message), type(message))
    for change in changes:
        KINDS[change.kind](list(_parts(copy)), change)
    return copy


def to_bytes(message: Any) -> bytes:
    """Return what DDS carries; where `NO_UTF8` stands in a name, bytes that are no UTF-8."""
    return bytes(serialize_message(message)).replace(NO_UTF8.encode(), b"\xff\xfe\x80\xc3\x28\xff")


def edits(most: int = 3) -> st.SearchStrategy[tuple[Edit, ...]]:
    """Return a strategy of up to `most` changes; none at all is one of the examples."""
    where = st.integers(0, 63)
    one = st.one_of(
        with_values(where, number=NUMBERS, scale=FACTORS, size=SIZES),
        st.builds(Edit, st.just("swap"), where, st.integers(0, 40)),
        st.builds(Edit, st.just("double"), where),
        with_values(where, text=NAMES, whole=WHOLE, leap=TIMES, stamp=STAMPS),
    )
    return st.lists(one, max_size=most).map(tuple)


def _parts(message: Any) -> Iterator[_Part]:
    kind: Any = type(message)
    for name, of, is_list, fixed, nested in _schema(kind):
        yield _Part(message, name, of, is_list, fixed)
        if nested:
            value = getattr(message, name)
            for each in value if is_list else (value,):
                yield from _parts(each)


@cache
def _schema(kind: type) -> tuple[tuple[str, str, bool, bool, bool], ...]:
    """Return of each field: name, type, whether it is a list, of fixed length, of messages."""
    rows = []
    for name, text in kind.get_fields_and_field_types().items():  # type: ignore[attr-defined]
        if found := _LIST.fullmatch(text):
            of = found["of"] or found["of_array"]
            rows.append((name, of, True, found["of"] is None, "/" in of))
        else:
            rows.append((name, text, False, False, "/" in text))
    return tuple(rows)


def _chosen(found: Sequence[Any], change: Edit) -> Any:
    return found[change.where % len(found)] if found else None


def _is_number(part: _Part) -> bool:
    return part.type in ("double", "float")


def _number(parts: list[_Part], change: Edit) -> None:
    places = [
        (part, index)
        for part in parts
        if _is_number(part)
        for index in range(len(part.value) if part.is_list else 1)
    ]
    if place := _chosen(places, change):
        part, index = place
        if not part.is_list:
            part.put(change.value)
        else:
            part.value[index] = change.value


def _scale(parts: list[_Part], change: Edit) -> None:
    if part := _chosen([part for part in parts if _is_number(part)], change):
        if not part.is_list:
            part.put(part.value * change.value)
        elif part.fixed:
            part.value[:] = part.value * change.value
        else:
            part.put([each * change.value for each in part.value])


def _size(parts: list[_Part], change: Edit) -> None:
    if part := _chosen([part for part in parts if part.is_list and not part.fixed], change):
        values = list(part.value)
        repeats = -(-change.value // len(values)) if values else 0
        part.put((values * repeats)[: change.value])


def _swap(parts: list[_Part], change: Edit) -> None:
    """Exchange two neighbours."""
    if part := _chosen([part for part in parts if part.is_list and len(part.value) > 1], change):
        values = list(part.value)
        k = change.value % (len(values) - 1)
        values[k], values[k + 1] = values[k + 1], values[k]
        part.value[:] = type(part.value)("d", values) if _typed(part.value) else values


def _typed(values: Any) -> bool:
    return type(values).__name__ == "array"


def _double(parts: list[_Part], change: Edit) -> None:
    """Have the first element in the place of the last, too."""
    if part := _chosen([part for part in parts if part.is_list and len(part.value) > 1], change):
        part.value[-1] = part.value[0]


def _text(parts: list[_Part], change: Edit) -> None:
    places = [
        (part, index)
        for part in parts
        if part.type == "string"
        for index in range(len(part.value) if part.is_list else 1)
    ]
    if place := _chosen(places, change):
        part, index = place
        if part.is_list:
            part.value[index] = change.value
        else:
            part.put(change.value)


def _whole(parts: list[_Part], change: Edit) -> None:
    if part := _chosen(
        [part for part in parts if not part.is_list and _INTEGER.fullmatch(part.type)], change
    ):
        unsigned, bits = _INTEGER.fullmatch(part.type).groups()  # type: ignore[union-attr]
        size = 2 ** int(bits)
        low, high = (0, size - 1) if unsigned else (-size // 2, size // 2 - 1)
        part.put(min(max(change.value, low), high))


def _times(parts: list[_Part]) -> list[Any]:
    return [part.value for part in parts if part.type.startswith("builtin_interfaces/")]


def _leap(parts: list[_Part], change: Edit) -> None:
    if time := _chosen(_times(parts), change):
        total = max(0, time.sec * 10**9 + time.nanosec + change.value)
        time.sec, time.nanosec = min(total // 10**9, 2**31 - 1), total % 10**9


def _stamp(parts: list[_Part], change: Edit) -> None:
    if time := _chosen(_times(parts), change):
        time.sec, time.nanosec = change.value


KINDS: dict[str, Callable[[list[_Part], Edit], None]] = {
    "number": _number,
    "scale": _scale,
    "size": _size,
    "swap": _swap,
    "double": _double,
    "text": _text,
    "whole": _whole,
    "leap": _leap,
    "stamp": _stamp,
}
"""What `Edit.kind` may be."""
