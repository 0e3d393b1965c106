# SPDX-License-Identifier: Apache-2.0
"""The tool that finds friction in a recording."""

from __future__ import annotations

from functools import partial

import numpy as np
import pinocchio as pin
import pytest
import yaml

from torque_safety_controller.friction.settings import FrictionModel
from torque_safety_controller.tools.identify_friction import main
from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.testing.executables import called

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
    dt = 2e-3
    t = dt * np.arange(10001)
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


def test_friction_is_written_as_an_overlay_or_printed(robot, recording, call, tmp_path):
    output = tmp_path / "friction.yaml"
    ended = call(robot, recording, "-o", output)
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
    printed = call(robot, recording).stdout
    assert parameters_in(printed[printed.index("# Friction found") :]) == written


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


def test_what_cannot_be_done_is_told_in_one_line_and_leaves_files_alone(
    robot, recording, call, tmp_path
):
    before = robot.read_bytes(), recording.read_bytes()
    ended = call(robot, recording, "-o", recording)
    assert ended.returncode == 1
    assert ended.stderr.startswith("identify_friction: ") and ended.stderr.count("\n") == 1
    assert "is read, and cannot be written too" in ended.stderr
    assert (robot.read_bytes(), recording.read_bytes()) == before
    with np.load(recording) as file:
        arrays = {key: file[key][:2000] if key != "joints" else file[key] for key in file}
    np.savez(recording, **arrays)
    ended = call(robot, recording, "-o", tmp_path / "friction.yaml")
    assert ended.returncode == 1
    assert ended.stderr.strip().endswith("tells nothing about friction: see above")
    assert not (tmp_path / "friction.yaml").exists()
