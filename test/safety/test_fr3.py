# SPDX-License-Identifier: Apache-2.0
"""What `reproduce.sh fr3` does beside playing: its course and its rows."""

import fr3
import numpy as np
import pytest
import yaml
from chain import load_values
from fr3 import CASES, HEADS, course, row

from sim_bridge.scenario.events import EnableTorque, PoseGoal, PostureGoal, Push
from sim_bridge.scenario.scenario import load_scenario

VALUES = load_values("fr3")
KEPT = {
    "limits_kept": True,
    "max_position_violation_rad": 0.0,
    "max_velocity_violation_rad_s": 0.0,
    "max_torque_ratio": 0.99,
    "max_torque_rate_ratio": 0.9,
    "steps": 1000,
    "deadline_misses": 250,
    "bounds_relaxed_steps": 3,
}


def test_a_course_is_the_same_for_a_seed_and_valid(tmp_path):
    first, again, other = (course(VALUES, seed, 20.0, True) for seed in (1, 1, 2))
    assert first == again != other
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump(first))
    events = load_scenario(path).events
    kinds = {kind: [e for e in events if isinstance(e, kind)] for kind in (Push, EnableTorque)}
    goals = np.array([list(e.positions.values()) for e in events if isinstance(e, PostureGoal)])
    low, high = (np.array(VALUES[f"position_{end}"]) for end in ("min", "max"))
    assert (goals >= low).all() and (goals <= high).all()
    assert 0.4 < np.mean((goals == low) | (goals == high)) < 0.8
    far = [np.linalg.norm(e.position) for e in events if isinstance(e, PoseGoal)]
    assert min(far) < 0.8 and max(far) > 1.0  # m, in and out of reach
    forces = [np.linalg.norm(push.force) for push in kinds[Push]]
    assert 10.0 < max(forces) <= 20.0
    enabled = [event.enable for event in kinds[EnableTorque]]
    assert enabled[:4] == [False, True, False, True]
    without = course(VALUES, 1, 20.0, False)["events"]
    assert without == [event for event in first["events"] if "enable_torque" not in event]


@pytest.mark.parametrize(
    ("name", "kept", "told"),
    [
        ("lockstep", True, "kept"),
        ("cuts", False, "DIFFERS: a limit was passed"),
        ("real_time", False, fr3.machine()),
    ],
)
def test_a_row_has_a_verdict_where_limits_are_promised(name, kept, told):
    cells = row(name, [KEPT, KEPT | {"limits_kept": kept, "max_torque_ratio": 1.01}])
    assert len(cells) == len(HEADS)
    assert cells[0] == CASES[name].title and cells[-1] == told
    assert cells[1:][:3] == ("2", "0", "0") and cells[4] == "1.010"
    assert cells[6:10] == ("2000", "500", "0.750", "6")
