# SPDX-License-Identifier: Apache-2.0
"""The motion that friction is told from, and the executable that records it."""

import re

import numpy as np
import pytest

from sim_bridge.tools import record_excitation
from sim_bridge.tools.record_excitation import ExcitationError, excitation, main
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration
from viability_bounds_pkg.testing.executables import called
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

FILE = config_folder() / "panda.yaml"
PANDA = read_config("panda", "bullet_node")
JOINTS = tuple(PANDA["joints"])
Q_MIN, Q_MAX, V_MAX, START = (
    np.array(PANDA[key])
    for key in ("position_min", "position_max", "velocity_max", "start_positions")
)
DT = 2e-3
ENDS = np.array([10.0, 26.0])  # s, of the first two of three parts


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
    return np.split(array, np.rint(ENDS / DT).astype(int))


@pytest.mark.parametrize(("amplitude", "speed"), [(0.1, 1.0), (3.0, 0.1)])
def test_it_stays_within_limits(amplitude, speed):
    q, v = motion(amplitude=amplitude, speed=speed)
    assert (np.abs(v) <= speed * V_MAX + 1e-12).all()
    assert (np.abs(q - START) <= amplitude + 1e-12).all()
    assert ((q > Q_MIN) & (q < Q_MAX)).all()


def test_each_part_played_backward_is_the_same():
    """Positions alike, velocities opposite: what rigid bodies need cannot look like friction."""
    q, v = motion()
    for q_part, v_part in zip(parts(q), parts(v), strict=True):
        np.testing.assert_allclose(q_part[1:], q_part[:0:-1], atol=1e-12)
        np.testing.assert_allclose(v_part[1:], -v_part[:0:-1], atol=1e-12)
        np.testing.assert_allclose(q_part[0], START, atol=1e-12)
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, 0.5 * (v[1:] + v[:-1]), atol=5e-3)


def test_joints_without_limits_and_joints_without_room():
    free = np.full(len(JOINTS), np.inf)
    q, _ = motion(q_min=-free, q_max=free)
    # Whole periods below a speed may leave a little of the way unused.
    assert (np.ptp(q, axis=0) > 0.5).all()
    narrow, wide, outside = Q_MIN.copy(), Q_MAX.copy(), START.copy()
    narrow[2], wide[2] = START[2] - 0.03, START[2] + 0.04
    with pytest.raises(ExcitationError, match=f"joint {JOINTS[2]} has 0.04 rad of room only"):
        motion(q_min=narrow, q_max=wide)
    outside[1] = Q_MAX[1] + 0.01
    with pytest.raises(ExcitationError, match=f"joint {JOINTS[1]} starts at .*outside"):
        motion(q_start=outside)


# The executable


def test_a_recording_is_what_the_robot_reported(monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(record_excitation, "PARTS", ((1.0, np.inf, 1.0),))  # a short one
    output = tmp_path / "run.npz"
    ended = called(capfd, main, FILE, "-o", output)
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
    ("source", "output", "code", "message"),
    [
        ("panda.yaml", None, 2, "required: -o/--output"),
        ("panda.yaml", ".", 1, "is a directory"),
        ("panda.yaml", "panda.yaml", 1, "is read, and cannot be written too"),
        ("none.yaml", "run.npz", 1, "none.yaml"),
        ("bad.yaml", "run.npz", 1, "parameter 'start_positions' is not set"),
        ("stuck.yaml", "run.npz", 1, f"joint {JOINTS[0]} starts at 9, outside its limits"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(capfd, tmp_path, source, output, code, message):
    text = FILE.read_text()
    row = re.search(r"^ *start_positions: \[([^,]*),.*$", text, re.MULTILINE)
    stuck = row[0].replace(f"[{row[1]},", "[9.0,")
    (tmp_path / "panda.yaml").write_text(text)
    (tmp_path / "bad.yaml").write_text(text.replace(row[0], ""))
    (tmp_path / "stuck.yaml").write_text(text.replace(row[0], stuck))
    where = [] if output is None else ["-o", tmp_path / output]
    ended = called(capfd, main, tmp_path / source, *where)
    assert ended.returncode == code
    assert ended.stderr.startswith("record_excitation: ") and ended.stderr.count("\n") == 1
    assert message in ended.stderr
    assert not (tmp_path / "run.npz").exists()
    assert (tmp_path / "panda.yaml").read_text() == text


def test_an_interrupt_leaves_nothing_behind(monkeypatch, capfd, tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(record_excitation, "record", interrupted)
    ended = called(capfd, main, FILE, "-o", tmp_path / "run.npz")
    assert ended.returncode == 130
    assert ended.stderr.strip() == "record_excitation: interrupted, nothing written"
    assert not list(tmp_path.iterdir())
