# SPDX-License-Identifier: Apache-2.0
"""Friction told from recordings of an arm whose masses are not those of the model; the tool."""

import math
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
import yaml
from arms import load_arm

from torque_safety_controller.friction.identification import JointFit, friction_model, identify
from torque_safety_controller.friction.joint_recording import (
    Recording,
    RecordingError,
    load_recording,
    make_blocks,
)
from torque_safety_controller.friction.settings import FrictionModel
from torque_safety_controller.tools.identify_friction import main, report
from viability_bounds_pkg.testing.executables import called
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

ARM = load_arm("panda")
N = ARM.n
PERIOD = 2e-3  # s
COULOMB = 0.1 * ARM.tau_max
COEFFICIENTS = ("coulomb", "static", "viscous", "stribeck_velocity")
TRUTH = FrictionModel(COULOMB, 1.3 * COULOMB, 0.2 * COULOMB, np.full(N, 0.03))


def heavier() -> pin.Model:
    """The arm with other masses, centres of mass, inertias and rotors."""
    rng, model = np.random.default_rng(7), ARM.model.copy()
    for inertia in model.inertias[1:]:
        inertia.mass *= 1.0 + rng.uniform(-0.2, 0.2)
        inertia.lever = inertia.lever + rng.uniform(-0.02, 0.02, 3)
        inertia.inertia = inertia.inertia * (1.0 + rng.uniform(0.0, 0.2))
    model.armature = np.array(model.armature) + rng.uniform(0.0, 0.1, N)
    return model


def cosines(seconds, periods, peak, t, still=()):
    """Return q, v and a of joints on cosines, from rest to rest; `still` ones excepted."""
    omega = 2.0 * np.pi * np.array(periods) / seconds
    A = np.minimum(peak / omega, 0.4)
    A[list(still)] = 0.0
    phase = np.outer(t, omega)
    q = ARM.q_start + A * (1.0 - np.cos(phase))
    return q, A * omega * np.sin(phase), A * omega**2 * np.cos(phase)


SLOW = 8.0, [1, 1, 1, 1, 1, 1, 1], 0.05
MEDIUM = 10.0, [1, 2, 1, 2, 1, 2, 3], 0.3
FAST = 8.0, [4, 3, 5, 4, 6, 5, 3], 1.0
KINDS = SLOW, MEDIUM, FAST


def record(*kinds, truth=TRUTH, bias=0.0, share=1.0, still=()) -> Recording:
    """The torques that rigid bodies and friction need for motions, one after the other.

    That of a sample acted since the one before: it is the one of the middle.
    """
    model, begin, rows = heavier(), 0.0, []
    data = model.createData()
    for kind in kinds:
        t = PERIOD * np.arange(round(share * kind[0] / PERIOD) + 1)
        q, v, a = cosines(*kind, t - 0.5 * PERIOD, still)
        tau = np.array([pin.rnea(model, data, *state) for state in zip(q, v, a, strict=True)])
        tau += np.sign(v) * truth.level(v) + bias
        q, v, _ = cosines(*kind, t, still)
        rows.append((begin + t, q, v, tau))
        begin += t[-1] + PERIOD
    return Recording(*map(np.concatenate, zip(*rows, strict=True)))


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Of slow and fast motions, with a bias of the torque."""
    return record(*KINDS, bias=0.3 * COULOMB)


def noisy(recording, seed):
    """What sensors make of it: 3e-3 rad/s, and torques off by a tenth of Coulomb friction."""
    rng, shape = np.random.default_rng(seed), recording.q.shape
    return Recording(
        recording.t,
        recording.q + 1e-5 * rng.standard_normal(shape),
        recording.v + 3e-3 * rng.standard_normal(shape),
        recording.tau + 0.1 * COULOMB * rng.standard_normal(shape),
    )


def fitted(recording):
    return list(identify(ARM.model, recording))


def rows(model) -> np.ndarray:
    return np.array([getattr(model, name) for name in COEFFICIENTS])


def off(fits, truth=TRUTH) -> np.ndarray:
    """Relative errors, shape (3, n): of Coulomb, static and viscous friction."""
    return rows(friction_model(fits))[:3] / rows(truth)[:3] - 1.0


def test_friction_is_found_whatever_the_masses_are(recording):
    fits = fitted(recording)
    assert [fit.notes for fit in fits] == [[]] * N
    assert np.abs(off(fits)).max() < 0.01
    np.testing.assert_allclose(friction_model(fits).stribeck_velocity, 0.03, rtol=0.02)


def test_noise_is_what_the_standard_errors_say(recording):
    fits = fitted(noisy(recording, 3))
    assert np.abs(off(fits)[:2]).max() < 0.05
    assert np.abs(off(fits)[2]).max() < 0.15
    errors = np.array([fit.errors for fit in fits]).T
    misses = (rows(friction_model(fits)) - rows(TRUTH)) / errors
    assert np.abs(misses).max() < 6.0
    assert 0.2 < np.sqrt(np.mean(misses**2)) < 2.5
    # A block of ten samples with torques off by a tenth.
    residuals = np.array([fit.residual for fit in fits]) / COULOMB
    assert (residuals > 0.02).all() and (residuals < 0.15).all()


def test_joints_that_stand_or_go_one_way_are_not_guessed_at():
    fits = fitted(record(*KINDS, still=[2]))
    assert "did not move both ways" in fits[2].notes[0]
    rest = [j for j in range(N) if j != 2]
    assert np.abs(off(fits)[:, rest]).max() < 0.01
    for fit in fitted(record((10.0, [1] * N, 0.3), share=0.5)):
        assert "did not move both ways" in fit.notes[0]
        assert (fit.coulomb, fit.static, fit.viscous) == (0.0, 0.0, 0.0)
        assert np.isnan(fit.errors).all()


def test_a_robot_without_stiction_or_without_friction_has_none():
    plain = FrictionModel(COULOMB, COULOMB, 0.2 * COULOMB, np.full(N, 0.03))
    fits = fitted(noisy(record(*KINDS, truth=plain), 4))
    assert np.abs(friction_model(fits).static / COULOMB - 1.0).max() < 0.05
    assert sum("stiction" in " ".join(fit.notes) for fit in fits) >= N - 2
    none = FrictionModel(0.0 * COULOMB, 0.0 * COULOMB, 0.0 * COULOMB, np.ones(N))
    fits = fitted(noisy(record(*KINDS, truth=none), 5))
    for fit, coulomb in zip(fits, COULOMB, strict=True):
        assert max(fit.coulomb, fit.static) < 0.05 * coulomb
    assert sum("Coulomb friction not told" in " ".join(fit.notes) for fit in fits) >= N - 2


def test_recordings_of_another_robot_are_refused(recording):
    four = (getattr(recording, key)[:, :4] for key in ("q", "v", "tau"))
    with pytest.raises(RecordingError, match="4 joints, the robot 7"):
        fitted(Recording(recording.t, *four))


# Recordings


JOINTS = ("shoulder", "elbow")
PHASE = 0.01 * np.arange(1000)[:, None]  # of a motion at 1 Hz
T = np.arange(1000.0)
TURNING, SPEED = np.sin(PHASE) * [1.0, 0.0], 0.01 * np.cos(PHASE) * [1.0, 0.0]


def arrays(count=200):
    """A recording of two joints at 1 kHz."""
    t = 1e-3 * np.arange(count)
    return {
        "t": t,
        "q": np.column_stack([0.3 * t**2, 1.0 - 0.1 * t]),
        "v": np.column_stack([0.6 * t, np.full(count, -0.1)]),
        "tau": np.column_stack([t, 2.0 - t]),
    }


def loaded(tmp_path, contents):
    path = tmp_path / "run.npz"
    np.savez(path, **contents)
    return load_recording(path, JOINTS)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"tau": None}, "array missing: .*tau"),
        ({"t": np.zeros((200, 1))}, r"'t' must have shape \(N,\)"),
        ({"t": np.zeros(200)}, "'t' does not increase after sample 0"),
        ({"q": np.zeros((200, 3))}, "'q' must have one column for each of 2 joints"),
        ({"v": np.zeros((199, 2))}, r"'v' must have shape \(200, 2\), has \(199, 2\)"),
        ({"tau": np.full((200, 2), math.nan)}, "'tau' has numbers that are not finite"),
        ({"tau": np.full((200, 2), "x")}, "no NumPy file of arrays of numbers"),
        ({"joints": np.array(["shoulder", "wrist"])}, "joint 'elbow' is missing"),
        ({"t": T, "tau": TURNING, "q": TURNING, "v": np.degrees(SPEED)}, "'v' of shoulder dif"),
        ({"t": T, "tau": TURNING, "q": TURNING, "v": 0.0 * SPEED}, "differs by 100%"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, changed, message):
    contents = {key: value for key, value in (arrays() | changed).items() if value is not None}
    with pytest.raises(RecordingError, match=message):
        loaded(tmp_path, contents)


def test_samples_that_lack_numbers_are_left_out(tmp_path):
    contents = arrays()
    contents["q"][50:60] = contents["v"][50:60] = contents["tau"][50:61] = math.nan
    found = loaded(tmp_path, contents)
    assert (len(found.t), found.lost) == (189, 11)
    np.testing.assert_array_equal(found.t, np.delete(contents["t"], slice(50, 61)))


def test_files_that_are_cut_off_damaged_or_of_another_kind_are_refused(tmp_path):
    path = tmp_path / "run.npz"
    rng = np.random.default_rng(0)
    np.savez_compressed(path, **arrays())
    whole = path.read_bytes()
    damaged = []
    for start in range(100, len(whole) // 2, 100):
        damaged.append(whole[:start] + rng.bytes(40) + whole[start + 40 :])
    for content in (b"", b"a,b\n1,2\n", whole[:-30], *damaged):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match="no .npz file, or one|no NumPy file") as refused:
            load_recording(path, JOINTS)
        assert "unsafely" not in str(refused.value)


def test_angles_that_a_driver_wraps_are_taken(tmp_path):
    turned = np.arctan2(np.sin(TURNING + 3.0), np.cos(TURNING + 3.0))
    contents = {"t": T, "q": turned, "v": SPEED, "tau": TURNING}
    assert np.ptp(turned[:, 0]) > 6.0
    assert loaded(tmp_path, contents).n == 2


def test_angles_in_degrees_are_refused(recording, call, tmp_path):
    columns = {key: np.degrees(getattr(recording, key)) for key in ("q", "v")}
    run = save(tmp_path / "run.npz", Recording(recording.t, **columns, tau=recording.tau))
    ended = call(run)
    assert ended.returncode == 1
    assert "beyond its limits by more than its range: degrees, or another robot?" in ended.stderr


def test_blocks_are_averages():
    blocks = make_blocks(Recording(**arrays(201)), 0.02)
    np.testing.assert_allclose(blocks.t, 0.01 + 0.02 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose(blocks.a, [[0.6, 0.0]] * 10, atol=1e-9)
    np.testing.assert_allclose(blocks.v[:, 0], 0.6 * blocks.t, atol=1e-12)
    # Of torque, samples 1 to 20: it acted until then.
    np.testing.assert_allclose(blocks.tau[:, 0], blocks.t + 0.5e-3, atol=1e-12)
    np.testing.assert_allclose(blocks.bend, 0.0, atol=1e-12)
    with pytest.raises(RecordingError, match="too short: 0.01 s"):
        make_blocks(Recording(**arrays(11)), 0.02)


def test_gaps_are_left_out():
    contents = arrays(1001)
    contents["t"][503:] += 0.7
    blocks = make_blocks(Recording(**contents), 0.02)
    assert len(blocks.t) == 49
    np.testing.assert_allclose(blocks.a[:, 0], 0.6, atol=1e-9)


# The tool


@pytest.fixture
def call(capfd):
    """Runs the tool for Panda in this process."""
    return partial(called, capfd, main, config_folder() / "panda.yaml")


def save(path, recording, count=None):
    """Write a recording, its joints in another order."""
    columns = {key: getattr(recording, key)[:count, ::-1] for key in ("q", "v", "tau")}
    joints = np.array(read_config("panda", "controller_node")["joints"][::-1])
    np.savez(path, joints=joints, t=recording.t[:count], **columns)
    return path


def parameters_in(text):
    content = yaml.safe_load(text)
    assert list(content) == ["/**/controller_node"]
    return content["/**/controller_node"]["ros__parameters"]


def test_the_tool_writes_an_overlay_or_prints_it(recording, call, tmp_path):
    run, output = save(tmp_path / "run.npz", recording), tmp_path / "friction.yaml"
    ended = call(run, "-o", output)
    assert (ended.returncode, ended.stderr) == (0, "")
    written = parameters_in(output.read_text())
    # Not the switch: identifying must not change how the robot is controlled.
    assert set(written) == {"joints", *(f"friction_model_{name}" for name in COEFFICIENTS)}
    assert written["joints"][0] == "panda_joint1"
    for name in COEFFICIENTS:
        found = written[f"friction_model_{name}"]
        np.testing.assert_allclose(found, getattr(TRUTH, name), rtol=0.05)
    for shown in ("panda_joint1: ", "coulomb", "+-", "residual", f"written to {output}"):
        assert shown in ended.stdout
    printed = call(run).stdout
    assert parameters_in(printed[printed.index("# Friction found") :]) == written


def test_what_is_not_told_is_said_in_the_file(call, tmp_path):
    run = save(tmp_path / "run.npz", record(*KINDS, still=[6]))
    output = tmp_path / "friction.yaml"
    assert call(run, "-o", output).returncode == 0
    text = output.read_text()
    assert "# panda_joint7: nothing found: it did not move both ways" in text
    assert parameters_in(text)["friction_model_coulomb"][6] == 0.0


def test_what_cannot_be_done_is_told_in_one_line_and_leaves_files_alone(recording, call, tmp_path):
    run, output = save(tmp_path / "run.npz", recording, 1000), tmp_path / "friction.yaml"
    before = run.read_bytes()
    ended = call(run, "-o", run)
    assert ended.returncode == 1
    assert ended.stderr.startswith("identify_friction: ") and ended.stderr.count("\n") == 1
    assert "is read, and cannot be written too" in ended.stderr
    assert run.read_bytes() == before
    ended = call(run, "-o", output)
    assert ended.returncode == 1
    assert ended.stderr.strip().endswith("tells nothing about friction: see above")
    assert not output.exists()


def test_slides_have_units_of_their_own(capsys):
    report(["lift", "elbow"], [JointFit(errors=np.zeros(4))] * 2, ["m", "rad"])
    lift, elbow = capsys.readouterr().out.split("elbow: ")
    units = [line.split("+- 0 ")[1] for line in lift.splitlines()[1:]]
    assert units == ["N", "N", "N s/m", "m/s"]
    assert "rad" not in lift and "N m s/rad" in elbow
