# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from sim_bridge.scenario.events import (
    AddObstacle,
    EnableTorque,
    ParameterChange,
    PoseGoal,
    PostureGoal,
    Push,
    RemoveObstacle,
    ScenarioError,
    TriggerCall,
    WrenchGoal,
)
from sim_bridge.scenario.scenario import load_scenario

SCENARIOS = Path(__file__).resolve().parents[2] / "config" / "scenarios"


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


def test_every_kind_of_event_is_read(tmp_path):
    scenario = load_scenario(
        write(
            tmp_path,
            """
duration: 9
events:
  - {time: 0, wrench: {force: [0, 0, -10]}}
  - {time: 1, obstacle: {name: pole, shape: cylinder, size: [0.1, 0.1, 1], position: [1, 0, 0]}}
  - {time: 2, remove_obstacle: {name: pole}}
  - {time: 3, enable_torque: false}
  - {time: 4, parameters: {node: n, values: {a: 1, b: [1, 2.5], c: x, d: true, e: [x, y]}}}
  - {time: 5, call: {service: controller_node/tare_ft_sensor}}
  - {time: 6, push: {link: a, duration: 2, force: [0, 0, 1]}}
  - {time: 6.5, push: {link: b, duration: 2, force: [0, 0, 1]}}
  - {time: 8, push: {link: a, duration: 2, force: [0, 0, 1]}}
""",
        )
    )
    wrench, pole, gone, position, change, call, *_ = scenario.events
    assert wrench == WrenchGoal(0.0, (0.0, 0.0, -10.0), (0.0, 0.0, 0.0), "")
    assert isinstance(pole, AddObstacle)
    assert (pole.obstacle.name, pole.obstacle.shape) == ("pole", "cylinder")
    assert pole.obstacle.size.tolist() == [0.1, 0.1, 1.0]
    assert pole.obstacle.orientation.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert gone == RemoveObstacle(2.0, "pole")
    assert position == EnableTorque(3.0, False)
    values = {"a": 1, "b": [1.0, 2.5], "c": "x", "d": True, "e": ["x", "y"]}
    assert change == ParameterChange(4.0, "n", values)
    assert call == TriggerCall(5.0, "controller_node/tare_ft_sensor")


def test_a_circle_starts_where_it_is_told_and_leads_around(tmp_path):
    text = """
duration: 9
events:
  - time: 0
    trajectory:
      circle: {start: [1, 2, 3], diameter: 0.4, plane: [x, y], phase: 1.5707963267948966,
        period: 4, orientation: [0, 0, 0, 1]}
"""
    points = load_scenario(write(tmp_path, text)).events[0].trajectory.points
    np.testing.assert_allclose(points[0].pose.translation, [1.0, 2.0, 3.0], atol=1e-15)
    half = points[len(points) // 2].pose.translation
    np.testing.assert_allclose(half, [1.0, 1.6, 3.0], atol=1e-12)


CIRCLE = "start: [0, 0, 0], diameter: 1, plane: [y, z], period: 1, orientation: [0, 0, 0, 1]"
POINT = "position: [0, 0, 0], orientation: [0, 0, 0, 1]"
OVAL = "sphere, size: [1, 1, 2]"
BOX = "name: a, shape: box, size: [1, 1, 1], position: [0, 0, 0]"


@pytest.mark.parametrize(
    ("kind", "content", "names"),
    [
        ("trajectory", "{}", "exactly one of points, circle"),
        ("trajectory", "{circle: 1}", "trajectory.circle"),
        ("trajectory", "{points: []}", "at least one point"),
        ("trajectory", "{points: [1]}", "points[0]"),
        ("trajectory", f"{{points: [{{time: 0, {POINT}, speed: 1}}]}}", "points[0] has speed"),
        ("trajectory", f"{{points: [{{time: 0, {POINT}, velocity: [1]}}]}}", "points[0].velocity"),
        (
            "trajectory",
            f"{{points: [{{time: 1, {POINT}}}, {{time: 1, {POINT}}}]}}",
            "trajectory.points[1].time is 1; allowed: more than 1",
        ),
        (
            "trajectory",
            f"{{points: [{{time: 0, {POINT}}}, "
            "{time: 1, position: [0, 0, 0], orientation: [1, 0, 0, 0]}]}",
            "trajectory.points[1] is turned by 3.14 rad from the last one",
        ),
        (
            "trajectory",
            f"{{circle: {{{CIRCLE.replace('r: 1', 'r: -1')}}}}}",
            "circle.diameter",
        ),
        ("trajectory", f"{{circle: {{{CIRCLE.replace('[y, z]', '[y, -y]')}}}}}", "circle.plane"),
        ("trajectory", f"{{circle: {{{CIRCLE.replace('[y, z]', '[y, w]')}}}}}", "two of x, y, z"),
        ("trajectory", f"{{circle: {{{CIRCLE}, turns: 0}}}}", "circle.turns"),
        ("trajectory", f"{{circle: {{{CIRCLE}, colour: 1}}}}", "circle has colour"),
        ("wrench", "{force: [1, 2]}", "wrench.force"),
        ("wrench", "{frame: 1}", "wrench.frame"),
        ("obstacle", f"{{{BOX.replace('box', 'cone')}}}", "none of box, sphere, cylinder"),
        (
            "obstacle",
            f"{{{BOX.replace('box, size: [1, 1, 1]', OVAL)}}}",
            "round",
        ),
        ("obstacle", f"{{{BOX}, size: [1, 1, 0]}}", "size"),
        ("obstacle", f"{{{BOX}, mass: 1}}", "obstacle has mass"),
        ("remove_obstacle", "{name: a}", "names 'a'; there are: none"),
        ("enable_torque", "1", "true or false"),
        ("parameters", "{values: {a: 1}}", "parameters.node"),
        ("parameters", "{node: [1, 2.0], values: {a: 1}}", "parameters.node"),
        ("parameters", "{node: n, values: {}}", "parameters.values"),
        ("parameters", "{node: n, values: {a: [1, x]}}", "values.a"),
        ("parameters", "{node: n, values: {a: [true]}}", "values.a"),
        ("call", "{}", "call.service"),
        ("call", "{service: a, type: reboot}", "has type; allowed: service"),
    ],
)
def test_an_event_that_cannot_be_is_named(tmp_path, kind, content, names):
    text = f"duration: 1\nevents: [{{time: 0.5, {kind}: {content}}}]"
    with pytest.raises(ScenarioError) as error:
        load_scenario(write(tmp_path, text))
    assert names in str(error.value)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "the file is None; allowed: fields and their values"),
        ("duration: [", "scenario"),
        ("events: []", "duration"),
        ("duration: -1", "duration"),
        ("duration: .nan", "duration"),
        ("duration: true", "duration"),
        ("duration: 1e999", "duration"),
        ("duration: 1" + 400 * "0", "duration"),
        ("[1, 2]", "the file is [1, 2]; allowed: fields"),
        ("duration: 1\ngoals: []", "the file has goals; allowed: duration, events"),
        ("duration: 1\nevents: {time: 0}", "events"),
        ("duration: 1\nevents: 5", "events"),
        ("duration: 1\nevents: [5]", "events[0]"),
        ("duration: 1\nevents: [{time: .inf, posture: {a: 0}}]", "events[0].time"),
        ("duration: 1\nevents: [{time: 0, posture: 1}]", "events[0]"),
        ("duration: 1\nevents: [{time: 0, push: {duration: 1}}]", "link"),
        ("duration: 1\nevents: [{time: 0, push: {link: a, duration: 1, force: 1}}]", "force"),
        ("duration: 1\nevents: [{time: 0}]", "events[0]"),
        ("duration: 1\nevents: [{time: 1, posture: {a: 0}}]", "less than 1, the end"),
        (
            "duration: 9\nevents: [{time: 0, push: {link: a, duration: 2, force: [1, 0, 0]}}, "
            "{time: 1, push: {link: a, duration: 2, force: [1, 0, 0]}}]",
            "the push of a at 1 s begins before",
        ),
        ("duration: 1\nevents: [{time: 0, dance: {}}]", "events[0]"),
        ("duration: 1\nevents: [{time: -1, posture: {a: 0}}]", "events[0].time"),
        ("duration: 1\nevents: [{time: 0, posture: {a: x}}]", "events[0].posture.a"),
        ("duration: 1\nevents: [{time: 0, pose: {position: [0, 0]}}]", "position"),
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
