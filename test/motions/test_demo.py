# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it, and its scenarios without messages between the nodes."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from direct import DirectLoop, column, hand_errors

from sim_bridge.scenario.events import ParameterChange, PoseGoal, Push
from sim_bridge.scenario.scenario import load_scenario
from viability_bounds_pkg.node.bounds_parameters import METHODS
from viability_bounds_pkg.testing.executables import as_child, run_to_end

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "scripts" / "demo.sh"
SCENARIOS = ROOT / "config" / "scenarios"


def demo(*arguments):
    return run_to_end("bash", DEMO, *arguments)


def first_goal(directory, robot):
    """Write the beginning of a robot's demo to a file; return its path."""
    scenario = yaml.safe_load((SCENARIOS / f"{robot}_demo.yaml").read_text())
    path = directory / "first_goal.yaml"
    path.write_text(yaml.safe_dump({"duration": 1.0, "events": scenario["events"][:1]}))
    return path


def test_naive_bounds_break_the_elbow_and_say_so(tmp_path):
    path = first_goal(tmp_path, "baxter_left_arm")  # it leads to the limit
    options = ("--bounds", "naive", "--lockstep", "--out", tmp_path)
    result = demo("baxter_left_arm", path, *options)
    assert result.returncode == 1, result.stdout + result.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["max_position_violation_rad"] > 0.01
    assert metrics["most_violated_joint"] == "left_e1"
    assert "BROKEN" in result.stdout
    assert "left_e1" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["no_such_robot"], "no_such_robot"),
        (["panda", "no_such_scenario"], "no_such_scenario"),
        (["--no-such-option"], "--no-such-option"),
        (["panda", "demo", "more"], "more"),
        (["--bounds", "guessed"], "--bounds is 'guessed'"),
        (["--rate", "abc"], "--rate is 'abc'"),
        (["--rate", "-1"], "--rate is '-1'"),
        (["--rate", "0"], "--rate is '0'"),
        (["--rate", "0.0"], "--rate is '0.0'"),
        (["--rate", "10001"], "--rate is '10001'"),
        (["--rate", ""], "--rate is ''"),
        (["--params", "no/such.yaml"], "no/such.yaml"),
        (["--rate"], "--rate needs a value"),
    ],
)
def test_what_it_cannot_play_is_refused_in_one_line(tmp_path, arguments, names):
    result = demo("--out", tmp_path, *arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    (error,) = result.stderr.splitlines()
    assert error.startswith("error: ")
    assert names in error


@pytest.mark.long
def test_an_imperfect_robot_may_have_further_parameters(tmp_path):
    """At half the rate its own filter passes too much: both files are read."""
    further = tmp_path / "further.yaml"
    further.write_text("/**: {ros__parameters: {rate_hz: 150.0}}")
    result = demo("panda", "--imperfect", "--params", str(further), "--out", str(tmp_path))
    assert result.returncode == 2
    line = "parameter 'velocity_filter_hz' is 100; allowed: a number below half of rate_hz, 75"
    assert line in result.stderr


@pytest.mark.long
@pytest.mark.parametrize("apart", [[], ["--processes"]], ids=["one process", "processes"])
def test_an_imperfect_robot_is_played_with_what_is_done_about_it(tmp_path, apart):
    path = first_goal(tmp_path, "panda")
    result = demo("panda", path, "--imperfect", "--out", tmp_path, *apart)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "VERDICT: no limit was broken" in result.stdout
    assert "estimated_joint_states" not in result.stderr  # nobody misses them
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["deadline_misses"] == metrics["braked_periods"] == 0
    assert max(joint["max_speed_ratio"] for joint in metrics["joints"].values()) > 0.5


def test_it_knows_the_bounds_there_are():
    assert f"\n{' | '.join(METHODS)}) ;;\n" in DEMO.read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("when", "sent", "apart"),
    [
        ("nodes start", signal.SIGTERM, ["--processes"]),
        ("it runs", signal.SIGINT, []),
    ],
)
def test_a_signal_takes_down_all_of_it(tmp_path, when, sent, apart):
    environment = os.environ | {"DEMO_UNDER_TEST": str(tmp_path)}
    process = subprocess.Popen(
        ["bash", DEMO, "talos_left_arm", "--out", tmp_path, *apart],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=as_child,
    )

    def nodes():
        return [pid for pid in started_by(environment["DEMO_UNDER_TEST"]) if pid != process.pid]

    try:
        if when == "nodes start":
            deadline = time.monotonic() + 60.0
            while len(nodes()) < (4 if apart else 2) and process.poll() is None:
                assert time.monotonic() < deadline, "the nodes did not start"
        else:
            assert any("TRACKING" in line for line in process.stdout)
        process.send_signal(sent)
        _, errors = process.communicate(timeout=30)
        assert process.returncode == 130, errors
        assert nodes() == []
        assert "Traceback" not in errors
        assert "Error" not in errors
        assert "FATAL" not in errors
    finally:
        process.kill()
        for pid in nodes():
            os.kill(pid, signal.SIGKILL)


def started_by(mark):
    """Return the nodes whose environment names a mark."""
    found = []
    for path in Path("/proc").iterdir():
        if path.name.isdigit():
            try:
                if b"/lib/" in (path / "cmdline").read_bytes() and (
                    f"DEMO_UNDER_TEST={mark}\0".encode() in (path / "environ").read_bytes()
                ):
                    found.append(int(path.name))
            except OSError:  # gone, or another user's
                continue
    return found


def begin(loop, event):
    """Let an event of a scenario take effect."""
    match event:
        case PoseGoal():
            rotation = pin.Quaternion(np.array(event.orientation)).toRotationMatrix()
            loop.controller.goals.set_pose(pin.SE3(rotation, np.array(event.position)))
        case Push():
            loop.robot.apply_wrench(event.link, event.force, event.torque)
        case ParameterChange():
            loop.change(**event.values)


def play(robot, name, changed):
    """Return the loop and the samples of a scenario that is shipped, from begin to end."""
    scenario = load_scenario(SCENARIOS / f"{robot}_{name}.yaml")
    loop = DirectLoop(robot, changed)
    pushes = [event for event in scenario.events if isinstance(event, Push)]

    def each(t):
        now = round(t / loop.dt)
        for push in pushes:
            if now == round((push.time + push.duration) / loop.dt):
                loop.robot.clear_wrenches()
        for event in scenario.events:
            if now == round(event.time / loop.dt):
                begin(loop, event)

    return loop, loop.run(scenario.duration, each)


@pytest.mark.long
@pytest.mark.parametrize(
    ("robot", "changed", "remains", "near"),
    [
        ("panda", {}, 1e-3, 5e-3),
        # With friction, and a margin for torques that are held.
        ("talos_left_arm", {}, 5e-3, 0.02),
    ],
)
def test_other_demos_go_to_a_limit_and_break_none(robot, changed, remains, near):
    loop, samples = play(robot, "demo", changed)
    monitor = loop.robot.monitor
    assert monitor.max_position_violation.max() <= 1e-9
    assert monitor.max_velocity_violation.max() <= 1e-9
    assert monitor.max_torque_ratio.max() <= 1.0 + 1e-9
    assert [error[-1] < remains for error in hand_errors(samples)] == [True, True]
    assert min(monitor.closest_to_q_min.min(), monitor.closest_to_q_max.min()) < near


def values_at_start(robot, name):
    """Return what a scenario's nodes are given at their start."""
    file = yaml.safe_load((SCENARIOS / "start" / f"{robot}_{name}.yaml").read_text())
    return file["/**/controller_node"]["ros__parameters"]


@pytest.mark.long
def test_a_pushed_elbow_gives_way_and_the_hand_stays():
    own, moved = values_at_start("talos_left_arm", "push_elbow"), {}
    for name, changed in (("stiff", {}), ("compliant", own)):
        loop, samples = play("talos_left_arm", "push_elbow", changed)
        assert not loop.robot.monitor.violated
        t, q = column(samples, "t"), column(samples, "q")
        moved[name] = np.ptp(q[(t > 0.9) & (t < 4.9)], axis=0).max()
        assert hand_errors(samples)[0].max() < 3e-3
    assert moved["compliant"] > 10.0 * moved["stiff"]


@pytest.mark.long
def test_with_a_page_the_scenario_is_played_once_where_there_is_no_terminal(tmp_path):
    path = first_goal(tmp_path, "panda")
    result = demo("panda", path, "--view", "--out", tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "the arm is at http://127.0.0.1:" in result.stdout
    assert "no limit was broken" in result.stdout
