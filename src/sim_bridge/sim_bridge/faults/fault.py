# SPDX-License-Identifier: Apache-2.0
"""The kinds of faults: what each does to the messages that pass while it lasts."""

from __future__ import annotations

import dataclasses
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from sim_bridge.faults.message_values import (
    FIELDS,
    Array,
    fields_of,
    joints_of,
    rename,
    set_stamp,
    stamp_of,
)
from sim_bridge.scenario.fields import (
    Check,
    name,
    not_negative,
    number,
    positive,
    refuse,
)


class Passage(NamedTuple):
    """A message on its way.

    Attributes:
        message: with what was done to it.
        delay: after which it is sent on, s.
        rival: whether another node than that of the stream sends it.
    """

    message: Any
    delay: float = 0.0
    rival: bool = False


@dataclass(kw_only=True)
class Fault:
    """One fault of one stream of messages.

    Attributes:
        KIND: its name in the timeline.
        FIELDS: the fields of its entry there, each with what checks it; all may be left out that
            have a default here.
        start: when it begins, s of robot time from the first message.
        end: when it ends, s.
    """

    KIND: ClassVar[str]
    FIELDS: ClassVar[dict[str, Check]] = {}

    start: float
    end: float

    def apply(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        """Return what becomes of a message: it may be changed in place, held back, or doubled.

        Args:
            passing: what earlier faults made of it.
            rng: random numbers of the stream.
        """
        return self._spoil(passing, rng)

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        raise NotImplementedError

    def finish(self) -> list[Passage]:
        """Return what was held back when the fault ends."""
        return []


def _share(value: Any, where: str) -> float:
    if number(value, where) < 0.0 or value > 1.0:
        raise refuse(where, value, "a number from 0 to 1")
    return float(value)


def _one_of(*allowed: str) -> Check:
    def check(value: Any, where: str) -> str:
        if value not in allowed:
            raise refuse(where, value, f"one of {', '.join(allowed)}")
        return str(value)

    return check


def _names(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise refuse(where, value, "names of joints")
    return tuple(name(each, f"{where}[{k}]") for k, each in enumerate(value))


def _two_names(value: Any, where: str) -> tuple[str, ...]:
    names = _names(value, where)
    if len(set(names)) != 2 or len(names) != 2:
        raise refuse(where, value, "the names of two joints")
    return names


@dataclass(kw_only=True)
class _AtRandom(Fault):
    """Acts on a message with `probability`."""

    FIELDS = {"probability": _share}
    probability: float = 1.0

    def _acts(self, rng: np.random.Generator) -> bool:
        return rng.random() < self.probability


@dataclass(kw_only=True)
class Drop(_AtRandom):
    """Messages are lost."""

    KIND = "drop"

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        return [] if self._acts(rng) else [passing]


@dataclass(kw_only=True)
class Delay(Fault):
    """Messages come later, and with jitter perhaps in another order."""

    KIND = "delay"
    FIELDS = {"delay": not_negative, "jitter": not_negative}
    delay: float = 0.0
    jitter: float = 0.0

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        later = self.delay + self.jitter * rng.random()
        return [passing._replace(delay=passing.delay + later)]


@dataclass(kw_only=True)
class Duplicate(_AtRandom):
    """Messages come twice."""

    KIND = "duplicate"

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        if self._acts(rng):
            return [passing, passing._replace(message=deepcopy(passing.message))]
        return [passing]


@dataclass(kw_only=True)
class _Holding(Fault):
    """Messages may be held back."""

    _held: list[Passage] = dataclasses.field(default_factory=list)

    def finish(self) -> list[Passage]:
        """Return what was held back."""
        held, self._held = self._held, []
        return held


@dataclass(kw_only=True)
class Reorder(_AtRandom, _Holding):
    """A message comes after the one that follows it."""

    KIND = "reorder"

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        if self._held:
            return [passing, self._held.pop()]
        if self._acts(rng):
            self._held.append(passing)
            return []
        return [passing]


@dataclass(kw_only=True)
class Burst(_Holding):
    """Messages are held back, and come all at once when the fault ends."""

    KIND = "burst"

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        self._held.append(passing)
        return []


@dataclass(kw_only=True)
class Stamp(Fault):
    """Stamps leap by `offset`, s."""

    KIND = "stamp"
    FIELDS = {"offset": number}
    offset: float

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        set_stamp(passing.message, stamp_of(passing.message) + round(1e9 * self.offset))
        return [passing]


@dataclass(kw_only=True)
class _Values(Fault):
    """Numbers of a message change: of one field or all, of some joints or all."""

    FIELDS = {"field": _one_of(*FIELDS), "joints": _names}
    field: str = ""
    joints: tuple[str, ...] = ()

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        names = joints_of(passing.message)
        where = np.array([not self.joints or each in self.joints for each in names], bool)
        for k, (kind, values, put) in enumerate(fields_of(passing.message)):
            if self.field in ("", kind):
                chosen = where if where.size == values.size else np.ones(values.size, bool)
                put(np.where(chosen, self._changed(values, k, rng), values))
        return [passing]

    def _changed(self, values: Array, which: int, rng: np.random.Generator) -> Array:
        """Return what becomes of the numbers of a field, the `which`-th of the message."""
        raise NotImplementedError


@dataclass(kw_only=True)
class Freeze(_Values):
    """Numbers stay as they were when the fault began; stamps go on."""

    KIND = "freeze"
    _first: dict[int, Array] = dataclasses.field(default_factory=dict)

    def _changed(self, values: Array, which: int, rng: np.random.Generator) -> Array:
        first = self._first.setdefault(which, values)
        return first if first.size == values.size else values

    def finish(self) -> list[Passage]:
        """Forget the numbers."""
        self._first = {}
        return []


@dataclass(kw_only=True)
class Noise(_Values):
    """Normal noise, `deviation` in the units of the field, is added."""

    KIND = "noise"
    FIELDS = {**_Values.FIELDS, "deviation": positive}
    deviation: float

    def _changed(self, values: Array, which: int, rng: np.random.Generator) -> Array:
        return values + self.deviation * rng.standard_normal(values.size)


@dataclass(kw_only=True)
class Bias(_Values):
    """`offset`, in the units of the field, is added."""

    KIND = "bias"
    FIELDS = {**_Values.FIELDS, "offset": number}
    offset: float

    def _changed(self, values: Array, which: int, rng: np.random.Generator) -> Array:
        return values + self.offset


@dataclass(kw_only=True)
class Scale(_Values):
    """Numbers are multiplied, as by 57.3 where degrees are sent for radians."""

    KIND = "scale"
    FIELDS = {**_Values.FIELDS, "factor": number}
    factor: float

    def _changed(self, values: Array, which: int, rng: np.random.Generator) -> Array:
        return values * self.factor


@dataclass(kw_only=True)
class Swap(Fault):
    """The numbers of two joints are exchanged."""

    KIND = "swap"
    FIELDS = {"joints": _two_names}
    joints: tuple[str, ...]

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        names = joints_of(passing.message)
        if set(self.joints) <= set(names):
            i, j = map(names.index, self.joints)
            for _, values, put in fields_of(passing.message):
                if values.size == len(names):
                    values[[i, j]] = values[[j, i]]
                    put(values)
        return [passing]


@dataclass(kw_only=True)
class Corrupt(_AtRandom, _Values):
    """A message becomes one that no sender means.

    Attributes:
        how: numbers become ``nan``, ``inf`` or ``huge`` (1e300), the last is missing (``short``; a
            wrench always has six), or the ``names`` of the joints, or of its frame, are others.
    """

    KIND = "corrupt"
    FIELDS = {
        **_Values.FIELDS,
        "how": _one_of("nan", "inf", "huge", "short", "names"),
        **_AtRandom.FIELDS,
    }
    how: str = "nan"

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        if not self._acts(rng):
            return [passing]
        message = passing.message
        if self.how == "names":
            rename(message)
            return [passing]
        if self.how == "short":
            for kind, values, put in fields_of(message):
                if self.field in ("", kind):
                    put(values[:-1])
            return [passing]
        return super()._spoil(passing, rng)

    def _changed(self, values: Array, which: int, rng: np.random.Generator) -> Array:
        return np.full(values.size, {"nan": np.nan, "inf": np.inf, "huge": 1e300}[self.how])


@dataclass(kw_only=True)
class Rival(Bias):
    """Another node sends each message, too, with `offset` added."""

    KIND = "rival"

    def _spoil(self, passing: Passage, rng: np.random.Generator) -> list[Passage]:
        (other,) = super()._spoil(passing._replace(message=deepcopy(passing.message)), rng)
        return [passing, other._replace(rival=True)]


FAULTS: dict[str, type[Fault]] = {
    kind.KIND: kind
    for kind in (
        Drop,
        Delay,
        Duplicate,
        Reorder,
        Burst,
        Stamp,
        Freeze,
        Noise,
        Bias,
        Scale,
        Swap,
        Corrupt,
        Rival,
    )
}
"""By name in the timeline."""
