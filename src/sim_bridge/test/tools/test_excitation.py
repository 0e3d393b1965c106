# SPDX-License-Identifier: Apache-2.0
"""The motion that friction is told from, and the executable that records it."""

from __future__ import annotations

import re
import signal
from functools import partial

import numpy as np
import pytest

from sim_bridge.tools.record_excitation import PARTS, ROOM, ExcitationError, excitation, main
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration
from viability_bounds_pkg.testing.executables import called, started
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

FILE = config_folder() / "panda.yaml"
PANDA = read_config("panda", "bullet_node")
JOINTS = tuple(PANDA["joints"])
Q_MIN, Q_MAX, V_MAX, START = (
    np.array(PANDA[key])
    for key in ("position_min", "position_max", "velocity_max", "start_positions")
)
DT = 2e-3


def motion(q_start=START, q_min=Q_MIN, q_max=Q_MAX, **options):
    arm = LimitedRobotConfiguration(
        robot_description="",
        joints=JOINTS,
        position_min=q_min,
        position_max=q_max,
        velocity_max=V_MAX,
        torque_max=np.array(PANDA["torque_max"]),
    )
    return excitation(arm, q_start, DT, **options)


def parts(array):
    """Split into the parts of the motion."""
    return np.split(array, np.cumsum([round(part[0] / DT) for part in PARTS])[:-1])


@pytest.mark.parametrize(("amplitude", "speed"), [(0.6, 0.5), (0.1, 1.0), (3.0, 0.1)])
def test_it_stays_within_limits(amplitude, speed):
    q, v = motion(amplitude=amplitude, speed=speed)
    assert len(q) * DT == pytest.approx(sum(part[0] for part in PARTS))
    assert (np.abs(v) <= speed * V_MAX + 1e-12).all()
    room = np.maximum(Q_MAX - START, START - Q_MIN)
    assert (np.abs(q - START).max(axis=0) <= np.minimum(amplitude, ROOM * room) + 1e-12).all()
    assert ((q > Q_MIN) & (q < Q_MAX)).all()


def test_each_part_played_backward_is_the_same():
    """Positions alike, velocities opposite: what rigid bodies need cannot look like friction."""
    q, v = motion()
    for q_part, v_part in zip(parts(q), parts(v), strict=True):
        np.testing.assert_allclose(q_part[1:], q_part[:0:-1], atol=1e-12)
        np.testing.assert_allclose(v_part[1:], -v_part[:0:-1], atol=1e-12)
        np.testing.assert_allclose(q_part[0], START, atol=1e-12)
        np.testing.assert_allclose(v_part[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, 0.5 * (v[1:] + v[:-1]), atol=5e-3)


def test_every_joint_moves_slowly_and_fast():
    _, v = motion()
    speeds = np.abs(v)
    for low, high in ((0.0, 0.01), (0.02, 0.05), (0.05, 0.2)):
        assert (((speeds > low) & (speeds < high)).sum(axis=0) * DT > 0.5).all()
    assert (speeds.max(axis=0) > 0.3).all()


def test_joints_without_limits_and_joints_without_room():
    free = np.full(len(JOINTS), np.inf)
    q, _ = motion(q_min=-free, q_max=free)
    # Whole periods below a speed may leave a little of the way unused.
    assert (np.ptp(q, axis=0) > 0.5).all()
    narrow = Q_MIN.copy()
    narrow[2], wide = START[2] - 0.03, Q_MAX.copy()
    wide[2] = START[2] + 0.04
    with pytest.raises(ExcitationError, match=f"joint {JOINTS[2]} has 0.04 rad of room only"):
        motion(q_min=narrow, q_max=wide)
    outside = START.copy()
    outside[1] = Q_MAX[1] + 0.01
    with pytest.raises(ExcitationError, match=f"joint {JOINTS[1]} starts at .*outside"):
        motion(q_start=outside)


# The executable


@pytest.fixture
def short(monkeypatch):
    """Makes the motion short: what is to be seen does not take its time."""
    monkeypatch.setattr("sim_bridge.tools.record_excitation.PARTS", ((1.0, np.inf, 1.0),))


@pytest.fixture
def call(capfd):
    """Runs the tool in this process, which saves the start of an interpreter."""
    return partial(called, capfd, main)


def test_a_recording_is_what_the_robot_reported(short, call, tmp_path):
    output = tmp_path / "run.npz"
    ended = call(FILE, "-o", output)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert re.search(rf"1 s of motion written to {output}; torque at most 0\.\d\d", ended.stdout)
    with np.load(output) as recording:
        assert tuple(recording["joints"]) == JOINTS
        t, tau = recording["t"], recording["tau"]
        q, v = motion()
        np.testing.assert_allclose(np.diff(t), DT)
        np.testing.assert_allclose(recording["q"], q, atol=5e-3)
        np.testing.assert_allclose(recording["v"][50:], v[50:], atol=0.05)
    # It holds gravity.
    assert np.abs(tau[:, 1]).max() > 5.0
    assert (np.abs(tau) <= PANDA["torque_max"]).all()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["{config}"], 2, "required: -o/--output"),
        (["{config}", "-o", "{tmp}"], 1, "is a directory"),
        (["{config}", "-o", "{config}"], 1, "is read, and cannot be written too"),
        (["{tmp}/none.yaml", "-o", "{out}"], 1, "none.yaml"),
        (["{bad}", "-o", "{out}"], 1, "parameter 'start_positions' is not set"),
        (["{stuck}", "-o", "{out}"], 1, f"joint {JOINTS[0]} starts at 9, outside its limits"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(call, tmp_path, arguments, code, message):
    text = FILE.read_text()
    row = re.search(r"^ *start_positions: \[([^,]*),.*$", text, re.MULTILINE)
    (tmp_path / "bad.yaml").write_text(text.replace(row[0], ""))
    stuck = row[0].replace(f"[{row[1]},", "[9.0,")
    (tmp_path / "stuck.yaml").write_text(text.replace(row[0], stuck))
    config = tmp_path / "panda.yaml"
    config.write_text(text)
    names = {
        "config": config,
        "tmp": tmp_path,
        "out": tmp_path / "run.npz",
        "bad": tmp_path / "bad.yaml",
        "stuck": tmp_path / "stuck.yaml",
    }
    ended = call(*(argument.format(**names) for argument in arguments))
    errors = ended.stderr
    assert ended.returncode == code
    assert errors.startswith("record_excitation: ") and errors.count("\n") == 1
    assert message in errors
    assert not (tmp_path / "run.npz").exists()
    assert config.read_text() == text


INTERRUPTIBLE = """
import os, signal, sys
from sim_bridge.tools import record_excitation as tool
class InterruptedRobot(tool.BulletRobot):
    def move(self, *arguments):
        os.kill(os.getpid(), signal.SIGINT)
        super().move(*arguments)
from sim_bridge.node import bullet_parameters
bullet_parameters.BulletRobot = InterruptedRobot
sys.exit(tool.main())
"""


def test_an_interrupt_leaves_nothing_behind(tmp_path):
    ended = started("-c", INTERRUPTIBLE, FILE, "-o", tmp_path / "run.npz")
    assert ended.returncode == 128 + signal.SIGINT, ended.stderr
    assert ended.stderr.strip() == "record_excitation: interrupted, nothing written"
    assert not list(tmp_path.iterdir())
