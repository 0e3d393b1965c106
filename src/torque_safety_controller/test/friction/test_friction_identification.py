# SPDX-License-Identifier: Apache-2.0
"""Friction told from motions of an arm whose masses are not those of the model."""

import itertools

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm

from torque_safety_controller.friction.identification import (
    friction_model,
    identify,
    model_errors,
)
from torque_safety_controller.friction.joint_recording import (
    Recording,
    RecordingError,
    make_blocks,
)
from torque_safety_controller.friction.settings import FrictionModel

ARM = load_arm("panda")
N = ARM.n
PERIOD = 2e-3  # s
COULOMB = 0.1 * ARM.tau_max
TRUTH = FrictionModel(COULOMB, 1.3 * COULOMB, 0.2 * COULOMB, np.full(N, 0.03))


def heavier(rng, share=0.2) -> pin.Model:
    """The arm with other masses, centres of mass, inertias and rotors."""
    model = ARM.model.copy()
    for inertia in model.inertias[1:]:
        inertia.mass *= 1.0 + rng.uniform(-share, share)
        inertia.lever = inertia.lever + rng.uniform(-0.02, 0.02, 3)
        inertia.inertia = inertia.inertia * (1.0 + rng.uniform(0.0, share))
    model.armature = np.array(model.armature) + rng.uniform(0.0, 0.1, N)
    return model


class RecordedMotion:
    """Joints on cosines, from rest to rest; `still` ones excepted."""

    def __init__(self, seconds, periods, peak, share=1.0, still=()) -> None:
        self.t = PERIOD * np.arange(round(share * seconds / PERIOD) + 1)
        self._omega = 2.0 * np.pi * np.array(periods) / seconds
        self._A = np.minimum(peak / self._omega, 0.4)
        self._A[list(still)] = 0.0

    def at(self, t):
        """Return q, v and a, shape (N, n) each."""
        A, omega, phase = self._A, self._omega, np.outer(t, self._omega)
        q = ARM.q_start + A * (1.0 - np.cos(phase))
        return q, A * omega * np.sin(phase), A * omega**2 * np.cos(phase)


def record(*parts, truth=TRUTH, model=None, bias=0.0):
    """The torques that rigid bodies and friction need for motions, one after the other.

    That of a sample acted since the one before: it is the one of the middle.
    """
    model = heavier(np.random.default_rng(7)) if model is None else model
    data = model.createData()
    ts, qs, vs, taus = [], [], [], []
    begin = 0.0
    for part in parts:
        q, v, a = part.at(part.t - 0.5 * PERIOD)
        tau = np.array([pin.rnea(model, data, *state) for state in zip(q, v, a, strict=True)])
        tau += np.sign(v) * truth.level(v) + bias
        q, v, _ = part.at(part.t)
        for kept, new in zip((ts, qs, vs, taus), (begin + part.t, q, v, tau), strict=True):
            kept.append(new)
        begin = ts[-1][-1] + PERIOD
    return Recording(*(np.concatenate(x) for x in (ts, qs, vs, taus)))


KINDS = (
    (8.0, [1, 1, 1, 1, 1, 1, 1], 0.05),
    (10.0, [1, 2, 1, 2, 1, 2, 3], 0.3),
    (8.0, [4, 3, 5, 4, 6, 5, 3], 1.0),
)
PARTS = tuple(RecordedMotion(*kind) for kind in KINDS)
RECORDING = record(*PARTS, bias=0.3 * COULOMB)


def noisy(recording, rng, v=3e-3, tau=0.1):
    """What sensors make of it; velocities in rad/s, torques in Coulomb frictions."""
    return Recording(
        recording.t,
        recording.q + 1e-5 * rng.standard_normal(recording.q.shape),
        recording.v + v * rng.standard_normal(recording.v.shape),
        recording.tau + tau * COULOMB * rng.standard_normal(recording.tau.shape),
    )


def off(found, truth=TRUTH):
    """Relative errors, shape (3, n): of Coulomb, static and viscous friction."""
    names = ("coulomb", "static", "viscous")
    return np.array([getattr(found, name) / getattr(truth, name) - 1.0 for name in names])


def test_what_rigid_bodies_need_is_eliminated():
    """The errors' columns explain all of what wrong masses add."""
    frictionless = FrictionModel(0.0 * COULOMB, 0.0 * COULOMB, 0.0 * COULOMB, np.ones(N))
    blocks = make_blocks(record(PARTS[2], truth=frictionless), 0.02)
    beyond, errors = model_errors(ARM.model, blocks)
    for joint in range(N):
        left = np.linalg.lstsq(errors[:, joint], beyond[:, joint], rcond=None)[0]
        rest = errors[:, joint] @ left - beyond[:, joint]
        assert np.abs(rest).max() < 1e-3 * COULOMB[joint]
    assert np.abs(beyond / COULOMB).max() > 0.1


def test_friction_is_found_whatever_the_masses_are():
    fits = list(identify(ARM.model, RECORDING))
    found = friction_model(fits)
    assert [fit.notes for fit in fits] == [[]] * N
    assert np.abs(off(found)).max() < 0.01
    np.testing.assert_allclose(found.stribeck_velocity, 0.03, rtol=0.02)
    # The model's error and the bias are as large as what was found.
    blocks = make_blocks(RECORDING, 0.02)
    beyond = model_errors(ARM.model, blocks)[0] - np.sign(blocks.v) * TRUTH.level(blocks.v)
    assert np.quantile(np.abs(beyond / COULOMB), 0.9) > 0.3


def test_noise_is_what_the_standard_errors_say():
    rng = np.random.default_rng(3)
    fits = list(identify(ARM.model, noisy(RECORDING, rng)))
    found = friction_model(fits)
    assert np.abs(off(found)[:2]).max() < 0.05
    assert np.abs(off(found)[2]).max() < 0.15
    errors = np.array([fit.errors for fit in fits]).T
    true = np.array([TRUTH.coulomb, TRUTH.static, TRUTH.viscous, TRUTH.stribeck_velocity])
    names = ("coulomb", "static", "viscous", "stribeck_velocity")
    misses = (np.array([getattr(found, name) for name in names]) - true) / errors
    assert np.abs(misses).max() < 6.0
    assert 0.2 < np.sqrt(np.mean(misses**2)) < 2.5
    # A block of ten samples with torques off by a tenth.
    residuals = np.array([fit.residual for fit in fits]) / COULOMB
    assert (residuals > 0.02).all() and (residuals < 0.15).all()


def test_a_few_collisions_do_not_matter():
    tau = RECORDING.tau.copy()
    for begin in (3000, 6100, 9000):
        tau[begin : begin + 60] += 5.0 * COULOMB
    found = friction_model(
        list(identify(ARM.model, Recording(RECORDING.t, RECORDING.q, RECORDING.v, tau)))
    )
    assert np.abs(off(found)).max() < 0.03


def test_one_way_tells_nothing():
    fits = list(identify(ARM.model, record(RecordedMotion(10.0, [1] * N, 0.3, share=0.5))))
    for fit in fits:
        assert "did not move both ways" in fit.notes[0]
        assert (fit.coulomb, fit.static, fit.viscous) == (0.0, 0.0, 0.0)
        assert np.isnan(fit.errors).all()


def test_a_joint_that_stands_is_not_guessed_at():
    fits = list(identify(ARM.model, record(*(RecordedMotion(*kind, still=[2]) for kind in KINDS))))
    assert "did not move both ways" in fits[2].notes[0]
    rest = [j for j in range(N) if j != 2]
    assert np.abs(off(friction_model(fits))[:, rest]).max() < 0.01


def test_ways_that_differ_tell_nothing():
    """Up here and down there: position explains what friction would."""
    recording = record(RecordedMotion(20.0, [1] * N, 0.3))
    other = recording.q + np.where(recording.v > 0.0, 0.0, 1.0)  # another place on the way back
    fits = list(identify(ARM.model, Recording(recording.t, other, recording.v, recording.tau)))
    assert any("cannot be told from errors" in fit.notes[0] for fit in fits if fit.notes)
    for fit in fits:
        assert fit.notes or abs(fit.coulomb) > 0.0


def test_fast_motion_tells_no_stiction():
    fits = list(identify(ARM.model, record(*PARTS[2:], *PARTS[2:])))
    for fit, coulomb in zip(fits, COULOMB, strict=True):
        assert any("stiction" in note for note in fit.notes)
        assert fit.static == fit.coulomb == pytest.approx(coulomb, rel=0.02)


def test_without_stiction_none_is_told():
    plain = FrictionModel(COULOMB, COULOMB, 0.2 * COULOMB, np.full(N, 0.03))
    rng = np.random.default_rng(4)
    fits = list(identify(ARM.model, noisy(record(*PARTS, truth=plain), rng)))
    found = friction_model(fits)
    assert np.abs(found.static / COULOMB - 1.0).max() < 0.05
    assert sum("stiction" in " ".join(fit.notes) for fit in fits) >= N - 2


def test_a_robot_without_friction_has_none():
    none = FrictionModel(0.0 * COULOMB, 0.0 * COULOMB, 0.0 * COULOMB, np.ones(N))
    rng = np.random.default_rng(5)
    fits = list(identify(ARM.model, noisy(record(*PARTS, truth=none), rng)))
    for fit, coulomb in zip(fits, COULOMB, strict=True):
        assert max(fit.coulomb, fit.static) < 0.05 * coulomb
    told = list(itertools.chain.from_iterable(fit.notes for fit in fits))
    assert sum("Coulomb friction not told" in note for note in told) >= N - 2


def test_recordings_of_another_robot_are_refused():
    four = (getattr(RECORDING, key)[:, :4] for key in ("q", "v", "tau"))
    with pytest.raises(RecordingError, match="4 joints, the robot 7"):
        next(identify(ARM.model, Recording(RECORDING.t, *four)))
