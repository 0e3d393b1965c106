# SPDX-License-Identifier: Apache-2.0
"""What a soak has seen, and its report."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from moments import AGAIN

GROWTH_MAX = 20.0  # MB/h, of a program; less cannot be told from noise in an hour
GROWTH_TIME = 600.0  # s, below which nothing is said of growth
WARM = 0.25
"""Share of a run, at most `WARM_MAX` s, after which memory is looked at: first uses take some."""
WARM_MAX = 120.0


@dataclass
class Episode:
    """A fault that happened.

    Attributes:
        name: what happened.
        begin: s of robot time since the start.
        end: when the cause was gone.
        again: how long after that the controller followed its goals, s; None if it has not yet.
        obeyed: whether the robot has reported since then that it follows commands.
    """

    name: str
    begin: float
    end: float
    again: float | None = None
    obeyed: bool = False

    @property
    def over(self) -> bool:
        """Whether the arm has gone on."""
        return self.again is not None and self.obeyed


@dataclass
class Memory:
    """Memory of a process over time, and its time on processors.

    Attributes:
        pid: process.
        samples: (s, MB).
        cpu: time on processors since `since`, s.
        since: s.
    """

    pid: int
    since: float
    samples: list[tuple[float, float]] = field(default_factory=list)
    cpu: float = 0.0

    def look(self, now: float) -> None:
        """Add a sample; a process that has just ended has none."""
        try:
            pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
            fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError, IndexError):
            return
        self.samples.append((now, 1e-6 * pages * os.sysconf("SC_PAGE_SIZE")))
        self.cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    @property
    def settled(self) -> np.ndarray:
        """The samples after the first uses, shape (N, 2)."""
        all_of_them = np.array(self.samples).reshape(-1, 2)
        if not len(all_of_them):
            return all_of_them
        lasted = all_of_them[-1, 0] - self.since
        return all_of_them[all_of_them[:, 0] >= self.since + min(WARM * lasted, WARM_MAX)]

    @property
    def slope(self) -> float:
        """Growth, MB/h; NaN where there are too few samples."""
        settled = self.settled
        if len(settled) < 10:
            return float("nan")
        return 3600.0 * float(np.polyfit(settled[:, 0], settled[:, 1], 1)[0])


@dataclass
class Record:
    """Everything that counts.

    Attributes:
        conditions: of the run, in words.
        position, speed, torque: worst beyond limits, rad, rad/s, and share of torque_max.
        clearance: least distance kept from position limits, rad.
        robot: last diagnostics of the robot.
        given, reached: goals, by kind.
        pushes: number.
        episodes: faults.
        refused: refusals by node and reason.
        memory: by program.
        ended: programs that ended by themselves.
        played: robot time, s.
        elapsed: wall time, s.
    """

    conditions: str = ""
    position: float = 0.0
    speed: float = 0.0
    torque: float = 0.0
    clearance: float = np.inf
    robot: dict[str, Any] = field(default_factory=dict)
    given: Counter[str] = field(default_factory=Counter)
    reached: Counter[str] = field(default_factory=Counter)
    pushes: int = 0
    episodes: list[Episode] = field(default_factory=list)
    refused: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    memory: dict[str, Memory] = field(default_factory=dict)
    ended: list[str] = field(default_factory=list)
    played: float = 0.0
    elapsed: float = 0.0

    def note_robot(self, found: dict[str, Any]) -> None:
        """Take diagnostics of the robot, which cover all its physics steps until now."""

        def numbers(key: str) -> np.ndarray:
            return np.array([float(word) for word in found[key].split()])

        self.robot = found
        self.position = max(self.position, float(numbers("position_violation_rad").max()))
        self.speed = max(self.speed, float(numbers("velocity_violation_rad_s").max()))
        commanded = float(found["commanded_torque_ratio_max"])
        self.torque = max(self.torque, commanded, float(numbers("torque_ratio").max()))
        for end in ("lower", "upper"):
            self.clearance = min(self.clearance, float(numbers(f"{end}_clearance_rad").min()))

    @property
    def gone_on(self) -> list[Episode]:
        """Faults after which the arm has gone on."""
        return [each for each in self.episodes if each.over]

    @property
    def wrong(self) -> list[str]:
        """What was promised and did not happen, in words."""
        wrong = []
        if self.position > 0.0 or self.speed > 0.0 or not self.torque <= 1.0 + 1e-9:
            wrong.append("a limit was passed")
        if not self.robot:
            wrong.append("the robot never reported")
        if stuck := [each.name for each in self.episodes if not each.over]:
            wrong.append(f"no motion after: {', '.join(stuck)}")
        if self.ended:
            wrong.append(f"ended by themselves: {', '.join(self.ended)}")
        for name, each in self.memory.items():
            long_enough = each.samples and each.samples[-1][0] - each.since >= GROWTH_TIME
            if long_enough and each.slope > GROWTH_MAX:
                wrong.append(f"memory of {name} grows")
        return wrong

    def line(self) -> str:
        """Return how it stands, in one line."""
        robot = self.robot
        missed, stopped = (robot.get(key, "-") for key in ("deadline_misses", "braked_periods"))
        memory = sum(each.samples[-1][1] for each in self.memory.values() if each.samples)
        return (
            f"{self.elapsed / 60:5.1f} min  goals {self.reached.total()}/{self.given.total()}  "
            f"faults {len(self.gone_on)}/{len(self.episodes)}  beyond {self.position:.2g} rad "
            f"{self.speed:.2g} rad/s  torque {self.torque:.3f}  nearest {self.clearance:.1g} rad  "
            f"missed {missed} stopped {stopped}  {memory:.0f} MB"
        )

    def report(self) -> str:
        """Return the report as Markdown."""
        robot = self.robot
        again = np.array([each.again for each in self.gone_on])
        counts = Counter(each.name for each in self.episodes)
        lines = [
            f"# Soak: {self.conditions}",
            "",
            f"**{'; '.join(self.wrong) or 'all kept'}**",
            "",
            "| | |",
            "|---|---|",
            f"| time | {self.elapsed / 60:.1f} min, {self.played / 60:.1f} min of robot time |",
            f"| beyond position limits | {self.position:.2g} rad |",
            f"| nearest position limit | {self.clearance:.2g} rad |",
            f"| beyond speed limits | {self.speed:.2g} rad/s |",
            f"| largest torque | {self.torque:.4f} of torque_max |",
            *(
                f"| goals for {kind} reached | {self.reached[kind]} of {count} |"
                for kind, count in self.given.items()
            ),
            f"| pushes | {self.pushes} |",
            f"| faults, followed by motion again | {len(self.episodes)}, {len(again)} |",
        ]
        if len(again):
            within = int((again <= AGAIN).sum())
            lines += [
                f"| time to go on, median, 95%, longest | {np.median(again):.2f}, "
                f"{np.quantile(again, 0.95):.2f}, {again.max():.2f} s |",
                f"| within {AGAIN:g} s | {within} of {len(again)} |",
            ]
        if robot:
            lines += [
                f"| periods | {robot['periods']} |",
                f"| of them missed, late, stopped | {robot['deadline_misses']}, "
                f"{robot['late_periods']}, {robot['braked_periods']} |",
            ]
        lines += ["", "| fault | times | longest to go on, s |", "|---|---|---|"]
        for name, count in sorted(counts.items()):
            longest = max((each.again for each in self.gone_on if each.name == name), default=None)
            lines.append(f"| {name} | {count} | {'-' if longest is None else f'{longest:.2f}'} |")
        heads = "program", "memory, MB", "growth, MB/h", "share of a processor"
        lines += ["", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
        for name, each in self.memory.items():
            settled = each.settled
            if len(settled):
                share = each.cpu / max(settled[-1, 0] - each.since, 1e-9)
                lines.append(
                    f"| {name} | {settled[0, 1]:.1f} to {settled[-1, 1]:.1f} | {each.slope:.1f} "
                    f"| {share:.0%} |"
                )
        lines += ["", "| refused by | why | times |", "|---|---|---|"]
        for node, reasons in sorted(self.refused.items()):
            lines += [f"| {node} | {why} | {count} |" for why, count in sorted(reasons.items())]
        return "\n".join(lines) + "\n"

    def metrics(self) -> dict[str, Any]:
        """Return the numbers, as JSON can hold them."""
        return {
            "kept": not self.wrong,
            "wrong": self.wrong,
            "position_violation_rad": self.position,
            "velocity_violation_rad_s": self.speed,
            "torque_ratio": self.torque,
            "goals": dict(self.given),
            "goals_reached": dict(self.reached),
            "pushes": self.pushes,
            "faults": [asdict(each) for each in self.episodes],
            "refused": {node: dict(reasons) for node, reasons in self.refused.items()},
            "growth_mb_h": {name: each.slope for name, each in self.memory.items()},
            "elapsed_s": self.elapsed,
            "robot_time_s": self.played,
        }
