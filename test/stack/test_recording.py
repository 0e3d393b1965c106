# SPDX-License-Identifier: Apache-2.0
"""A demo that is recorded, read by libraries that this project does not write with."""

import json
import re
import subprocess
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

ROOT = Path(__file__).resolve().parents[2]
LAYOUTS = ROOT / "config" / "layouts"
DURATION = 1.0

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record a scenario; return its folder, and what was recorded, by topic."""
    out = tmp_path_factory.mktemp("recorded")
    scenario = out / "reach.yaml"
    scenario.write_text(
        f"""
        duration: {DURATION}
        events:
          - time: 0.0
            pose: {{position: [0.5, 0.2, 0.4], orientation: [1.0, 0.0, 0.0, 0.0]}}
          - time: 0.5
            push: {{link: panda_link4, duration: 0.5, force: [0.0, 20.0, 0.0]}}
        """
    )
    command = ["bash", "scripts/demo.sh", "panda", scenario, "--record", "--out", out]
    subprocess.run(command, cwd=ROOT, check=True, timeout=600, capture_output=True)
    messages = defaultdict(list)
    with (out / "recording.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, entry, message in reader.iter_decoded_messages():
            messages[channel.topic].append((entry.log_time, message))
    return out, messages


def test_a_recording_has_what_the_figures_are_made_of(recorded):
    out, messages = recorded
    data = np.load(out / "data.npz")
    n = data["q"].shape[1]
    states = {time: message for time, message in messages["/joint_states"]}
    first = max(states) - round(1e9 * data["t"][-1])
    stamps = [first + round(1e9 * t) for t in data["t"]]
    q = np.array([list(states[stamp].position)[:n] for stamp in stamps])
    assert np.array_equal(q, data["q"])
    commands = {time: message for time, message in messages["/joint_commands"]}
    nan = [np.nan] * n
    tau = np.array([list(commands[s].effort) if s in commands else nan for s in stamps])
    assert np.array_equal(tau, data["tau"], equal_nan=True)
    assert np.isfinite(tau).mean() > 0.5  # on a busy machine some are not heard


def test_a_recording_has_goals_pushes_and_the_robot(recorded):
    _, messages = recorded
    assert [m.pose.position.x for _, m in messages["/target_pose"]] == [0.5]
    assert [m.wrench.force.y for _, m in messages["/external_wrench"]] == [20.0, 0.0]
    assert "<robot" in messages["/robot_description"][0][1].data
    assert messages["/diagnostics"] and messages["/hand_pose"] and messages["/limit_distances"]
    # All on one clock, that of the robot. At the end of a recording answers to the last states may
    # have been heard before these.
    times = [time for topic in messages.values() for time, _ in topic]
    states = [time for time, _ in messages["/joint_states"]]
    assert min(states) - 1e9 < min(times) <= max(times) <= max(states) + 2e7


def test_the_layout_of_foxglove_shows_what_is_recorded(recorded):
    _, messages = recorded
    layout = json.loads((LAYOUTS / "foxglove.json").read_text())
    panels = layout["configById"]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert len(paths) > 20
    for path in paths:
        topic, *fields = re.findall(r"/\w+|\.\w+|\[\d+\]", path)
        value = messages[topic][-1][1]
        for field in fields:
            value = value[int(field[1:-1])] if field[0] == "[" else getattr(value, field[1:])
        assert isinstance(value, float)
    assert set(panels["3D!arm"]["topics"]) <= set(messages)


def test_the_layout_of_plotjuggler_shows_what_is_recorded(recorded):
    _, messages = recorded
    root = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) > 20
    for curve in curves:
        topic, name, field = re.fullmatch(r"(/\w+)/([\w\[\]]+)/([\w\[\]]+)", curve).groups()
        message = messages[topic][-1][1]
        if topic == "/acceleration_limits":  # as arrays; the others by the names of joints
            assert re.fullmatch(r"points\[[01]\]", name)
            assert int(re.fullmatch(r"accelerations\[(\d)\]", field)[1]) < 7
        else:
            assert len(getattr(message, field)) > message.name.index(name)
