# SPDX-License-Identifier: Apache-2.0
"""The share of the goals over time, and what becomes of tasks and bounds by it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torque_safety_controller.parts.slow_down import SlowDown
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.ramp import FALL_TIME, REST_TIME, RISE_TIME, Ramp

DT = 0.01
LIMITS = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
finite = st.floats(-20.0, 20.0)


def test_it_falls_within_its_time_and_rises_once_the_arm_rests():
    ramp = Ramp(DT)
    ramp.fall()
    falling = [ramp.share]
    for _ in range(round(FALL_TIME / DT)):
        ramp.advance(DT, at_rest=True)
        falling.append(ramp.share)
    assert (np.diff(falling) < 0.0).all() and falling[-1] == pytest.approx(0.0, abs=1e-20)
    for _ in range(10):
        ramp.advance(DT, at_rest=False)
    assert ramp.share == pytest.approx(0.0, abs=1e-20)
    rising = []
    for _ in range(round(RISE_TIME / DT) + 1):
        ramp.advance(DT, at_rest=True)
        rising.append(ramp.share)
    assert ramp.share == 1.0
    np.testing.assert_allclose(rising[9], (10 * DT / RISE_TIME) ** 2)


def test_a_fall_takes_all_of_the_time_that_has_gone_by_and_a_rise_one_period():
    ramp = Ramp(DT)
    ramp.fall()
    ramp.advance(2.0 * FALL_TIME, at_rest=False)
    assert ramp.share == 0.0
    ramp.advance(1.0, at_rest=True)
    assert ramp.share == pytest.approx((DT / RISE_TIME) ** 2)


def test_an_arm_that_does_not_come_to_rest_is_not_waited_for_for_ever():
    ramp = Ramp(DT)
    ramp.fall(at_once=True)
    for _ in range(round(REST_TIME / DT)):
        assert ramp.share == 0.0
        ramp.advance(DT, at_rest=False)
    ramp.advance(DT, at_rest=False)
    ramp.advance(DT, at_rest=False)
    assert ramp.share > 0.0


def test_it_does_not_rise_while_it_is_to_wait():
    ramp = Ramp(DT)
    ramp.fall(at_once=True)
    for _ in range(300):
        ramp.advance(DT, at_rest=True, waits=True)
    assert ramp.share == 0.0


@given(
    q=st.tuples(*[st.floats(-1.2, 1.2)] * 2),
    v=st.tuples(*[st.floats(-2.0, 2.0)] * 2),
    low=st.tuples(finite, finite),
    width=st.tuples(*[st.floats(0.0, 20.0)] * 2),
    share=st.floats(0.0, 1.0),
)
def test_bounds_of_the_return_are_an_interval_that_asks_for_no_more(q, v, low, width, share):
    q, v, lower = map(np.array, (q, v, low))
    bounds = AccelerationRange(lower, lower + width)
    found = SlowDown(*LIMITS, DT).return_bounds(bounds, q, v, share)
    assert (found.lower <= found.upper).all()
    # Only what is demanded gets less, and braking never turns round.
    assert (found.lower <= bounds.lower).all() and (found.upper >= bounds.upper).all()
    assert (found.lower >= np.minimum(bounds.lower, 0.0)).all()
    assert (found.upper <= np.maximum(bounds.upper, 0.0)).all()
    if share == 1.0:
        np.testing.assert_array_equal(found, bounds)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("speed", [1e-3, 0.02, 0.2])
def test_a_joint_that_moves_on_stops_before_its_limit_without_goals(side, speed):
    """Bounds that ask for more are there, but not needed."""
    slow, dt = SlowDown(*LIMITS, 0.002), 0.002
    q, v = side * np.array([0.98, 0.0]), side * np.array([speed, 0.0])
    for _ in range(500):
        demand = np.array([20.0, 0.0])
        bounds = AccelerationRange(np.array([-20.0, -5.0]), np.array([20.0, 5.0]))
        lower, upper = bounds
        if side > 0.0:
            upper = upper - 2.0 * demand
        else:
            lower = lower + 2.0 * demand
        lower, upper = slow.return_bounds(AccelerationRange(lower, upper), q, v, 0.0)
        a = np.clip(0.0, lower, upper)
        assert np.abs(a).max() < 20.0
        q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
        assert (np.abs(q) < 1.0).all()
    assert abs(v[0]) < 1e-3 + 0.01 * speed


def test_where_limits_are_left_the_bounds_count_as_they_are():
    bounds = AccelerationRange(np.array([3.0, -9.0]), np.array([9.0, -3.0]))
    v = np.array([-0.1, 0.1])
    beyond = np.array([-1.01, 1.01])
    found = SlowDown(*LIMITS, DT).return_bounds(bounds, beyond, v, 0.0)
    np.testing.assert_array_equal(found, bounds)
