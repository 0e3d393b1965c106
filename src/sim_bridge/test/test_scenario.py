from pathlib import Path

import pytest

from sim_bridge.scenario import PoseGoal, PostureGoal, Push, ScenarioError, load_scenario

SCENARIOS = Path(__file__).resolve().parents[3] / "config" / "scenarios"


def write(directory, text):
    path = directory / "scenario.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenarios_load(path):
    scenario = load_scenario(path)
    assert scenario.duration > 0.0
    assert scenario.events
    assert all(event.time < scenario.duration for event in scenario.events)


def test_events_come_in_order_of_time(tmp_path):
    scenario = load_scenario(
        write(
            tmp_path,
            """
duration: 3
events:
  - {time: 2, push: {link: hand, duration: 0.5, force: [1, 0, 0]}}
  - {time: 1.5, posture: {a: 0.5, b: -1}}
  - {time: 0, pose: {position: [0, 0, 1], orientation: [0, 0, 0, 1]}}
""",
        )
    )
    pose, posture, push = scenario.events
    assert pose == PoseGoal(0.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    assert posture == PostureGoal(1.5, {"a": 0.5, "b": -1.0})
    assert push == Push(2.0, 0.5, "hand", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "keys"),
        ("duration: [", "scenario"),
        ("events: []", "duration"),
        ("duration: -1", "duration"),
        ("duration: .nan", "duration"),
        ("duration: true", "duration"),
        ("duration: 1e999", "duration"),
        ("duration: 1" + 400 * "0", "duration"),
        ("[1, 2]", "keys"),
        ("duration: 1\ngoals: []", "keys"),
        ("duration: 1\nevents: {time: 0}", "events"),
        ("duration: 1\nevents: 5", "events"),
        ("duration: 1\nevents: [5]", "events[0]"),
        ("duration: 1\nevents: [{time: .inf, posture: {a: 0}}]", "events[0].time"),
        ("duration: 1\nevents: [{time: 0, posture: 1}]", "events[0]"),
        ("duration: 1\nevents: [{time: 0, push: {duration: 1}}]", "link"),
        ("duration: 1\nevents: [{time: 0, push: {link: a, duration: 1, force: 1}}]", "force"),
        ("duration: 1\nevents: [{time: 0}]", "events[0]"),
        ("duration: 1\nevents: [{time: 0, dance: {}}]", "events[0]"),
        ("duration: 1\nevents: [{time: -1, posture: {a: 0}}]", "events[0].time"),
        ("duration: 1\nevents: [{time: 0, posture: {a: x}}]", "events[0].posture.a"),
        ("duration: 1\nevents: [{time: 0, pose: {position: [0, 0]}}]", "orientation"),
        (
            "duration: 1\nevents: [{time: 0, pose: {position: [0, 0, 0], "
            "orientation: [0, 0, 0, 2]}}]",
            "norm",
        ),
        (
            "duration: 1\nevents: [{time: 0, pose: {position: [0, 0, .inf], "
            "orientation: [0, 0, 0, 1]}}]",
            "position",
        ),
        ("duration: 1\nevents: [{time: 0, push: {link: a, duration: 0}}]", "duration"),
        ("duration: 1\nevents: [{time: 0, push: {link: a, duration: 1, load: 2}}]", "load"),
    ],
)
def test_what_cannot_be_played_is_named(tmp_path, text, names):
    with pytest.raises(ScenarioError) as error:
        load_scenario(write(tmp_path, text))
    assert names in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ScenarioError, match="none.yaml"):
        load_scenario(tmp_path / "none.yaml")
