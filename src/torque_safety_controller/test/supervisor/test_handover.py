# SPDX-License-Identifier: Apache-2.0
"""When torque control may begin, and from which torque."""

import numpy as np
import pytest

from torque_safety_controller.handover import (
    FEWEST,
    PATIENCE,
    TORQUE_ERROR,
    Handover,
    HandoverRefused,
)

JOINTS = ("a", "b", "c")
Q_MIN, Q_MAX = np.array([-1.0, -np.inf, 0.0]), np.array([1.0, np.inf, 2.0])
TAU_MAX = np.array([10.0, 20.0, 30.0])
Q, TAU = np.array([0.5, 9.0, 1.0]), np.array([-10.0, 20.0, 0.0])


def make() -> Handover:
    return Handover(JOINTS, Q_MIN, Q_MAX, TAU_MAX, 0.01)


def test_the_position_is_captured_once_and_copied():
    handover = make()
    q = Q.copy()
    handover.hold(q)
    q += 1.0
    np.testing.assert_array_equal(handover.hold(q), Q)
    handover.start(Q, TAU)
    np.testing.assert_array_equal(handover.hold(q), Q)
    handover.release()
    np.testing.assert_array_equal(handover.hold(q), q)


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


def test_a_torque_without_noise_is_known_from_a_few_states():
    handover = make()
    handover.start(Q, TAU)
    for _ in range(FEWEST - 1):
        assert handover.torque(Q, TAU) is None
    known = handover.torque(Q, TAU)
    assert known.samples == FEWEST
    np.testing.assert_allclose(known.mean, TAU)
    np.testing.assert_allclose(known.error, 0.0, atol=1e-12)


def test_noise_is_averaged_until_the_mean_is_known_well_enough():
    """As stated, in most runs; and within twice as much in all."""
    off = []
    for seed in range(50):
        random, handover, known = np.random.default_rng(seed), make(), None
        handover.start(Q, TAU)
        while known is None:
            known = handover.torque(Q, TAU + 0.005 * TAU_MAX * random.standard_normal(3))
        assert FEWEST <= known.samples < 100
        assert (known.error <= TORQUE_ERROR).all()
        off.append((np.abs(known.mean - TAU) / TAU_MAX / TORQUE_ERROR).max())
    assert np.mean(np.array(off) < 1.0) > 0.95
    assert max(off) < 2.0


def test_a_torque_that_drifts_is_known_as_it_is_now():
    handover = make()
    handover.start(Q, 0.0 * TAU)
    known = None
    for k in range(FEWEST):
        assert known is None
        known = handover.torque(Q, 0.002 * k * TAU_MAX)
    np.testing.assert_allclose(known.mean, 0.002 * (FEWEST - 1) * TAU_MAX)


def test_a_torque_that_stays_unknown_is_refused_after_some_time():
    random, handover, periods = np.random.default_rng(1), make(), 0
    handover.start(Q, 0.5 * TAU + 1.0)
    with pytest.raises(HandoverRefused, match=r"torque of b is known to \d+\.\d+% of torque_max"):
        while periods < 10_000:
            noise = np.array([0.0, 5.0, 0.0]) * random.standard_normal(3)
            assert handover.torque(Q, 0.5 * TAU + noise) is None
            periods += 1
    assert periods == pytest.approx(PATIENCE / 0.01, abs=1)


def test_a_handover_asked_for_again_begins_to_average_anew():
    handover = make()
    for tau in (TAU, -TAU):
        handover.start(Q, tau)
        for _ in range(FEWEST):
            known = handover.torque(Q, tau)
        np.testing.assert_allclose(known.mean, tau)
