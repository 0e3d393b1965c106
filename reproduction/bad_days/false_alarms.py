# SPDX-License-Identifier: Apache-2.0
"""Long random motions, ideal and imperfect robots: no right state is refused, no command doubted.

bash scripts/reproduce.sh false-alarms [--robot NAME] [--minutes N]

In lockstep. Posture goals come after 0.3 to 9 s, so that the arm is in motion when some come
and has stood for long when others do; half of their positions are limits.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from typing import Any

import numpy as np
import yaml
from chain import ROOT, load_node_values
from figure import RESULTS, Figure, table, verdict
from moments import EVERY

HEADS = ("robot", "", "robot time, s", "joint states", "refused or doubted", "limits", "")
ALARMS = "joint_states refused", "the motors do not give the torques that were sent"


def scenario(robot: str, minutes: float) -> dict[str, Any]:
    """Return goals at random times."""
    values = load_node_values(robot)["bullet_node"]
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    rng = np.random.default_rng(5)
    events, time = [], 0.0
    while time < 60.0 * minutes:
        side = rng.random(low.size)
        q = np.where(side < 0.25, low, np.where(side < 0.5, high, rng.uniform(low, high)))
        goal = dict(zip(values["joints"], q.tolist(), strict=True))
        events.append({"time": round(time, 3), "posture": goal})
        time += float(rng.uniform(0.3, 3.0) if rng.random() < 0.5 else rng.uniform(4.0, 9.0))
    return {"duration": 60.0 * minutes, "events": events}


def play(robot: str, kind: str, minutes: float) -> tuple[str, ...]:
    """Play the goals; return the row of what came of it."""
    folder = RESULTS / "false_alarms" / f"{robot}_{kind}"
    folder.mkdir(parents=True, exist_ok=True)
    goals = folder / "scenario.yaml"
    goals.write_text(yaml.safe_dump(scenario(robot, minutes)))
    (folder / "metrics.json").unlink(missing_ok=True)
    command = ["bash", ROOT / "scripts" / "demo.sh", robot, goals, "--out", folder]
    command += ["--imperfect"] * (kind == "imperfect")
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    said = run.stdout + run.stderr
    (folder / "output.txt").write_text(said)
    alarm = next(
        (line for line in said.splitlines() if any(map(line.__contains__, ALARMS))), "none"
    )
    if not (folder / "metrics.json").exists():
        return robot, kind, "-", "-", alarm, "-", verdict(False)
    metrics = json.loads((folder / "metrics.json").read_text())
    fine = alarm == "none" and metrics["limits_kept"]
    kept = "kept" if metrics["limits_kept"] else "passed"
    span = f"{metrics['steps'] / metrics['rate_hz']:.0f}"
    return robot, kind, span, str(metrics["steps"]), alarm, kept, verdict(fine, "no false alarm")


def main() -> int:
    """Play all; return 1 when there was a false alarm or a limit was passed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--robot", action="append", choices=EVERY, help="repeatable")
    parser.add_argument("--minutes", type=float, default=10.0, help="of robot time (default: 10)")
    options = parser.parse_args()
    rows = [
        play(robot, kind, options.minutes)
        for robot in options.robot or EVERY
        for kind in ("ideal", "imperfect")
    ]
    print(table([Figure("false_alarms", rows=rows)], HEADS))
    return int(any(row[-1] == verdict(False) for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
