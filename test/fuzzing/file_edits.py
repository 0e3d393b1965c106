# SPDX-License-Identifier: Apache-2.0
"""Changes that make odd YAML files of valid ones: of what they say, and of their text.

A `Edit` says what happens to which value or line; both are counted through the whole file.
`file_edits` is the hypothesis strategy.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import yaml
from fuzzing.edit import Edit, with_values
from hypothesis import strategies as st

VALUES: tuple[Any, ...] = (
    None,
    True,
    "",
    "nobody",
    "true",
    "1e-3",
    "\u0645\U0001f9be",
    math.nan,
    math.inf,
    -math.inf,
    0,
    0.0,
    -1,
    -1.0,
    1e-300,
    1e-9,
    1e-3,
    0.5,
    2.0,
    1e3,
    1e6,
    1e308,
    2**63,
    10**400,
    [],
    [None],
    [[1.0]],
    [1, 2.0],
    {},
    {"a": 1},
)
"""In place of any value."""

NUMBERS = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -1.0,
    1e-9,
    1e308,
    -1e308,
    5e-324,
    1,
    True,
    "x",
    None,
)
"""In place of a number of a list."""

FACTORS = (
    -1.0,
    0.0,
    57.29577951308232,
    1e-6,
    1e-3,
    0.1,
    0.5,
    0.9,
    1.1,
    2.0,
    10.0,
    1e3,
    1e6,
    1e300,
)
"""For numbers, and all numbers of a list."""

TEXTS = (
    "\t",
    "\x00",
    "\ufeff",
    ": ",
    "&a [*a]",
    "*b",
    "!!python/object:os.system {}",
    "---",
    "...",
    "{",
    "]",
    "'",
    "<<: 1",
    "? [a, b]",
    "0x1F",
    "012",
    "1_000",
    "2001-01-01",
    "yes",
    "~",
    "1e-3",
    "1:30",
    ".NaN",
    "\u2028",
)
"""Put into the text."""


class OddFile(NamedTuple):
    """A file that was changed."""

    data: bytes
    names: frozenset[str]
    """Keys that were touched."""


def odd_file(document: Any, edits: Sequence[Edit]) -> OddFile:
    """Return the text of a document after changes; of the document first, then of its text."""
    document, names = copy.deepcopy(document), set()
    for edit in edits:
        if edit.kind in KINDS:
            names.add(KINDS[edit.kind](document, edit))
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=90)
    data = text.encode()
    for edit in edits:
        if edit.kind in TEXT_KINDS:
            data = TEXT_KINDS[edit.kind](data, edit)
    return OddFile(data, frozenset(filter(None, names)))


def file_edits(most: int = 2) -> st.SearchStrategy[tuple[Edit, ...]]:
    """Return a strategy of one to `most` changes; nine of ten are of what a file says."""
    where = st.integers(0, 255)
    of_values = st.one_of(
        with_values(
            where, value=VALUES, number=NUMBERS, scale=FACTORS, length=(0, 1, 3, 6, 8, 24)
        ),
        st.builds(Edit, st.sampled_from(("drop", "rename", "nest", "double", "add")), where),
        st.builds(Edit, st.just("swap"), where, where),
    )
    of_text = st.one_of(
        with_values(where, line=("drop", "twice", "indent"), insert=TEXTS),
        st.builds(Edit, st.just("byte"), where, st.integers(0, 255)),
        st.builds(Edit, st.just("cut"), where),
    )
    one = st.integers(0, 9).flatmap(lambda k: of_text if k == 9 else of_values)
    return st.lists(one, min_size=1, max_size=most).map(tuple)


class _Place(NamedTuple):
    holder: Any
    key: Any

    @property
    def value(self) -> Any:
        return self.holder[self.key]

    def put(self, value: Any) -> None:
        self.holder[self.key] = value


def _places(document: Any) -> list[_Place]:
    """Return all values of mappings, those of inner mappings after their own."""
    found: list[_Place] = []
    if isinstance(document, dict):
        for key in document:
            found.append(_Place(document, key))
            found += _places(document[key])
    elif isinstance(document, list):
        for each in document:
            found += _places(each)
    return found


def _leaves(document: Any) -> list[_Place]:
    return [place for place in _places(document) if not isinstance(place.value, dict)]


def _pick(places: Sequence[_Place], edit: Edit) -> _Place | None:
    return places[edit.where % len(places)] if places else None


def _value(document: Any, edit: Edit) -> str:
    # One in sixteen takes a whole section.
    places = _places(document) if edit.where % 16 == 0 else _leaves(document)
    if place := _pick(places, edit):
        place.put(copy.deepcopy(edit.value))
        return str(place.key)
    return ""


def _lists(document: Any) -> list[_Place]:
    return [place for place in _leaves(document) if isinstance(place.value, list) and place.value]


def _number(document: Any, edit: Edit) -> str:
    if place := _pick(_lists(document), edit):
        place.value[edit.where % len(place.value)] = edit.value
        return str(place.key)
    return ""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _scale(document: Any, edit: Edit) -> str:
    places = [
        place
        for place in _leaves(document)
        if _is_number(place.value)
        or (isinstance(place.value, list) and place.value and all(map(_is_number, place.value)))
    ]
    if place := _pick(places, edit):
        value = place.value
        place.put(
            [_product(each, edit.value) for each in value]
            if isinstance(value, list)
            else _product(value, edit.value)
        )
        return str(place.key)
    return ""


def _product(number: float, factor: float) -> float:
    try:
        return number * factor
    except OverflowError:  # of a whole number
        return math.inf


def _length(document: Any, edit: Edit) -> str:
    if place := _pick(_lists(document), edit):
        place.put((place.value * edit.value)[: edit.value])
        return str(place.key)
    return ""


def _drop(document: Any, edit: Edit) -> str:
    if place := _pick(_leaves(document), edit):
        del place.holder[place.key]
        return str(place.key)
    return ""


def _rename(document: Any, edit: Edit) -> str:
    if place := _pick(_places(document), edit):
        name = f"{place.key}s"
        place.holder[name] = place.holder.pop(place.key)
        return name
    return ""


def _nest(document: Any, edit: Edit) -> str:
    if place := _pick(_leaves(document), edit):
        place.put({str(place.key): place.value})
        return str(place.key)
    return ""


def _double(document: Any, edit: Edit) -> str:
    """Have the first element of a list in the place of the last, too."""
    if place := _pick(_lists(document), edit):
        place.value[-1] = copy.deepcopy(place.value[0])
        return str(place.key)
    return ""


def _add(document: Any, edit: Edit) -> str:
    if place := _pick(_leaves(document), edit):
        place.holder["nobody_knows"] = 1.0
    return "nobody_knows"


def _swap(document: Any, edit: Edit) -> str:
    places = _leaves(document)
    if len(places) < 2:
        return ""
    one = places[edit.where % len(places)]
    other = places[edit.value % len(places)]
    if edit.value % 2:  # lower and upper limits, mostly
        other = places[(edit.where + 1) % len(places)]
    first, second = one.value, other.value
    one.put(second)
    other.put(first)
    return str(one.key)


def _line(data: bytes, edit: Edit) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    k = edit.where % len(lines)
    of = {"drop": [], "twice": [lines[k]] * 2, "indent": [b"  " + lines[k]]}[edit.value]
    return b"".join([*lines[:k], *of, *lines[k + 1 :]])


def _insert(data: bytes, edit: Edit) -> bytes:
    k = _at(data, edit)
    return data[:k] + edit.value.encode() + data[k:]


def _byte(data: bytes, edit: Edit) -> bytes:
    k = _at(data, edit)
    return data[:k] + bytes([edit.value]) + data[k + 1 :]


def _cut(data: bytes, edit: Edit) -> bytes:
    return data[: _at(data, edit)]


def _at(data: bytes, edit: Edit) -> int:
    """Return a place all over the text."""
    return edit.where * 7919 % max(1, len(data))


KINDS: dict[str, Callable[[Any, Edit], str]] = {
    "value": _value,
    "number": _number,
    "scale": _scale,
    "length": _length,
    "drop": _drop,
    "rename": _rename,
    "nest": _nest,
    "double": _double,
    "add": _add,
    "swap": _swap,
}
"""Changes of a document; each returns the key that it touched."""

TEXT_KINDS: dict[str, Callable[[bytes, Edit], bytes]] = {
    "line": _line,
    "insert": _insert,
    "byte": _byte,
    "cut": _cut,
}
"""Changes of a text."""
