# SPDX-License-Identifier: Apache-2.0
"""Faults over time, read from YAML."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from sim_bridge.faults.fault import FAULTS, Fault
from sim_bridge.scenario.fields import (
    ScenarioError,
    name,
    not_negative,
    one_of,
    positive,
    read_fields,
    refuse,
)
from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.user_input.yaml_file import YamlError, read_yaml


class TimelineError(ArmSafetyError, ValueError):
    """An invalid file of faults."""


@dataclass(frozen=True)
class Timeline:
    """Which streams pass, and what is done to them.

    Attributes:
        faults: of each topic that passes, in the order in which they act.
    """

    faults: dict[str, tuple[Fault, ...]]


def load_timeline(path: str | Path, known: tuple[str, ...]) -> Timeline:
    """Read faults over time; ``docs/faults.md`` describes the file.

    Args:
        path: of the file.
        known: topics that may pass.

    Raises:
        TimelineError: the file is missing, or an entry in it is unknown, malformed or out of
            range; the message names file, entry and what is allowed.
    """

    def topic(value: Any, where: str) -> str:
        if value not in known:
            hint = did_you_mean(str(value), known)
            raise refuse(where, value, f"one of {', '.join(known)}{hint}")
        return str(value)

    def topics(value: Any, where: str) -> list[str]:
        if not isinstance(value, list) or not value:
            raise refuse(where, value, "a list of topics")
        return [topic(each, f"{where}[{k}]") for k, each in enumerate(value)]

    def faults(value: Any, where: str) -> list[Any]:
        if not isinstance(value, list | None):
            raise refuse(where, value, "a list")
        return value or []

    try:
        checks = {"topics": topics, "faults": faults}
        content = read_fields(read_yaml(path), "", checks, ("faults",))
        result: dict[str, list[Fault]] = {each: [] for each in content["topics"]}
        for k, entry in enumerate(content.get("faults", ())):
            where = f"faults[{k}]"
            if not isinstance(entry, dict):
                raise refuse(where, entry, "fields and their values")
            of = topic(entry.get("topic"), f"{where}.topic")
            if of not in result:
                raise refuse(f"{where}.topic", of, f"one of 'topics': {', '.join(result)}")
            result[of].append(_fault(entry, where))
    except YamlError as error:
        raise TimelineError(f"faults {error}") from error
    except ScenarioError as error:
        raise TimelineError(f"faults {path}: {error}") from None
    return Timeline({of: tuple(those) for of, those in result.items()})


def _fault(entry: dict[str, Any], where: str) -> Fault:
    """Return the fault that an entry describes."""
    kind = FAULTS[one_of(tuple(FAULTS), entry, where)]
    optional = [each.name for each in fields(kind) if not _required(each)]

    def settings(value: Any, place: str) -> dict[str, Any]:
        return read_fields({} if value is None else value, place, kind.FIELDS, optional)

    checks = {"time": not_negative, "duration": positive, "topic": name, kind.KIND: settings}
    values = read_fields(entry, where, checks)
    start = values["time"]
    return kind(start=start, end=start + values["duration"], **values[kind.KIND])


def _required(each: Any) -> bool:
    return each.default is MISSING and each.default_factory is MISSING
