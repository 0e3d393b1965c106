# SPDX-License-Identifier: Apache-2.0
"""What `imperfect.py` (reproduction) does beside playing: scaling, courses, rows, the page."""

from dataclasses import replace

import imperfect
import imperfect_page
import numpy as np
import pytest
from imperfect import CASES, Course, node_values, scaled
from imperfect_page import Minute, Outcome

ROBOT = "baxter_left_arm"
EMPTY = "# Results\n\n<!-- imperfect -->\n<!-- /imperfect -->\n\n## Next\n"
KEPT = Minute(position=0.0, speed=0.0, torque=1.0, step=0.2, step_at_rest=0.01, stopped=0)
BROKEN = Minute(position=0.0, speed=1e-3, torque=0.8, step=0.1, step_at_rest=0.04, stopped=3)


def outcome(*minutes, hands=(1e-3, 2e-3), near=1e-4):
    return Outcome("title", list(minutes), list(hands), near)


def test_twice_as_bad_doubles_errors_and_halves_bandwidths():
    worse = scaled(
        {
            "encoder_resolution": [1e-4, 2e-4],
            "state_delay": 1,
            "missed_in_row": 4,
            "motor_bandwidth": [100.0],
            "velocity_filter_hz": 30.0,
            "missed_probability": 0.05,
            "velocity_source": "encoder",
        },
        2.0,
    )
    assert worse == {
        "encoder_resolution": [2e-4, 4e-4],
        "state_delay": 2,
        "missed_in_row": 8,
        "motor_bandwidth": [50.0],
        "velocity_filter_hz": 15.0,
        "missed_probability": 0.05,
        "velocity_source": "encoder",
    }
    assert isinstance(worse["state_delay"], int)


@pytest.mark.parametrize("robot", imperfect.ROBOTS)
def test_each_case_differs_as_its_title_says(robot):
    values = {name: node_values(robot, case, seed=3) for name, case in CASES.items()}
    robots = {name: each["bullet_node"] for name, each in values.items()}
    for name in imperfect.IDEAL:
        assert not robots[name].get("encoder_resolution") and not robots[name].get("state_delay")
    once, twice = (np.array(robots[name]["encoder_resolution"]) for name in ("all", "twice"))
    assert np.array_equal(twice, 2.0 * once) and once.any()
    assert robots["all"]["imperfection_seed"] == 3
    assert "estimator_node" not in values["nothing"] and "estimator_node" in values["all"]
    assert (
        values["no_margins"]["bounds_node"]["delay"] == 0 < values["all"]["bounds_node"]["delay"]
    )
    assert not values["no_observer"]["estimator_node"]["velocity_estimation"]
    stopping = robots["outage_stop"]
    assert stopping["outage_longest"] > stopping["command_timeout"]
    assert "outage_longest" not in robots["all"]
    # One robot and one model of it in all cases.
    for node in ("bullet_node", "bounds_node", "controller_node"):
        rotors = [each[node].get("rotor_inertia") for each in values.values()]
        assert rotors == rotors[:1] * len(rotors)


def test_a_course_is_the_same_for_a_seed_and_reaches_limits():
    values = node_values(ROBOT, CASES["all"], 0)["controller_node"]
    first, again, other = (Course(values, ROBOT, seed).scenario for seed in (1, 1, 2))
    assert first == again != other
    goals = np.array([list(e["posture"].values()) for e in first["events"] if "posture" in e])
    low, high = (np.array(values[f"position_{end}"]) for end in ("min", "max"))
    assert (goals >= low).all() and (goals <= high).all()
    share = np.mean((goals == low) | (goals == high))
    assert 0.3 < share < 0.7
    pushed = {event["push"]["link"] for event in first["events"] if "push" in event}
    assert pushed == set(imperfect.PUSHED[ROBOT])


def test_verdicts():
    ideal = 1e-3
    assert imperfect_page.verdict("nothing", outcome(BROKEN), ideal) == ""
    assert imperfect_page.verdict("all", outcome(KEPT), ideal) == "kept"
    assert "limit" in imperfect_page.verdict("outage_stop", outcome(KEPT, BROKEN), ideal)
    assert "hand" in imperfect_page.verdict("all", outcome(KEPT, hands=[3.1e-3]), ideal)
    assert imperfect_page.verdict("all", outcome(KEPT, hands=[4e-3], near=5e-3), ideal) == "kept"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Results and page go here."""
    monkeypatch.setattr(imperfect_page, "RESULTS", tmp_path)
    monkeypatch.setattr("figure.RESULTS", tmp_path)
    monkeypatch.setattr("figure.ROOT", tmp_path)
    monkeypatch.setattr(imperfect_page, "ROOT", tmp_path)
    (tmp_path / "docs" / "images").mkdir(parents=True)
    (tmp_path / "docs" / "results.md").write_text(EMPTY)
    return tmp_path


def played(robot, name, *minutes):
    one = replace(outcome(*minutes), title=CASES[name].title)
    imperfect_page.keep_outcome(robot, name, one)


def write(folder):
    titles = {name: case.title for name, case in CASES.items()}
    imperfect_page.write_page(imperfect.ROBOTS, titles, imperfect.PUSHED)
    return (folder / "docs" / "results.md").read_text()


def test_rows_of_earlier_runs_stay_and_are_replaced_by_new_ones(folder):
    played("panda", "all", KEPT)
    played(ROBOT, "all", BROKEN)
    played(ROBOT, "ideal", KEPT, KEPT)
    imperfect_page.keep(ROBOT, "costs", "ideal", {"times": [1.5, None, 2.5, 3.5], "left": 0.01})
    first = write(folder)
    assert first.index("## panda") < first.index(f"## {ROBOT}") < first.index("## Next")
    assert "DIFFERS: a limit was passed" in first and "| kept |" in first
    assert f"| {ROBOT}, nothing done | 1.50 | - | 2.50 | 3.50 | 10.0 |" in first
    played(ROBOT, "all", KEPT)
    second = write(folder)
    assert "DIFFERS" not in second
    assert second.split(f"## {ROBOT}")[0] == first.split(f"## {ROBOT}")[0]
    with np.load(folder / "imperfect" / "data.npz") as data:
        assert data[f"{ROBOT}_ideal_torque"].tolist() == [1.0, 1.0]
    # Rows whose numbers are not on this computer stay as the page has them.
    imperfect_page.kept_path(ROBOT).unlink()
    assert write(folder) == second
    for each in ("figure.png", "metrics.json"):
        assert (folder / "imperfect" / each).exists()


def test_nothing_is_written_before_anything_was_played(folder):
    assert write(folder) == EMPTY


def test_a_page_without_marks_is_refused(folder):
    played("panda", "all", KEPT)
    (folder / "docs" / "results.md").write_text("# Results\n")
    with pytest.raises(ValueError, match="docs/results.md has no part"):
        write(folder)
