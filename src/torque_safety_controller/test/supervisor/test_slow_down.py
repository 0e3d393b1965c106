# SPDX-License-Identifier: Apache-2.0
"""The share of the goals over time, and what becomes of bounds near a limit by it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torque_safety_controller.parts.slow_down import SlowDown
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.ramp import Ramp

DT = 0.01
LIMITS = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
finite = st.floats(-20.0, 20.0)


def shares(ramp, seconds, **state):
    """Let the time pass; return the share after each period."""
    found = []
    for _ in range(round(seconds / DT)):
        ramp.advance(DT, **state)
        found.append(ramp.share)
    return found


def test_the_share_falls_in_a_twentieth_of_a_second_and_rises_in_half_of_one():
    ramp = Ramp(DT)
    ramp.fall()
    falling = shares(ramp, 0.05, at_rest=True)
    assert (np.diff([1.0, *falling]) < 0.0).all()
    assert falling[-1] == pytest.approx(0.0, abs=1e-20)
    assert max(shares(ramp, 0.1, at_rest=False)) < 1e-20, "only at rest it rises"
    rising = shares(ramp, 0.51, at_rest=True)
    assert rising[9] == pytest.approx((10 * DT / 0.5) ** 2)
    assert rising[-1] == 1.0


def test_an_arm_that_does_not_come_to_rest_goes_on_after_a_second_but_not_while_it_is_to_wait():
    ramp = Ramp(DT)
    ramp.fall(at_once=True)
    assert not any(shares(ramp, 0.99, at_rest=False))
    assert not any(shares(ramp, 3.0, at_rest=False, waits=True))
    assert shares(ramp, 0.03, at_rest=False)[-1] > 0.0


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
@pytest.mark.parametrize("speed", [1e-3, 0.2])
def test_a_joint_that_moves_on_stops_before_its_limit_more_gently_than_its_bounds(side, speed):
    dt = 0.002
    slow = SlowDown(*LIMITS, dt)
    demanded = np.array([-20.0, -5.0]), np.array([-20.0, 5.0])  # upwards, of the first joint
    lower, upper = demanded if side > 0.0 else (-demanded[1], -demanded[0])
    q, v = side * np.array([0.98, 0.0]), side * np.array([speed, 0.0])
    for _ in range(500):
        bounds = slow.return_bounds(AccelerationRange(lower, upper), q, v, 0.0)
        a = np.clip(0.0, *bounds)
        assert np.abs(a).max() < 20.0
        q, v = q + dt * v + 0.5 * dt * dt * a, v + dt * a
        assert (np.abs(q) < 1.0).all()
    assert abs(v[0]) < 1e-3 + 0.01 * speed
