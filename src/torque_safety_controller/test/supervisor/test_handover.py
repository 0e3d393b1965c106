# SPDX-License-Identifier: Apache-2.0
"""When torque control may begin, and from which torque."""

import numpy as np
import pytest

from torque_safety_controller.handover import Handover, HandoverRefused

Q_MIN, Q_MAX = np.array([-1.0, -np.inf, 0.0]), np.array([1.0, np.inf, 2.0])
TAU_MAX = np.array([10.0, 20.0, 30.0])
Q, TAU = np.array([0.5, 9.0, 1.0]), np.array([-10.0, 20.0, 0.0])


def make() -> Handover:
    return Handover(("a", "b", "c"), Q_MIN, Q_MAX, TAU_MAX, 0.01)


def known_torque(handover, torques):
    """Begin, and return the torque as soon as it is known."""
    torques = iter(torques)
    handover.start(Q, next(torques))
    for tau in torques:
        if (known := handover.torque(Q, tau)) is not None:
            return known
    raise AssertionError("it never was")


@pytest.mark.parametrize(
    ("q", "tau", "reason"),
    [
        (np.array([1.001, 9.0, 1.0]), TAU, "outside the position limits: a"),
        (np.array([-1.5, -1e6, -0.1]), TAU, "outside the position limits: a, c"),
        (Q, None, "no motor torque"),
        (Q, np.array([-10.2, 0.0, 30.4]), "beyond torque_max: a, c"),
    ],
)
def test_torque_is_refused_with_the_reason(q, tau, reason):
    handover = make()
    with pytest.raises(HandoverRefused, match=reason):
        handover.start(q, tau)
    handover.start(Q, 1.005 * TAU)  # what a sensor adds to full torque is tolerated


def test_torques_without_noise_are_known_from_a_few_states_as_they_are_now():
    """Also such that drift, and of each handover by itself."""
    handover = make()
    for drift in (0.0, 0.002):
        torques = [drift * k * TAU_MAX - 0.5 for k in range(20)]
        known = known_torque(handover, torques)
        assert known.samples < 15
        np.testing.assert_allclose(known.mean, torques[known.samples], atol=1e-9)


def test_noise_is_averaged_until_the_mean_is_known_to_half_a_per_cent():
    """As stated, in most runs; and within twice as much in all."""
    off = []
    for seed in range(30):
        noise = 0.005 * TAU_MAX * np.random.default_rng(seed).standard_normal((200, 3))
        known = known_torque(make(), TAU + np.concatenate([np.zeros((1, 3)), noise]))
        assert known.samples < 100
        assert (known.error <= 0.005).all()
        off.append((np.abs(known.mean - TAU) / TAU_MAX / 0.005).max())
    assert np.mean(np.array(off) < 1.0) > 0.9
    assert max(off) < 2.0


def test_a_torque_that_stays_unknown_is_refused_after_two_seconds():
    random, handover, periods = np.random.default_rng(1), make(), 0
    handover.start(Q, 0.5 * TAU)
    with pytest.raises(HandoverRefused, match=r"torque of b is known to \d+\.\d+% of torque_max"):
        while periods < 10_000:
            noise = np.array([0.0, 5.0, 0.0]) * random.standard_normal(3)
            assert handover.torque(Q, 0.5 * TAU + noise) is None
            periods += 1
    assert periods == pytest.approx(200, abs=1)
