# SPDX-License-Identifier: Apache-2.0
"""Makes the files of arms of installed packages from their URDFs, plays them, writes the table."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import yaml
from chain import ROOT
from figure import RESULTS, Row, page_rows, table, write_part

PART, PAGE = "new-robots", "start/your_robot.md"
FOLDER = RESULTS / "new_robot"
HEADS = (
    "arm",
    "joints",
    "rate, Hz",
    "speeds, of the URDF's",
    "acceleration limits, rad/s²",
    "safety filter",
    "limits in the scenario",
    "exact robot",
    "imperfect robot",
)

BULLET, VERDICT = "pybullet_data:", "VERDICT: "


class Arm(NamedTuple):
    """An arm of an installed package.

    Attributes:
        urdf: file of example-robot-data, or of pybullet_data.
        tip: link or links at the end.
        base: link whose joints before are locked; empty for none.
    """

    urdf: str
    tip: str
    base: str = ""


ARMS = {
    "ur3": Arm("ur_description/urdf/ur3_robot.urdf", "tool0"),
    "ur5": Arm("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": Arm("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "ur5_limited": Arm("ur_description/urdf/ur5_joint_limited_robot.urdf", "tool0"),
    "kinova_j2s6s200": Arm("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "xarm6": Arm(BULLET + "xarm/xarm6_robot.urdf", "link6"),
    "z1": Arm("z1_description/urdf/z1.urdf", "link06"),
    "xarm7": Arm("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "panda": Arm("panda_description/urdf/panda.urdf", "panda_hand"),
    "iiwa": Arm(BULLET + "kuka_iiwa/model.urdf", "lbr_iiwa_link_7"),
    "baxter_right": Arm("baxter_description/urdf/baxter.urdf", "right_gripper"),
    "tiago": Arm(
        "tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link", "torso_lift_link"
    ),
    "talos_right": Arm(
        "talos_data/robots/talos_reduced.urdf", "gripper_right_base_link", "torso_2_link"
    ),
    "pr2_left": Arm("pr2_description/urdf/pr2.urdf", "l_gripper_palm_link", "torso_lift_link"),
    "g1_left": Arm("g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_rubber_hand", "torso_link"),
    "romeo_left": Arm("romeo_description/urdf/romeo_small.urdf", "l_gripper", "torso"),
    "centauro_left": Arm("centauro_description/urdf/centauro.urdf", "arm1_8", "torso_2"),
    "baxter_both": Arm("baxter_description/urdf/baxter.urdf", "left_gripper,right_gripper"),
    "tiago_dual": Arm(
        "tiago_description/robots/tiago_dual.urdf",
        "hand_left_tool_link,hand_right_tool_link",
        "torso_lift_link",
    ),
    "tiago_pro_dual": Arm(
        "tiago_pro_description/robots/tiago_pro.urdf",
        "arm_left_tool_link,arm_right_tool_link",
        "torso_lift_link",
    ),
}
"""Of 6 and 7 joints, with joints without end, and two arms of 14."""


def urdf_of(arm: Arm) -> str:
    """Return where the URDF of an arm is."""
    if not arm.urdf.startswith(BULLET):
        return f"package://example-robot-data/robots/{arm.urdf}"
    import pybullet_data

    return str(Path(pybullet_data.getDataPath()) / arm.urdf.removeprefix(BULLET))


def play(name: str, arm: Arm) -> Row:
    """Make the files of an arm and play it; return its row."""
    config = FOLDER / "config"
    command = ["bash", str(ROOT / "scripts" / "new_robot.sh"), urdf_of(arm), arm.tip]
    command += ["--name", name, "--out", str(config), "--force"]
    command += ["--base", arm.base] if arm.base else []
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    lines = [line.strip() for line in done.stdout.splitlines()]
    (FOLDER / f"{name}.txt").write_text("\n".join(lines) + "\n")
    if not any(line.startswith("written: ") for line in lines):
        refusals = [line for line in lines if line.startswith("new_robot: ")]
        whys = [line.removeprefix("new_robot: ") for line in refusals or lines[-1:]]
        why = "; ".join(each.partition(";")[0] for each in whys)
        return (f"`{name}`", *[""] * (len(HEADS) - 3), why, "")
    values = yaml.safe_load((config / f"{name}.yaml").read_text())
    robot = values["/**"]["ros__parameters"]
    slower = [line.split()[0] for line in lines if " of the URDF's: " in line]
    (reached,) = (line for line in lines if line.startswith("scenario: "))
    low = min(map(abs, robot["acceleration_min"] + robot["acceleration_max"]))
    filtered = values["/**/controller_node"]["ros__parameters"].get("safety_filter")
    kept = ["kept" if ": no limit " in line else "not kept" for line in lines if VERDICT in line]
    return (
        f"`{name}`",
        str(len(robot["joints"])),
        f"{robot['rate_hz']:g}",
        *(slower or ["1"])[:1],
        f"{low:g} to {max(robot['acceleration_max']):g}",
        "yes" if filtered else "-",
        reached.partition(" with ")[2].partition(" position")[0].replace(" of the ", " of "),
        *(kept + ["-", "-"])[:2],
    )


def main() -> int:
    """Make and play arms; return 1 if one of them passed a limit or did not run."""
    parser = argparse.ArgumentParser(
        prog="new_robots.py", description=__doc__, epilog=f"Arms: {', '.join(ARMS)}."
    )
    parser.add_argument("arms", nargs="*", metavar="ARM", help="which (default: all)")
    names = parser.parse_args().arms or list(ARMS)
    if unknown := [name for name in names if name not in ARMS]:
        parser.error(f"unknown arm '{unknown[0]}'; there are: {', '.join(ARMS)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    rows = {cells[0]: cells for cells in page_rows(PART, PAGE).values()}
    for name in names:
        cells = rows[f"`{name}`"] = play(name, ARMS[name])
        print(*cells, sep=" | ", flush=True)
        known = [rows[f"`{each}`"] for each in ARMS if f"`{each}`" in rows]
        write_part(PART, table(known, HEADS), PAGE)
    return int(any(rows[f"`{name}`"][-2] != "kept" for name in names))


if __name__ == "__main__":
    sys.exit(main())
