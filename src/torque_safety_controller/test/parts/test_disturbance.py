# SPDX-License-Identifier: Apache-2.0
"""What disturbs the arm is estimated, and narrows the bounds of the commanded accelerations."""

import math

import numpy as np
import pytest
from arms import load_arm
from hypothesis import given
from hypothesis import strategies as st

from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.step import Step
from torque_safety_controller.supervisor import Order
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

DT = 1e-3
LARGEST = np.array([50.0])
ONE = np.eye(1)
STEP = Step(load_arm("panda").robot(), None, Order(), DT, LARGEST, np.zeros(7), 20.0)


def commanded(observer, lower, upper) -> AccelerationRange:
    """Bounds of the commanded accelerations, for bounds of the real ones."""
    STEP.disturbance = observer.estimate
    return STEP.commanded(AccelerationRange(lower, upper))


def ride(time_constant, push, noise=0.0):
    """Push a joint at its upper limits as hard as the bounds allow, with something pushing too.

    Returns how far it got beyond its position and its speed limit.
    """
    limits = JointLimits(["joint"], [-1.0], [1.0], [1.0], [-20.0], [20.0])
    solver = BoundsSolver(limits, 2 * DT, period=DT)
    observer = Disturbance(1, time_constant or 0.0)
    rng = np.random.default_rng(0)
    q, v, a = np.array([-0.5]), np.zeros(1), np.zeros(1)
    beyond = np.full(2, -math.inf)
    for _ in range(2500):
        seen = v + noise * rng.normal(size=1)
        bounds = solver.bounds(q, seen)
        if time_constant is not None:
            observer.observe(seen, a, DT, LARGEST, ONE)
        a = commanded(observer, bounds.lower, bounds.upper).upper
        q, v = q + DT * v + 0.5 * DT * DT * (a + push), v + DT * (a + push)
        beyond = np.maximum(beyond, [q[0] - 1.0, v[0] - 1.0])
    return beyond


@pytest.mark.parametrize(
    ("time_constant", "speed_max"),
    [(0.0, 1e-9), (0.003, 1e-3)],
)
def test_a_lasting_push_does_not_carry_the_joint_beyond_its_limits(time_constant, speed_max):
    position, speed = ride(None, 8.0)
    assert position > 1e-4 and speed > 5e-3
    # One step passes before the push is known: its effect, v dt + a dt^2 / 2, may remain.
    position, speed = ride(time_constant, 8.0)
    assert position < 8.0 * DT**2 and speed < speed_max


def test_friction_does_not_widen_the_bounds():
    """It brakes; when it is gone, as at a reversal, nothing had relied on it."""
    observer = Disturbance(1, 0.0)
    for _ in range(2):  # asked for 3 rad/s^2 and had none
        observer.observe(np.zeros(1), np.array([3.0]), DT, LARGEST, ONE)
    np.testing.assert_allclose(observer.estimate, -3.0)
    assert commanded(observer, np.array([-5.0]), np.array([3.0])) == (-2.0, 3.0)


THREE_NUMBERS = st.lists(
    st.floats(allow_nan=True, allow_infinity=True), min_size=3, max_size=3
).map(np.array)


@given(THREE_NUMBERS, THREE_NUMBERS)
def test_bounds_stay_bounds(v, a):
    observer = Disturbance(3, 0.002)
    lower, upper = np.array([-5.0, 2.0, 0.0]), np.array([5.0, 2.0, 1e-12])
    with np.errstate(all="ignore"):
        for sign in (1.0, -1.0, 1.0):
            observer.observe(sign * v, a, DT, np.full(3, 30.0), np.eye(3))
            low, high = commanded(observer, lower, upper)
            assert (low <= high).all()
            assert (np.abs(low - lower) <= 30.0 + 10.0).all()


def test_a_change_of_the_additional_torque_counts_before_it_is_seen():
    """With it in time the bounds of the true acceleration are kept in the very step."""
    M = np.array([[2.0, 0.9], [0.9, 0.5]])
    observer = Disturbance(2, 0.003)
    change, largest = np.array([0.2, -0.1]), np.full(2, 1e3)
    observer.expect(change, largest, M)
    np.testing.assert_allclose(observer.estimate, np.linalg.solve(M, change))
    observer.expect(np.full(2, 1e9), largest, M)
    assert (np.abs(observer.estimate) <= largest / np.diagonal(M)).all()
