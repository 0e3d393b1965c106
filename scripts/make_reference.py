# SPDX-License-Identifier: Apache-2.0
"""Write docs/parameters.md, docs/topics.md and the list of names from the nodes' tables.

python scripts/make_reference.py
python scripts/make_reference.py --check    # say which page is stale, write nothing
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from sim_bridge.node import topics as bullet_topics
from sim_bridge.node.bullet_parameters import BulletConfiguration
from sim_bridge.node.viewer_node import ViewerConfiguration
from sim_bridge.scenario.scenario import ScenarioConfiguration
from torque_safety_controller.modes import CAUSES, CHANGES
from torque_safety_controller.node import topics as controller_topics
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.remote.moveit_parameters import MoveitConfiguration
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.node.estimator_node import EstimatorConfiguration
from viability_bounds_pkg.parameter import REQUIRED, Parameter, parameter_table
from viability_bounds_pkg.ros.topics import SHARED_TOPICS, OfferedService, Topic

ROOT = Path(__file__).resolve().parent.parent
CONFIGURATIONS = {
    "bounds_node": BoundsConfiguration,
    "estimator_node": EstimatorConfiguration,
    "controller_node": ControllerConfiguration,
    "bullet_node": BulletConfiguration,
    "scenario_node": ScenarioConfiguration,
    "viewer_node": ViewerConfiguration,
    "moveit_node": MoveitConfiguration,
}
TABLES = {node: parameter_table(kind) for node, kind in CONFIGURATIONS.items()}
TOPICS: tuple[Topic, ...] = (*SHARED_TOPICS, *controller_topics.TOPICS, *bullet_topics.TOPICS)
SERVICES: tuple[OfferedService, ...] = (*controller_topics.SERVICES, *bullet_topics.SERVICES)
_HEAD = "<!-- Made by scripts/make_reference.py: change the tables in the code instead. -->\n"
_TYPES = {
    float: "double",
    int: "integer",
    bool: "bool",
    str: "string",
    list[float]: "double array",
    list[str]: "string array",
}


def parameters_page() -> str:
    """Return the text of docs/parameters.md."""
    heads = ("parameter", "type", "default", "allowed", "live", "description")
    text = f"""{_HEAD}
# Parameters

`ros2 param describe <node> <parameter>` shows the same. Arrays with one number for each joint are
in the order of `joints`; an array that may be empty may be left out. A value that is not allowed
stops a node at start with one line that names the parameter, the value and what is allowed. *Live*
parameters can change while the node runs, where such a value is refused; all others are read-only.
Whole numbers are accepted where a double is expected. Of several values given the last one counts,
whether it comes from a file or from `-p`, and whatever section of the file it is in.
"""
    rows = {row.name: row for table in TABLES.values() for row in table}
    shared = [name for name in rows if _is_shared(name)]
    text += "\n## Shared\n\nParameters of several nodes with the same meaning.\n\n"
    text += _table(
        ("parameter", "nodes", *heads[1:]),
        ((f"`{name}`", _nodes(name), *_cells(rows[name])[1:]) for name in shared),
    )
    for node, table in TABLES.items():
        own = [row for row in table if row.name not in shared]
        text += f"\n## {node}\n\n" + _table(heads, map(_cells, own))
    return text


def topics_page() -> str:
    """Return the text of docs/topics.md."""
    text = f"""{_HEAD}
# Topics and services

Control streams are best effort with depth 1, so that the newest message wins; goals are reliable.
A robot of your own takes the place of `bullet_node`.

## Topics

"""
    heads = ("topic", "type", "from", "to", "quality of service", "meaning")
    text += _table(
        heads,
        (
            (
                f"`{topic.name}`",
                _type_name(topic.message),
                ", ".join(topic.source),
                ", ".join(topic.sink),
                _quality(topic),
                topic.meaning,
            )
            for topic in TOPICS
        ),
    )
    text += "\n## Services\n\n"
    text += _table(
        ("service", "type", "meaning"),
        ((f"`{s.server}/{s.name}`", _type_name(s.kind), s.meaning) for s in SERVICES),
    )
    return text + _modes()


def _modes() -> str:
    """Return what the modes of the controller follow from."""
    text = """
## Modes of controller_node

What mode and reason follow from, and the share of the goals that the arm serves. Of all that lasts
the first row gives the mode; without any it is TRACKING, and the share rises to 1 within 0.5 s
([stopping.md](stopping.md#the-controllers-part)). `/diagnostics` has mode, reason and share.

"""
    text += _table(
        ("begins with", "ends with", "mode", "reason", "goals"),
        (
            (
                cause.event,
                cause.ends,
                cause.mode.value if cause.mode else "as without it",
                cause.reason or "that of the event",
                cause.goals.value,
            )
            for cause in CAUSES.values()
        ),
    )
    text += """
`control` in `/diagnostics` says which control commands the joints. A robot that was away is given
positions again where `start_control` is `position`.

"""
    return text + _table(
        ("control", "event", "control after it"),
        ((before.value, event, after.value) for (before, event), after in CHANGES.items()),
    )


def parameter_names() -> str:
    """Return what a node reads to know which parameters other nodes have."""
    return "".join(f"{name}\n" for name in sorted({r.name for t in TABLES.values() for r in t}))


PAGES = {
    "docs/parameters.md": parameters_page,
    "docs/topics.md": topics_page,
    "src/viability_bounds_pkg/viability_bounds_pkg/ros/parameter_names.txt": parameter_names,
}


def _is_shared(name: str) -> bool:
    """Return whether several nodes have a parameter and all mean the same by it."""
    cells = [_cells(row) for table in TABLES.values() for row in table if row.name == name]
    return len(cells) > 1 and len(set(cells)) == 1


def _nodes(name: str) -> str:
    """Return which nodes have a parameter, without the end of their names."""
    having = (node for node, table in TABLES.items() if any(row.name == name for row in table))
    return ", ".join(node.removesuffix("_node") for node in having)


def _cells(row: Parameter) -> tuple[str, ...]:
    live = "live" if row.live else ""
    allowed = row.constraints
    return f"`{row.name}`", _TYPES[row.kind], _default(row), allowed, live, row.description


def _default(row: Parameter) -> str:
    if row.default is REQUIRED:
        return "required"
    if row.optional or row.default == "":
        return "empty"
    if isinstance(row.default, tuple | list | np.ndarray):
        return f"[{', '.join(f'{item:g}' for item in row.default)}]"
    return f"{row.default:g}" if isinstance(row.default, float) else str(row.default).lower()


def _type_name(message: type) -> str:
    return f"{message.__module__.split('.')[0]}/{message.__name__}"


def _quality(topic: Topic) -> str:
    reliable = topic.qos.reliability == ReliabilityPolicy.RELIABLE
    latched = topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    kind = ("reliable" if reliable else "best effort") + (", transient local" if latched else "")
    return f"{kind}, depth {topic.qos.depth}"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(map(_escaped, line))} |\n" for line in lines)


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|").replace("<", "&lt;") if "`" not in cell else cell


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pages, or check them; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="only say which page is stale")
    check = parser.parse_args(arguments).check
    stale = 0
    for name, make in PAGES.items():
        path, text = ROOT / name, make()
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        stale += 1
        if check:
            print(f"{name} is stale: python scripts/make_reference.py", file=sys.stderr)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            print(f"{name} written")
    return int(check and stale > 0)


if __name__ == "__main__":
    sys.exit(main())
