# SPDX-License-Identifier: Apache-2.0
"""Scenario files: what is read, and what is refused with the place in the file."""

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
from viability_bounds_pkg.testing.ros_harness import config_folder


def load(directory, text):
    path = directory / "scenario.yaml"
    path.write_text(text)
    return load_scenario(path)


def test_shipped_scenarios_load():
    paths = sorted((config_folder() / "scenarios").glob("*.yaml"))
    assert len(paths) > 5
    for path in paths:
        assert load_scenario(path).events, path


def test_every_kind_of_event_is_read_and_put_in_order(tmp_path):
    scenario = load(
        tmp_path,
        """
duration: 9
events:
  - {time: 1, obstacle: {name: pole, shape: cylinder, size: [0.1, 0.1, 1], position: [1, 0, 0]}}
  - {time: 0, wrench: {force: [0, 0, -10]}}
  - {time: 2, remove_obstacle: {name: pole}}
  - {time: 3, enable_torque: false}
  - {time: 4, parameters: {node: n, values: {a: 1, b: [1, 2.5], c: x, d: true, e: [x, y]}}}
  - {time: 5, call: {service: controller_node/tare_ft_sensor}}
  - {time: 6, push: {link: a, duration: 2, force: [0, 0, 1]}}
  - {time: 6.5, push: {link: b, duration: 0.5, force: [0, 0, 1]}}
  - {time: 8, push: {link: a, duration: 1, force: [0, 0, 1]}}
  - {time: 0.5, pose: {position: [0, 0, 1], orientation: [0, 0, 0, 1]}}
  - {time: 0.6, posture: {a: 0.5, b: -1}}
""",
    )
    wrench, pose, posture, pole, gone, position, change, call, push, *_ = scenario.events
    assert wrench == WrenchGoal(0.0, (0.0, 0.0, -10.0), (0.0, 0.0, 0.0), "")
    assert pose == PoseGoal(0.5, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    assert posture == PostureGoal(0.6, {"a": 0.5, "b": -1.0})
    assert isinstance(pole, AddObstacle)
    assert (pole.obstacle.name, pole.obstacle.shape) == ("pole", "cylinder")
    assert pole.obstacle.size.tolist() == [0.1, 0.1, 1.0]
    assert gone == RemoveObstacle(2.0, "pole")
    assert position == EnableTorque(3.0, False)
    values = {"a": 1, "b": [1.0, 2.5], "c": "x", "d": True, "e": ["x", "y"]}
    assert change == ParameterChange(4.0, "n", values)
    assert call == TriggerCall(5.0, "controller_node/tare_ft_sensor")
    assert push == Push(6.0, 2.0, "a", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def test_a_circle_starts_where_it_is_told_and_leads_around(tmp_path):
    text = """
duration: 9
events:
  - time: 0
    trajectory:
      circle: {start: [1, 2, 3], diameter: 0.4, plane: [x, y], phase: 1.5707963267948966,
        period: 4, orientation: [0, 0, 0, 1]}
"""
    points = load(tmp_path, text).events[0].trajectory.points
    np.testing.assert_allclose(points[0].pose.translation, [1.0, 2.0, 3.0], atol=1e-15)
    half = points[len(points) // 2].pose.translation
    np.testing.assert_allclose(half, [1.0, 1.6, 3.0], atol=1e-12)


CIRCLE = "start: [0, 0, 0], diameter: 1, plane: [y, z], period: 1, orientation: [0, 0, 0, 1]"
POINT = "position: [0, 0, 0], orientation: [0, 0, 0, 1]"
TURNED = "position: [0, 0, 0], orientation: [1, 0, 0, 0]"
BOX = "name: a, shape: box, size: [1, 1, 1], position: [0, 0, 0]"


def points(*given):
    return f"{{points: [{', '.join(f'{{time: {k}, {each}}}' for k, each in enumerate(given))}]}}"


def circle(before="", after=""):
    return f"{{circle: {{{CIRCLE.replace(before, after)}}}}}"


@pytest.mark.parametrize(
    ("kind", "content", "names"),
    [
        ("trajectory", "{}", "exactly one of points, circle"),
        ("trajectory", points(), "at least one point"),
        ("trajectory", points(f"{POINT}, speed: 1"), "points[0] has speed"),
        ("trajectory", points(POINT, TURNED), "points[1] is turned by 3.14 rad from the last one"),
        ("trajectory", circle("r: 1", "r: -1"), "circle.diameter"),
        ("trajectory", circle("[y, z]", "[y, -y]"), "circle.plane"),
        ("trajectory", circle("period: 1", "period: 1.0e-300"), "circle.period"),
        ("trajectory", circle("period: 1", "period: 1, turns: 1.0e9"), "circle.turns"),
        ("wrench", "{force: [1, 2]}", "wrench.force"),
        ("obstacle", f"{{{BOX.replace('box', 'cone')}}}", "none of box, sphere, cylinder"),
        ("remove_obstacle", "{name: a}", "names 'a'; there are: none"),
        ("enable_torque", "1", "true or false"),
        ("parameters", "{values: {a: 1}}", "parameters.node"),
        ("parameters", "{node: n, values: {a: [1, x]}}", "values.a"),
        ("call", "{}", "call.service"),
        ("posture", "{a: x}", "events[0].posture.a"),
        ("pose", "{position: [0, 0, .inf], orientation: [0, 0, 0, 1]}", "pose.position"),
        ("push", "{duration: 1, force: [1, 0, 0]}", "push.link"),
        ("push", "{link: a, duration: 0, force: [1, 0, 0]}", "push.duration"),
        ("dance", "{}", "events[0]"),
    ],
)
def test_an_event_that_cannot_be_is_named(tmp_path, kind, content, names):
    with pytest.raises(ScenarioError) as error:
        load(tmp_path, f"duration: 1\nevents: [{{time: 0.5, {kind}: {content}}}]")
    assert names in str(error.value)


POSTURE = "{time: 1, posture: {a: 0}}"
PUSH = "push: {link: a, duration: 2, force: [1, 0, 0]}"


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "the file is None; allowed: fields and their values"),
        ("duration: [", "scenario"),
        ("events: []", "duration"),
        ("duration: .nan", "duration"),
        ("duration: 1" + 400 * "0", "duration"),
        ("duration: 1\nevents: {time: 0}", "events"),
        ("duration: 1\nevents: [{time: -1, posture: {a: 0}}]", "events[0].time"),
        ("duration: 1\nevents: [{time: 1, posture: {a: 0}}]", "less than 1, the end"),
        (
            f"duration: 9\nevents: [{{time: 0, {PUSH}}}, {{time: 1, {PUSH}}}]",
            "the push of a at 1 s begins before",
        ),
        (f"duration: 9\nevents: [{POSTURE}, {POSTURE}]", "two of posture at 1 s; allowed: one"),
    ],
)
def test_a_file_that_cannot_be_played_is_named(tmp_path, text, names):
    with pytest.raises(ScenarioError) as error:
        load(tmp_path, text)
    assert names in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ScenarioError, match=r"none\.yaml"):
        load_scenario(tmp_path / "none.yaml")
