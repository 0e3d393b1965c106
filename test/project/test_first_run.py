# SPDX-License-Identifier: Apache-2.0
"""Every command of docs/start/first_run.md works, as a newcomer types it."""

import os
import signal
import subprocess

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from shown_commands import ROOT, blocks, commands, make_hurried_tree, run

from viability_bounds_pkg.testing.executables import run_to_end

PAGE = (ROOT / "docs" / "start" / "first_run.md").read_text()
COMMANDS = sorted(commands(PAGE))
SESSIONS = [
    "\n".join(line.removeprefix("$ ") for line in block.splitlines())
    for block in blocks(PAGE, "console")
]
(GOAL,) = blocks(PAGE, "python")
TARGET = np.array([0.4, 0.2, 0.5])  # m
NEAR = 0.005  # m
STACK = "simulated_stack --ros-args"
BROKEN = "--bounds naive"
"""With it a limit is broken, says the page."""

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return make_hurried_tree(tmp_path_factory.mktemp("tree"))


def test_an_arm_is_made_and_each_command_runs(tree):
    (tree / "examples").symlink_to(ROOT / "examples")
    # The arm is made before it is shown; its scenario is played in full.
    for command in sorted(COMMANDS, key=lambda each: "new_robot" not in each):
        if BROKEN in command:
            continue
        result = run(command, tree)
        busy = "--view" in command and result.returncode == 1  # by the wall clock
        assert result.returncode == 0 or busy, command + result.stdout + result.stderr


def test_the_usual_bounds_break_a_limit(tmp_path):
    (command,) = (each for each in COMMANDS if BROKEN in each)
    result = run(f"{command} --out {tmp_path}")
    assert result.returncode == 1, result.stdout + result.stderr
    assert "BROKEN" in result.stdout


def test_a_goal_from_the_script_is_reached_and_held_after_its_end(tree, ros):
    stack, viewer, script = (typed(session, ros.domain) for session in SESSIONS)
    (tree / "goal.py").write_text(GOAL)
    programs = [started(stack, tree), started(viewer, tree)]
    poses = ros.listen(PoseStamped, "hand_pose")
    try:
        ros.wait_until(lambda: len(poses) > 2, timeout=120.0)
        start = place(poses[-1])
        ended = run_to_end("bash", "-c", script, cwd=tree, timeout=120)
        assert ended.returncode == 0, ended.stderr
        ros.wait_until(lambda: distance(poses[-1]) < NEAR, timeout=120.0)
        count = len(poses)
        ros.wait_until(lambda: len(poses) > count + 40, timeout=120.0)
    finally:
        for program in programs:
            os.killpg(program.pid, signal.SIGINT)
        said = [program.communicate(timeout=60)[0] for program in programs]
        print(*said, ros.diagnostics)  # shown where it fails
    assert abs(start - TARGET).max() > 0.1, said
    assert max(map(distance, poses[count:])) < NEAR, said
    turn = poses[-1].pose.orientation
    assert abs(turn.x) == pytest.approx(1.0, abs=1e-4)
    assert "the arm is at http://127.0.0.1" in said[1]


def place(message):
    """Return the position of a pose, shape (3,), m."""
    point = message.pose.position
    return np.array([point.x, point.y, point.z])


def distance(message):
    """Return how far a pose is from the goal of the page, m."""
    return abs(place(message) - TARGET).max()


def typed(session, domain):
    """Return a session of a terminal, in the domain of the test."""
    assert "ROS_DOMAIN_ID=7 " in session
    session = session.replace("ROS_DOMAIN_ID=7 ", f"ROS_DOMAIN_ID={domain} ")
    return session.replace(STACK, f"{STACK} -p clock:=lockstep")


def started(session, tree):
    """Start what is typed in a terminal; its last command takes the place of the shell."""
    *before, last = session.splitlines()
    return subprocess.Popen(
        ["bash", "-c", "\n".join((*before, f"exec {last}"))],
        cwd=tree,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
