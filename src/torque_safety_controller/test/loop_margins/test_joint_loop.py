# SPDX-License-Identifier: Apache-2.0
"""The linear loop of a joint: against a loop over time, and its margins."""

import math
from collections import deque

import numpy as np
import pytest

from torque_safety_controller.integral_feedback.leaky_integrator import LeakyIntegrator
from torque_safety_controller.loop_margins.joint_loop import (
    Feedback,
    Link,
    filter_share,
    limit_gains,
    motion,
    open_loop,
)
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

DT = 1e-3
LEAK = (0.1, 100.0, 0.5)
POLE = math.exp(-150.0 * DT)
OBSERVER = 1.0 - POLE**2, (1.0 - POLE) ** 2 / DT


def simulated(link, gains, steps=400, factor=1.0):
    """Return the positions of a joint with unit inertia, written as a loop over time."""
    A, b = motion(DT, link.lag)
    x = np.array([0.01, 0.0, 0.0])
    under_way = deque([0.0] * link.delay)
    sent = deque([0.0] * (link.predicted or 0))
    lag = link.lag if link.predicted is not None else 0.0
    A_model, b_model = motion(DT, lag)
    fast, slow = LeakyIntegrator(gains.leak[1], 1), LeakyIntegrator(gains.leak[0], 1)
    estimate = np.zeros(3)
    s, v_before, a_ref, e = 0.0, 0.0, 0.0, 0.0
    found = []
    for _ in range(steps):
        found.append(x[0])
        seen = np.array([x[0], x[1], estimate[2]])
        if link.observer is not None:
            error = x[0] - estimate[0]
            seen[:2] = estimate[:2] + np.multiply(link.observer, error)
        ahead = seen
        for command in sent:
            ahead = A_model @ ahead + b_model * command
        ahead = ahead + lag * np.array([ahead[1], ahead[2], 0.0])
        increment = a_ref * DT - (ahead[1] - v_before)
        s += increment
        integral = gains.leak[2] * fast.update([s], DT) + (1.0 - gains.leak[2]) * slow.update(
            [s], DT
        )
        a_ref = -gains.kp * ahead[0] - gains.kd * ahead[1]
        if gains.disturbance_time:
            e += filter_share(gains.disturbance_time, DT) * (-increment / DT - e)
            a_ref -= e
        v_before = ahead[1]
        command = a_ref + gains.integral * integral[0]
        sent.append(command)
        estimate = A_model @ seen + b_model * sent.popleft()
        under_way.append(factor * command)
        x = A @ x + b * under_way.popleft()
    return np.array(found)


CASES = [
    (Link(DT), Feedback(900.0, 50.0)),
    (Link(DT, 2), Feedback(900.0, 50.0, 100.0, LEAK, 0.003)),
    (Link(DT, 1, 1.0 / 300.0), Feedback(400.0, 40.0, 50.0)),
    (Link(DT, 2, 5e-3, predicted=2), Feedback(900.0, 60.0, 100.0)),
    (Link(DT, 3, 5e-3, OBSERVER, 2), Feedback(900.0, 60.0, 50.0)),
]


@pytest.mark.parametrize("case", CASES)
def test_the_matrices_are_those_of_the_loop_written_out(case, factor=1.25):
    loop = open_loop(*case)
    q = simulated(*case, factor=factor)
    x = np.zeros(len(loop.b))
    x[0] = q[0]
    closed = loop.A + factor * np.outer(loop.b, loop.c)
    expected = []
    for _ in q:
        expected.append(x[0])
        x = closed @ x
    np.testing.assert_allclose(q, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_the_modulus_margin_is_a_gain_margin(case):
    """The loop stays stable with gains between 1 / (1 + m) and 1 / (1 - m)."""
    loop = open_loop(*case)
    margin = loop.modulus_margin()
    assert 0.0 < margin < 1.0
    for factor in (1.0 / (1.0 + 0.99 * margin), 1.0 / (1.0 - 0.99 * margin)):
        assert loop._replace(b=factor * loop.b).spectral_radius() < 1.0 + 1e-6


def test_the_bounds_of_the_paper_have_half_a_margin_and_bear_no_delay():
    """Slopes 2 / T^2 and 2 / T for T of two periods: |z|^2 = 1 / 4, with a delay 3 / 2."""
    horizon = 2.0 * DT
    gains = Feedback(2.0 / horizon**2, 2.0 / horizon)
    loop = open_loop(Link(DT), gains)
    assert loop.modulus_margin() == pytest.approx(0.5, abs=1e-3)
    late = open_loop(Link(DT, 1), gains)
    assert late.spectral_radius() == pytest.approx(math.sqrt(1.5), abs=1e-6)
    assert late.modulus_margin() == 0.0


@pytest.mark.parametrize("disturbance", [0.0, 4.0])
def test_bounds_at_a_limit_are_as_steep_as_the_formula_says(disturbance):
    limits = JointLimits(["a"], [-1.0], [1.0], [2.0], [-10.0], [10.0])
    horizon, margin = 2.0 * DT, np.array([disturbance])
    solver = BoundsSolver(limits, horizon, margin, DT)

    def upper(x, v):
        return solver.bounds(np.array([1.0 - x]), np.array([v])).upper[0]

    low, high = 0.0, 1e-3
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if upper(middle, 0.0) < 0.0 else (low, middle)
    step_q, step_v = 1e-9, 1e-6
    kp_found, kd_found = limit_gains(horizon, margin, np.array([10.0]))
    kp = (upper(high + step_q, 0.0) - upper(high, 0.0)) / step_q
    kd = (upper(high, -step_v) - upper(high, 0.0)) / step_v
    assert kp == pytest.approx(kp_found[0], rel=0.02)
    assert kd == pytest.approx(kd_found[0], rel=0.02)
