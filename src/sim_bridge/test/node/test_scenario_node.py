# SPDX-License-Identifier: Apache-2.0
import signal
import subprocess

import numpy as np
import yaml
from ament_index_python.packages import get_package_prefix
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from sim_bridge.node import scenario_node
from viability_bounds_pkg.ros.runtime import NEWEST_QOS
from viability_bounds_pkg.testing.executables import as_child, called
from viability_bounds_pkg.testing.ros_harness import (
    acceleration_limits,
    config_folder,
    joint_state,
    read_config,
)

DEADLINE = 60.0  # s


def arguments(directory, *parameters):
    """Return the command's, for a scenario in which nothing happens."""
    path = directory / "scenario.yaml"
    path.write_text(yaml.safe_dump({"duration": 1.0, "events": []}))
    words = ["--ros-args", "--params-file", str(config_folder() / "panda.yaml")]
    for parameter in (f"scenario:={path}", *parameters):
        words += ["-p", parameter]
    return words


def called_with(capfd, *words):
    """Return how the node ended in this process, and its only line of errors."""
    ended = called(capfd, scenario_node.main, "scenario_node", *words)
    (line,) = ended.stderr.strip().splitlines()
    return ended.returncode, line


def test_an_output_must_be_named(capfd):
    code, line = called_with(capfd, "--out")
    assert code == 2
    assert "--out" in line


def test_it_gives_up_when_nobody_answers(capfd, tmp_path):
    code, line = called_with(capfd, *arguments(tmp_path, "ready_timeout:=0.3"))
    assert code == 2
    assert line.startswith("error: nothing has moved for 0.3 s (getting ready: there is no paused")


def test_states_alone_are_no_progress_towards_the_start(ros, tmp_path):
    """A robot that cannot pause goes on while a node does not start."""
    arguments(tmp_path)
    values = read_config("panda", "scenario_node")
    node = ros.start(
        scenario_node.ScenarioNode, values | {"scenario": str(tmp_path / "scenario.yaml")}
    )
    states, rest = ros.talk(JointState, "joint_states"), np.zeros(7)
    reached = set()
    for stamp in (10, 20):  # ns
        state = joint_state(values["joints"], stamp, q=rest, v=rest)
        ros.wait_until(
            lambda expected=stamp: node.recorder.stamp == expected and node.awaits,
            each=lambda sent=state: states.publish(sent),
        )
        reached.add(node.reached[1])
    assert len(reached) == 1


def test_told_to_stop_it_judges_nothing(tmp_path):
    executable = f"{get_package_prefix('sim_bridge')}/lib/sim_bridge/scenario_node"
    words = [executable, "--out", str(tmp_path / "out"), *arguments(tmp_path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        words, stdout=pipe, stderr=pipe, text=True, preexec_fn=as_child
    ) as process:
        assert "waiting" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert not (tmp_path / "out").exists()


def test_a_recording_has_a_row_for_each_period_and_tells_the_robot_what_it_has(ros, tmp_path):
    arguments(tmp_path)
    values = read_config("panda", "scenario_node")
    values["scenario"] = str(tmp_path / "scenario.yaml")
    recorder = ros.start(scenario_node.ScenarioNode, values).recorder
    told, states = ros.listen(Header, "recorded", NEWEST_QOS), ros.talk(JointState, "joint_states")
    rest = np.zeros(7)
    for stamp in (10, 20, 40):  # ns
        state = joint_state(values["joints"], stamp, rest + stamp, rest)
        ros.wait_until(
            lambda s=stamp: told and told[-1].stamp.nanosec == s,
            each=lambda s=state: states.publish(s),
        )
    run = recorder.run(10, period=10, periods=5)
    np.testing.assert_allclose(run.t, 1e-9 * np.array([0, 10, 20, 30, 40]))
    np.testing.assert_array_equal(run.q[:, 0], [10, 20, np.nan, 40, np.nan])
    assert run.lost == 5  # there are no limits either


def test_limits_and_torques_are_recorded_by_the_names_of_their_joints(ros, tmp_path):
    """Also where a message lacks some, as of another robot."""
    arguments(tmp_path)
    values = read_config("panda", "scenario_node") | {"scenario": str(tmp_path / "scenario.yaml")}
    recorder = ros.start(scenario_node.ScenarioNode, values).recorder
    names, numbers = values["joints"], np.arange(7.0)
    for stamp, joints in ((10, names), (20, names[::-1]), (30, names[:3])):
        given = numbers[: len(joints)] if joints[0] == names[0] else numbers[::-1]
        recorder._on_limits(acceleration_limits(joints, stamp, -given, given))
        recorder._on_command(joint_state(joints, stamp, tau=given))
    recorder._on_command(joint_state(names, 40, q=numbers))  # the drives' position control
    run = recorder.run(10, period=10, periods=4)
    rows = np.array([numbers, numbers, [np.nan] * 7, [np.nan] * 7])
    for found, wanted in ((run.a_lower, -rows), (run.a_upper, rows), (run.tau, rows)):
        np.testing.assert_array_equal(found, wanted)
    assert run.answered.all()


def test_angles_that_a_driver_wraps_do_not_leap_in_figures(ros, tmp_path):
    arguments(tmp_path)
    values = read_config("panda", "scenario_node") | {"scenario": str(tmp_path / "scenario.yaml")}
    for name in ("position_min", "position_max"):
        values[name] = [np.inf if name == "position_max" else -np.inf, *values[name][1:]]
    player = ros.start(scenario_node.ScenarioNode, values)
    states, rest = ros.talk(JointState, "joint_states"), [0.0] * 6
    for stamp, angle in ((10, 3.1), (20, -3.1)):  # ns, rad
        state = joint_state(values["joints"], stamp, [angle, *rest], [0.0] * 7)
        ros.wait_until(
            lambda s=stamp: player.recorder.stamp == s,
            each=lambda s=state: states.publish(s),
        )
    q = player.recorder.run(10, period=10, periods=2).q[:, 0]
    np.testing.assert_allclose(q, [3.1, 2.0 * np.pi - 3.1])
