# SPDX-License-Identifier: Apache-2.0
"""What `reproduce.sh imperfect` does beside playing: cases, courses, rows, the page."""

import figure
import imperfect
import numpy as np
import pytest
from imperfect import CASES, Course, Minute, node_values, row

ROBOT = "baxter_left_arm"
KEPT = Minute(position=0.0, speed=0.0, torque=1.0, step_at_rest=0.01)
BROKEN = Minute(position=0.0, speed=1e-3, torque=0.8, step_at_rest=0.04)


@pytest.mark.parametrize("robot", imperfect.ROBOTS)
def test_each_case_differs_as_its_title_says(robot):
    values = {name: node_values(robot, case, seed=3) for name, case in CASES.items()}
    robots = {name: each["bullet_node"] for name, each in values.items()}
    ideal = robots["ideal"]
    assert not ideal.get("encoder_resolution") and not ideal.get("state_delay")
    assert robots["all"]["imperfection_seed"] == 3
    once, twice = (robots[name] for name in ("all", "twice"))
    for name, factor in {"encoder_resolution": 2.0, "motor_bandwidth": 0.5}.items():
        np.testing.assert_allclose(twice[name], factor * np.array(once[name]))
    delays = [each["state_delay"] + each["command_delay"] for each in (once, twice)]
    assert delays[1] == 2 * delays[0] > 0
    assert "estimator_node" not in values["nothing"] and "estimator_node" in values["all"]
    declared = [values[name]["bounds_node"]["delay"] for name in ("no_margins", "all")]
    assert declared[0] == 0 < declared[1]
    assert not values["no_observer"]["estimator_node"]["velocity_estimation"]
    stopping = robots["outage_stop"]
    assert stopping["outage_longest"] > stopping["command_timeout"]
    assert "outage_longest" not in once


def test_a_course_is_the_same_for_a_seed_and_reaches_limits():
    values = node_values(ROBOT, CASES["all"], 0)["controller_node"]
    first, again, other = (Course(values, ROBOT, seed).scenario for seed in (1, 1, 2))
    assert first == again != other
    goals = np.array([list(e["posture"].values()) for e in first["events"] if "posture" in e])
    low, high = (np.array(values[f"position_{end}"]) for end in ("min", "max"))
    assert (goals >= low).all() and (goals <= high).all()
    assert 0.3 < np.mean((goals == low) | (goals == high)) < 0.7
    pushed = {event["push"]["link"] for event in first["events"] if "push" in event}
    assert pushed == set(imperfect.PUSHED[ROBOT])


@pytest.mark.parametrize(
    ("name", "minutes", "hands", "told"),
    [
        ("nothing", [BROKEN], [1e-3], ""),
        ("all", [KEPT], [1e-3, 2e-3], "kept"),
        ("outage_stop", [KEPT, BROKEN], [1e-3], "DIFFERS: a limit was passed"),
        ("all", [KEPT], [4e-3], "DIFFERS: hand at rest"),
    ],
)
def test_a_row_has_the_worst_of_its_minutes_and_a_verdict(name, minutes, hands, told):
    cells = row(name, minutes, hands, allowed=3e-3)
    assert len(cells) == len(imperfect.HEADS)
    assert cells[:2] == (CASES[name].title, str(len(minutes)))
    assert float(cells[3]) == max(minute.speed for minute in minutes)
    assert cells[-1] == told


def test_rows_that_are_not_played_stay_on_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(figure, "DOCS", tmp_path)
    page = tmp_path / "results.md"
    page.write_text("# Results\n\n<!-- imperfect -->\n<!-- /imperfect -->\n\n## Next\n")
    panda = row("all", [KEPT], [1e-3], 1.0)
    imperfect.write_page({("panda", panda[0]): panda})
    rows = figure.page_rows("imperfect")
    assert rows["panda", panda[0]] == panda
    own = row("ideal", [BROKEN], [1e-3], 1.0)
    imperfect.write_page(rows | {(ROBOT, own[0]): own})
    found = figure.page_rows("imperfect")
    assert found["panda", panda[0]] == panda and found[ROBOT, own[0]] == own
    assert page.read_text().endswith("<!-- /imperfect -->\n\n## Next\n")
    page.write_text("# Results\n")
    with pytest.raises(ValueError, match=r"docs/results.md has no part"):
        imperfect.write_page(rows)
