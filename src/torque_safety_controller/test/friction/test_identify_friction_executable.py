# SPDX-License-Identifier: Apache-2.0
"""The identify_friction executable, started as a user starts it."""

from __future__ import annotations

import signal
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
import yaml

from torque_safety_controller.friction.settings import FrictionModel
from torque_safety_controller.tools.identify_friction import main
from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.testing.executables import called, started

MODULE = "torque_safety_controller.tools.identify_friction"

TRUTH = FrictionModel(*np.array([[3.0, 0.4], [4.0, 0.5], [0.5, 0.1], [0.03, 0.03]]))


@pytest.fixture
def robot(write_robot):
    """Path of a robot's parameter file."""
    return write_robot()


@pytest.fixture
def recording(robot, tmp_path):
    """Path of 20 s of a robot that is a tenth heavier, joints in another order."""
    model = read_robot(robot).model
    for inertia in model.inertias[1:]:
        inertia.mass *= 1.1
    dt = 1e-3
    t = dt * np.arange(20001)
    omega = 2.0 * np.pi * np.where(t[:, None] < 10.0, [0.1, 0.1], [0.5, 0.7])

    def states(times):
        phase = omega * times[:, None]
        return (
            0.5 * (1 - np.cos(phase)),
            0.5 * omega * np.sin(phase),
            0.5 * omega**2 * np.cos(phase),
        )

    q, v, a = states(t - 0.5 * dt)
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *state) for state in zip(q, v, a, strict=True)])
    tau += np.sign(v) * TRUTH.level(v)
    q, v, _ = states(t)
    path = tmp_path / "run.npz"
    columns = {"q": q[:, ::-1], "v": v[:, ::-1], "tau": tau[:, ::-1]}
    np.savez(path, joints=np.array(["wrist", "shoulder"]), t=t, **columns)
    return path


@pytest.fixture
def call(capfd):
    """Runs the tool in this process, which saves the start of an interpreter."""
    return partial(called, capfd, main)


def parameters_in(text):
    content = yaml.safe_load(text)
    assert list(content) == ["/**/controller_node"]
    return content["/**/controller_node"]["ros__parameters"]


def test_friction_is_written_as_an_overlay(robot, recording, tmp_path):
    output = tmp_path / "friction.yaml"
    ended = started("-m", MODULE, robot, recording, "-o", output)
    assert (ended.returncode, ended.stderr) == (0, "")
    written = parameters_in(output.read_text())
    names = ("coulomb", "static", "viscous", "stribeck_velocity")
    # Not the switch: identifying must not change how the robot is controlled.
    assert set(written) == {f"friction_model_{name}" for name in names}
    for name in names:
        found = written[f"friction_model_{name}"]
        np.testing.assert_allclose(found, getattr(TRUTH, name), rtol=0.05)
    for shown in ("shoulder: ", "coulomb", "+-", "residual", f"written to {output}"):
        assert shown in ended.stdout
    assert "run.npz" in output.read_text()


def test_without_a_file_it_is_printed(robot, recording, call):
    ended = call(robot, recording)
    assert (ended.returncode, ended.stderr) == (0, "")
    parameters_in(ended.stdout[ended.stdout.index("# Friction found") :])


def test_what_is_not_told_is_said_in_the_file(robot, recording, call, tmp_path):
    with np.load(recording) as file:
        arrays = dict(file)
    arrays["v"][:, 0] = 0.0  # the wrist stands
    np.savez(recording, **arrays)
    output = tmp_path / "friction.yaml"
    assert call(robot, recording, "-o", output).returncode == 0
    text = output.read_text()
    assert "# wrist: nothing found: it did not move both ways" in text
    assert parameters_in(text)["friction_model_coulomb"][1] == 0.0


def test_nothing_at_all_is_an_error_and_no_file(robot, recording, call, tmp_path):
    with np.load(recording) as file:
        arrays = {key: file[key][:4000] if key != "joints" else file[key] for key in file}
    np.savez(recording, **arrays)
    output = tmp_path / "friction.yaml"
    ended = call(robot, recording, "-o", output)
    assert ended.returncode == 1
    assert ended.stderr.strip().endswith("tells nothing about friction: see above")
    assert "did not move both ways" in ended.stdout
    assert not output.exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["{robot}"], 2, "the following arguments are required: recording"),
        (["{robot}", "{run}", "-o", "{tmp}"], 1, "is a directory"),
        (["{robot}", "{run}", "-o", "{tmp}/none/friction.yaml"], 1, "no directory"),
        (["{robot}", "{run}", "-o", "{robot}"], 1, "is read, and cannot be written too"),
        (["{robot}", "{run}", "-o", "{run}"], 1, "is read, and cannot be written too"),
        (["{robot}", "{tmp}/none.npz"], 1, "none.npz: no NumPy file"),
        (["{tmp}/none.yaml", "{run}"], 1, "none.yaml"),
        (["{robot}", "{robot}"], 1, "no NumPy file"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(
    robot, recording, call, tmp_path, arguments, code, message
):
    before = robot.read_bytes(), recording.read_bytes()
    names = {"robot": robot, "run": recording, "tmp": tmp_path}
    ended = call(*(argument.format(**names) for argument in arguments))
    errors = ended.stderr
    assert ended.returncode == code
    assert errors.startswith("identify_friction: ") and errors.count("\n") == 1
    assert message in errors
    assert (robot.read_bytes(), recording.read_bytes()) == before


INTERRUPTIBLE = """
import os, signal, sys
from torque_safety_controller.tools import identify_friction as tool
fits = tool.identify
def interrupted(*arguments):
    for fit in fits(*arguments):
        os.kill(os.getpid(), signal.SIGINT)
        yield fit
tool.identify = interrupted
sys.exit(tool.main())
"""


def test_an_interrupt_leaves_nothing_behind(robot, recording, tmp_path):
    output = tmp_path / "friction.yaml"
    output.write_text("old")
    ended = started("-c", INTERRUPTIBLE, robot, recording, "-o", output)
    assert ended.returncode == 128 + signal.SIGINT
    assert ended.stderr.strip() == "identify_friction: interrupted, nothing written"
    assert output.read_text() == "old"
    assert {path.name for path in tmp_path.iterdir()} == {
        "arm.urdf",
        "robot.yaml",
        "run.npz",
        "friction.yaml",
    }
