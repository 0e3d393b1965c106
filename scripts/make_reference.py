# SPDX-License-Identifier: Apache-2.0
"""Write the pages of docs/reference and the list of parameters' names from the nodes' tables.

python scripts/make_reference.py
python scripts/make_reference.py --check    # say which page is stale, write nothing
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from franka_bridge.node import topics as franka_topics
from franka_bridge.node.franka_parameters import FrankaConfiguration, SimulationConfiguration
from sim_bridge.node import topics as bullet_topics
from sim_bridge.node.bullet_parameters import BulletConfiguration
from sim_bridge.node.viewer_node import ViewerConfiguration
from sim_bridge.scenario.scenario import ScenarioConfiguration
from torque_safety_controller.modes import CAUSES
from torque_safety_controller.node import topics as controller_topics
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.remote.moveit_parameters import MoveitConfiguration
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.node.estimator_node import EstimatorConfiguration
from viability_bounds_pkg.parameter import REQUIRED, Parameter, parameter_table
from viability_bounds_pkg.ros import topics
from viability_bounds_pkg.ros.topics import OfferedService, Topic

ROOT = Path(__file__).resolve().parent.parent
CONFIGURATIONS = {
    "bounds_node": BoundsConfiguration,
    "estimator_node": EstimatorConfiguration,
    "controller_node": ControllerConfiguration,
    "bullet_node": BulletConfiguration,
    "franka_node": FrankaConfiguration,
    "simulated_fr3": SimulationConfiguration,
    "scenario_node": ScenarioConfiguration,
    "viewer_node": ViewerConfiguration,
    "moveit_node": MoveitConfiguration,
}
TABLES = {node: parameter_table(kind) for node, kind in CONFIGURATIONS.items()}
_ROOMS = topics, controller_topics, bullet_topics, franka_topics
_DECLARED = [each for room in _ROOMS for each in vars(room).values()]
TOPICS = [each for each in _DECLARED if isinstance(each, Topic)]
SERVICES = [each for each in _DECLARED if isinstance(each, OfferedService)]
_HEAD = "<!-- Made by scripts/make_reference.py: change the tables in the code instead. -->\n"
_TYPES = {
    float: "double",
    int: "integer",
    bool: "bool",
    str: "string",
    list[float]: "double[]",
    list[str]: "string[]",
}
_SHORTER = (
    (r", one for each of 'joints'(, or none)?", ""),
    (r"^(an? )?(whole |finite )?(number|numbers)\b[,;]? ?", ""),
    (r"^(\d+) (finite )?numbers\b(, or none)?", r"\1 numbers"),
    (r"^>= (\S+) and <= ([^\s,;]+)", r"\1 to \2"),
    (r"^> (\S+) and <= ([^\s,;]+)", r"> \1 to \2"),
    (r"^one of ", ""),
)
"""How allowed values are said in fewer words; what a table's head says already is left out."""

_IF_EMPTY = re.compile(r"(.+); (\S+) if empty")
"""Descriptions whose end belongs into the column of defaults."""

_BREAK = "<wbr>"
"""Where a long name may be broken."""

_PLAYERS = {"scenario_node", "viewer_node"}
"""Nodes that send and read what users can, so that the tables of topics leave them out."""


def parameters_page() -> str:
    """Return the text of docs/reference/parameters.md."""
    heads = ("parameter", "type, default", "allowed", "meaning")
    text = f"""{_HEAD}
# Parameters

`ros2 param describe NODE PARAMETER` shows the same.

- *double[]*: where no other length is given, one number for each joint, in the order of `joints`.
  An array with a default may be left out or empty.
- *Live*: can change while the node runs. All others are read-only.
- At start a wrong value or an unknown name stops the node with one line, which says what is
  allowed. While it runs the value is refused, and the old one stays.
- Of several values the last one given counts, from files and from `-p`.

A file has sections `/**` for all nodes and `/**/controller_node` for one, each with
`ros__parameters`. The files in `config/` are examples.

## Several nodes

"""
    shared: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for node, table in TABLES.items():
        for row in table:
            shared[_cells(row)].append(node)
    shared = {cells: nodes for cells, nodes in shared.items() if len(nodes) > 1}
    text += _table(
        ("parameter", "nodes", *heads[1:]),
        ((cells[0], _nodes(nodes), *cells[1:]) for cells, nodes in shared.items()),
    )
    for node, table in TABLES.items():
        own = [cells for cells in map(_cells, table) if cells not in shared]
        if own:
            text += f"\n## {node}\n\n" + _table(heads, own)
    return text


def topics_page() -> str:
    """Return the text of docs/reference/topics.md."""
    text = f"""{_HEAD}
# Topics, services, modes

Names are relative: a second arm needs only a namespace. A robot of your own takes the place of
`bullet_node`. Nodes are written without `_node`. *User* stands for programs of yours.

## Control streams

Published reliably and subscribed to with best effort; depth 1: the newest message wins. On slow
networks take `slow/joint_states`. The stamp of a joint state names the control step; estimates,
limits and commands carry the stamp of the state that they answer.

"""
    heads = ("topic", "type", "from → to", "meaning")
    streams = [topic for topic in TOPICS if not _is_reliable(topic)]
    text += _table(heads, map(_topic_cells, streams))
    text += """
## Goals and reports

Reliable: publish them so, too. A goal, push or obstacle with a stamp in the future takes effect
then. *Latched* is transient local: a late subscriber gets the last message.

"""
    text += _table(heads, (_topic_cells(topic) for topic in TOPICS if topic not in streams))
    text += "\n## Services\n\n"
    text += _table(
        ("service", "type", "meaning"),
        ((f"`{s.server}/{s.name}`", _type_name(s.kind), s.meaning) for s in SERVICES),
    )
    return text + _modes()


def _topic_cells(topic: Topic) -> tuple[str, ...]:
    latched = topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return (
        f"`{topic.name}`",
        _type_name(topic.message),
        f"{_ends(topic.source)} → {_ends(topic.sink)}",
        ("latched; " if latched else "") + topic.meaning,
    )


def _is_reliable(topic: Topic) -> bool:
    return topic.qos.reliability == ReliabilityPolicy.RELIABLE


def _ends(nodes: Sequence[str]) -> str:
    """Return the nodes at one end of a topic, without those that stand for users."""
    return _nodes([node for node in nodes if node not in _PLAYERS]) or "user"


def _modes() -> str:
    """Return what the modes of the controller follow from."""
    text = """
## Modes of controller_node

| mode | what the controller does |
| --- | --- |
| TRACKING | serves the goals inside all limits |
| HOLD | gravity compensation and damping, inside limits that it computes itself where none come |
| POSITION | the robot's own drives hold the commanded position |
| STOPPED | publishes nothing, so that the robot stops itself |

The table lists what keeps the controller from serving its goals. Of several causes the first in
the table gives the mode; without any, it is TRACKING. Where no reason is given, it is the event.
*Share* is the part of the goals that the arm serves, 0 to 1; it rises to 1 within 0.5 s.
`/diagnostics` has mode, reason and share.

"""
    text += _table(
        ("begins with", "ends with", "mode", "reason", "goals"),
        (
            (
                cause.event,
                cause.ends,
                cause.mode.value if cause.mode else "as without it",
                cause.reason,
                cause.goals.value,
            )
            for cause in CAUSES.values()
        ),
    )
    return text


def parameter_names() -> str:
    """Return what a node reads to know which parameters other nodes have."""
    return "".join(f"{name}\n" for name in sorted({r.name for t in TABLES.values() for r in t}))


PAGES = {
    "docs/reference/parameters.md": parameters_page,
    "docs/reference/topics.md": topics_page,
    "src/viability_bounds_pkg/viability_bounds_pkg/ros/parameter_names.txt": parameter_names,
}


def _nodes(nodes: Sequence[str]) -> str:
    """Return the names of nodes without their end."""
    if len(nodes) == len(TABLES):
        return "all"
    return ", ".join(node.removesuffix("_node") for node in nodes)


def _cells(row: Parameter) -> tuple[str, ...]:
    described = _IF_EMPTY.fullmatch(row.description)
    meaning, default = described.groups() if described else (row.description, _default(row))
    kind = f"{_TYPES[row.kind]}, {default}" + (", *live*" if row.live else "")
    return f"`{row.name}`", kind, _allowed(row), meaning


def _allowed(row: Parameter) -> str:
    """Return what is allowed, in few words."""
    text = row.constraints
    for pattern, shorter in _SHORTER:
        text = re.sub(pattern, shorter, text)
    return text


def _default(row: Parameter) -> str:
    if row.default is REQUIRED:
        return "required"
    if row.optional or row.default == "":
        return "empty"
    if isinstance(row.default, tuple | list | np.ndarray):
        return f"[{', '.join(f'{item:g}' for item in row.default)}]"
    return f"{row.default:g}" if isinstance(row.default, float) else str(row.default).lower()


def _type_name(message: type) -> str:
    return f"{message.__module__.split('.')[0]}/{_BREAK}{message.__name__}"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(map(_escaped, line))} |\n" for line in lines)


def _escaped(cell: str) -> str:
    if "`" in cell:
        return cell
    return cell.replace("|", "\\|").replace("<", "&lt;").replace("&lt;wbr>", _BREAK)


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
