# SPDX-License-Identifier: Apache-2.0
"""Makes the files of arms of installed packages from their URDFs, plays them, writes the table."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from chain import ROOT
from figure import RESULTS, Figure, table

from viability_bounds_pkg.robot.description import package_directories

PAGE = ROOT / "docs" / "start" / "your_robot.md"
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
FOLDER = RESULTS / "new_robot"
HEADS = (
    "arm",
    "joints",
    "without end",
    "rate, Hz",
    "speeds, of the URDF's",
    "acceleration limits, rad/s²",
    "safety filter",
    "limits in the scenario",
    "time to files, s",
    "limits",
)

DATA = "package://example-robot-data/robots/"
BULLET = "pybullet_data:"


@dataclass(frozen=True)
class Arm:
    """An arm of an installed package.

    Attributes:
        urdf: ``package://`` URI, or a file of pybullet_data.
        tip: link or links at the end.
        base: link whose joints before are locked; empty for none.
    """

    urdf: str
    tip: str
    base: str = ""


ARMS = {
    "ur3": Arm(DATA + "ur_description/urdf/ur3_robot.urdf", "tool0"),
    "ur5": Arm(DATA + "ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": Arm(DATA + "ur_description/urdf/ur10_robot.urdf", "tool0"),
    "ur5_limited": Arm(DATA + "ur_description/urdf/ur5_joint_limited_robot.urdf", "tool0"),
    "kinova_j2s6s200": Arm(
        DATA + "kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"
    ),
    "xarm6": Arm(BULLET + "xarm/xarm6_robot.urdf", "link6"),
    "z1": Arm(DATA + "z1_description/urdf/z1.urdf", "link06"),
    "xarm7": Arm(DATA + "xarm_description/urdf/xarm7.urdf", "link_eef"),
    "panda": Arm(DATA + "panda_description/urdf/panda.urdf", "panda_hand"),
    "iiwa": Arm(BULLET + "kuka_iiwa/model.urdf", "lbr_iiwa_link_7"),
    "baxter_right": Arm(DATA + "baxter_description/urdf/baxter.urdf", "right_gripper"),
    "tiago": Arm(
        DATA + "tiago_description/robots/tiago_no_hand.urdf",
        "wrist_ft_tool_link",
        "torso_lift_link",
    ),
    "talos_right": Arm(
        DATA + "talos_data/robots/talos_reduced.urdf", "gripper_right_base_link", "torso_2_link"
    ),
    "pr2_left": Arm(
        DATA + "pr2_description/urdf/pr2.urdf", "l_gripper_palm_link", "torso_lift_link"
    ),
    "g1_left": Arm(
        DATA + "g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_rubber_hand", "torso_link"
    ),
    "romeo_left": Arm(DATA + "romeo_description/urdf/romeo_small.urdf", "l_gripper", "torso"),
    "centauro_left": Arm(DATA + "centauro_description/urdf/centauro.urdf", "arm1_8", "torso_2"),
    "baxter_both": Arm(DATA + "baxter_description/urdf/baxter.urdf", "left_gripper,right_gripper"),
    "tiago_dual": Arm(
        DATA + "tiago_description/robots/tiago_dual.urdf",
        "hand_left_tool_link,hand_right_tool_link",
        "torso_lift_link",
    ),
    "tiago_pro_dual": Arm(
        DATA + "tiago_pro_description/robots/tiago_pro.urdf",
        "arm_left_tool_link,arm_right_tool_link",
        "torso_lift_link",
    ),
}
"""Of 6 and 7 joints, with joints without end, and two arms of 14."""


def urdf_of(arm: Arm) -> str:
    """Return where the URDF of an arm is."""
    if not arm.urdf.startswith(BULLET):
        return arm.urdf
    import pybullet_data

    return str(Path(pybullet_data.getDataPath()) / arm.urdf.removeprefix(BULLET))


def make(name: str, arm: Arm) -> dict[str, Any]:
    """Make the files of an arm and play it; return its row."""
    folder = FOLDER / "config"
    command = ["bash", str(ROOT / "scripts" / "new_robot.sh"), urdf_of(arm), arm.tip]
    command += ["--name", name, "--out", str(folder), "--force"]
    command += ["--base", arm.base] if arm.base else []
    begin = time.monotonic()
    (FOLDER / f"{name}.txt").unlink(missing_ok=True)
    seconds, lines = 0.0, []
    metrics = FOLDER / name / "metrics.json"
    metrics.unlink(missing_ok=True)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as run:
        assert run.stdout is not None
        for line in run.stdout:
            lines.append(line)
            if line.startswith("written: ") and not seconds:
                seconds = time.monotonic() - begin
    (FOLDER / f"{name}.txt").write_text("".join(lines))
    row: dict[str, Any] = {"seconds": seconds}
    if not seconds:
        refusals = [line for line in lines if line.startswith("new_robot: ")]
        return row | {"refused": (refusals or lines[-1:])[-1].strip().removeprefix("new_robot: ")}
    text = (folder / f"{name}.yaml").read_text()
    values = yaml.safe_load(text)
    robot = values["/**"]["ros__parameters"]
    row["joints"] = len(robot["joints"])
    row["endless"] = sum(" turns without end" in line for line in lines)
    row["rate"] = robot["rate_hz"]
    row["speeds"] = next(
        (line.split()[0] for line in lines if " of the URDF's: at higher" in line), "1"
    )
    row["accelerations"] = [
        min(map(abs, robot["acceleration_min"] + robot["acceleration_max"])),
        max(robot["acceleration_max"]),
    ]
    control = values["/**/controller_node"]["ros__parameters"]
    row["filter"] = bool(control.get("safety_filter"))
    row["reached"] = next(
        line.partition(" with ")[2].partition(" position")[0].replace(" of the ", " of ")
        for line in lines
        if line.startswith("scenario: ")
    )
    return row | {"limits": verdict(metrics, lines)}


def verdict(path: Path, lines: list[str]) -> str:
    """Return what a run says: kept, what was passed, or why it did not run."""
    if not path.exists():
        errors = [line.strip() for line in lines if "error" in line.lower()]
        return f"did not run: {errors[-1] if errors else 'no message'}"
    metrics = json.loads(path.read_text())
    passed = []
    if metrics["max_position_violation_rad"] > 0.0:
        passed.append(f"position by {metrics['max_position_violation_rad']:.2g} rad")
    if metrics["max_velocity_violation_rad_s"] > 0.0:
        passed.append(f"speed by {metrics['max_velocity_violation_rad_s']:.2g} rad/s")
    if metrics["max_torque_ratio"] > 1.0 + 1e-9:
        passed.append(f"torque, {metrics['max_torque_ratio']:.3f} of its limit")
    return "PASSED " + ", ".join(passed) if passed else "kept"


def cells(name: str, row: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of a row."""
    if "refused" in row:
        return (name, *[""] * (len(HEADS) - 2), row["refused"])
    low, high = row["accelerations"]
    return (
        f"`{name}`",
        str(row["joints"]),
        str(row["endless"] or "-"),
        f"{row['rate']:g}",
        row["speeds"],
        f"{low:g} to {high:g}",
        "yes" if row["filter"] else "-",
        row["reached"],
        f"{row['seconds']:.0f}",
        row["limits"],
    )


def write_page(rows: dict[str, dict[str, Any]]) -> None:
    """Put the table between its marks in the page."""
    text = PAGE.read_text()
    head, rest = text.split(BEGIN)
    _, tail = rest.split(END)
    lines = [cells(name, rows[name]) for name in ARMS if name in rows]
    body = table([Figure("new_robot", rows=lines)], HEADS)
    PAGE.write_text(f"{head}{BEGIN}\n{body}\n{END}{tail}")


def main() -> int:
    """Make and play arms; return 1 if one of them passed a limit or did not run."""
    parser = argparse.ArgumentParser(
        prog="new_robots.py", description=__doc__, epilog=f"Arms: {', '.join(ARMS)}."
    )
    parser.add_argument("arms", nargs="*", metavar="ARM", help="which (default: all)")
    names = parser.parse_args().arms or list(ARMS)
    if unknown := [name for name in names if name not in ARMS]:
        parser.error(f"unknown arm '{unknown[0]}'; there are: {', '.join(ARMS)}")
    assert any(path.is_dir() for path in package_directories())
    FOLDER.mkdir(parents=True, exist_ok=True)
    kept = FOLDER / "rows.json"
    rows = json.loads(kept.read_text()) if kept.exists() else {}
    for name in names:
        rows[name] = make(name, ARMS[name])
        print(" | ".join(cells(name, rows[name])), flush=True)
        kept.write_text(json.dumps(rows, indent=1) + "\n")
        write_page(rows)
    return 0 if all(rows[name].get("limits") == "kept" for name in names) else 1


if __name__ == "__main__":
    sys.exit(main())
