# SPDX-License-Identifier: Apache-2.0
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


def commanded(observer, lower, upper) -> AccelerationRange:
    """Bounds of the commanded accelerations, for bounds of the real ones."""
    n = len(lower)
    step = Step(load_arm("panda").robot(), None, Order(), DT, LARGEST, np.zeros(7), 20.0)
    step.disturbance = observer.estimate
    assert len(observer.estimate) == n
    return step.commanded(AccelerationRange(lower, upper))


def ride(time_constant, disturbance, noise=0.0, seed=0):
    """Push a joint at its upper limits as hard as the bounds allow, with something pushing too.

    Returns how far it got beyond its position and its speed limit.
    """
    limits = JointLimits(["joint"], [-1.0], [1.0], [1.0], [-20.0], [20.0])
    solver = BoundsSolver(limits, 2 * DT, period=DT)
    observer = Disturbance(1, time_constant or 0.0)
    rng = np.random.default_rng(seed)
    q, v, a = np.array([-0.9]), np.zeros(1), np.zeros(1)
    beyond = [-math.inf, -math.inf]
    for k in range(4000):
        seen = v + noise * rng.normal(size=1)
        bounds = solver.bounds(q, seen)
        if time_constant is not None:
            observer.observe(seen, a, DT, LARGEST, np.eye(1))
        _, upper = commanded(observer, bounds.lower, bounds.upper)
        a = upper
        true = a + disturbance(k * DT)
        q = q + DT * v + 0.5 * DT * DT * true
        v = v + DT * true
        beyond = [max(beyond[0], q[0] - 1.0), max(beyond[1], v[0] - 1.0)]
    return beyond


def test_a_lasting_push_towards_the_limit_does_not_carry_the_joint_beyond():
    def push(t):
        return 8.0

    position, speed = ride(None, push)
    assert position > 1e-4 and speed > 5e-3
    # One step passes before the push is known: its effect, v dt + a dt^2 / 2, may remain.
    position, speed = ride(0.0, push)
    assert position < 8.0 * DT**2 and speed < 1e-9
    position, speed = ride(0.003, push)
    assert position < 8.0 * DT**2 and speed < 1e-3


def test_friction_does_not_widen_the_bounds():
    """It brakes; when it is gone, as at a reversal, nothing had relied on it."""
    observer = Disturbance(1, 0.0)
    lower, upper = np.array([-5.0]), np.array([3.0])
    v, a = np.zeros(1), np.array([3.0])
    observer.observe(v, a, DT, LARGEST, np.eye(1))
    observer.observe(v, a, DT, LARGEST, np.eye(1))  # asked for 3 rad/s^2 and had none
    np.testing.assert_allclose(observer.estimate, -3.0)
    low, high = commanded(observer, lower, upper)
    assert high == upper and low == lower + 3.0


def test_noise_of_the_velocity_costs_little():
    position, speed = ride(0.003, lambda t: 0.0, noise=1e-4)
    assert position < 1e-4 and speed < 1e-3


NUMBERS = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(NUMBERS, min_size=3, max_size=3), st.lists(NUMBERS, min_size=3, max_size=3))
def test_bounds_stay_bounds(v, a):
    observer = Disturbance(3, 0.002)
    largest = np.full(3, 30.0)
    lower, upper = np.array([-5.0, 2.0, 0.0]), np.array([5.0, 2.0, 1e-12])
    with np.errstate(all="ignore"):
        for sign in (1.0, -1.0, 1.0):
            observer.observe(sign * np.array(v), np.array(a), DT, largest, np.eye(3))
            low, high = commanded(observer, lower, upper)
            assert (low <= high).all()
            assert (np.abs(low - lower) <= 30.0 + 10.0).all()


def test_it_keeps_what_it_knows_over_a_time_it_does_not_know():
    failed = Step(load_arm("panda").robot(), None, Order(), DT, LARGEST, np.zeros(7), 20.0)
    failed.failure = "no solution"
    observer = Disturbance(1, 0.0)
    for v in (0.0, 1.0):
        observer.observe(np.array([v]), np.zeros(1), 0.1, LARGEST, np.eye(1))
    assert observer.estimate == pytest.approx(10.0)
    for elapsed in (0.0, -1.0, math.nan):
        observer.observe(np.array([5.0]), np.zeros(1), elapsed, LARGEST, np.eye(1))
    assert observer.estimate == pytest.approx(10.0)
    observer.learn(failed)
    observer.observe(np.array([9.0]), np.zeros(1), 0.1, LARGEST, np.eye(1))
    assert observer.estimate == pytest.approx(10.0)
    observer.observe(np.array([9.3]), np.zeros(1), 0.1, LARGEST, np.eye(1))
    assert observer.estimate == pytest.approx(3.0)
    observer.reset()
    lower, upper = np.array([-1.0]), np.array([1.0])
    assert commanded(observer, lower, upper) == AccelerationRange(lower, upper)


def test_a_change_of_the_additional_torque_counts_before_it_is_seen():
    """With it in time the bounds of the true acceleration are kept in the very step."""
    M = np.array([[2.0, 0.9], [0.9, 0.5]])
    observer = Disturbance(2, 0.003)
    change = np.array([0.2, -0.1])
    observer.expect(change, np.full(2, 1e3), M)
    d = np.linalg.inv(M) @ change
    np.testing.assert_allclose(observer.estimate, d)
    lower, upper = np.full(2, -3.0), np.full(2, 3.0)
    low, high = commanded(observer, lower, upper)
    assert (low + np.minimum(d, 0.0) >= lower - 1e-12).all()
    assert (high + np.maximum(d, 0.0) <= upper + 1e-12).all()
    observer.expect(np.full(2, 1e9), np.full(2, 1e3), M)
    assert (np.abs(observer.estimate) <= 1e3 / np.diagonal(M)).all()
