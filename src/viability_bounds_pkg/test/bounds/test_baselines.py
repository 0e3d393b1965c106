# SPDX-License-Identifier: Apache-2.0
"""What the other methods promise, and where they fail."""

import numpy as np
import pytest
from joint_cases import column, one_joint

from viability_bounds_pkg.baselines import (
    decre_bounds,
    decre_velocity_range,
    naive_bounds,
    rubrecht_bounds,
    rubrecht_velocity_range,
)
from viability_bounds_pkg.viability import acceleration_bounds, viable_velocity_range

FIGURE_1 = one_joint(-1.0, 1.0, 5.0, -15.0, 15.0)
ASYMMETRIC = one_joint(-1.0, 2.0, 5.0, -15.0, 6.0)
FIGURE_4 = one_joint(-1.7, 2.0, 2.0, -12.0, 12.0)


@pytest.mark.parametrize("method", [naive_bounds, decre_bounds, rubrecht_bounds])
def test_bounds_are_ordered_and_within_the_acceleration_limits(method):
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-1.1, 2.1, (5000, 1)), rng.uniform(-6.0, 6.0, (5000, 1))
    lower, upper, viable = method(q, v, ASYMMETRIC, 0.01)
    assert (ASYMMETRIC.a_min <= lower).all()
    assert (lower <= upper).all()
    assert (upper <= ASYMMETRIC.a_max).all()
    assert viable.any() and not viable.all()


def test_naive_bounds_are_equation_2():
    # Far from all limits, at the speed limit, at a position limit.
    lower, upper, _ = naive_bounds(
        column([0.0, 0.0, 0.999]), column([0.0, 4.9, 0.1]), FIGURE_1, 0.1
    )
    assert upper[:, 0] == pytest.approx([15.0, 1.0, 2.0 / 0.01 * (0.001 - 0.01)])
    assert lower[:, 0] == pytest.approx([-15.0, -15.0, -15.0])


@pytest.mark.parametrize("limits", [FIGURE_1, ASYMMETRIC])
def test_velocity_ranges_are_inside_the_kernel(limits):
    """Fig. 1: [5] inside [6] inside the kernel; and [5] and [6] approach it as dt does zero."""
    q = column(np.linspace(limits.q_min[0], limits.q_max[0], 1001))
    kernel = viable_velocity_range(q, limits)
    for dt in (0.1, 0.01):
        decre = decre_velocity_range(q, limits, dt)
        rubrecht = rubrecht_velocity_range(q, limits, dt)
        for outer, inner in ((kernel, decre), (decre, rubrecht)):
            assert (inner[1] <= outer[1] + 1e-12).all()
            assert (inner[0] >= outer[0] - 1e-12).all()
        assert rubrecht[1].max() == pytest.approx(5.0, abs=0.6)
    for velocity_range in (decre_velocity_range, rubrecht_velocity_range):
        assert velocity_range(q, limits, 1e-9)[1] == pytest.approx(kernel[1], abs=1e-6)


def pull_to_the_limit(bounds, dt_bounds=0.01, dt=0.01):
    """The test of Fig. 4: a PD controller whose goal is 0.1 rad beyond the upper limit, 2 s long.

    Returns the largest position and the speed at which the joint passed its limit.
    """
    q, v, highest, impact = 1.0, 0.0, -np.inf, 0.0
    kp = 1000.0
    for _ in range(200):
        desired = kp * (2.1 - q) - 2.0 * np.sqrt(kp) * v
        lower, upper, _ = bounds([q], [v], FIGURE_4, dt_bounds)
        a = float(np.clip(desired, lower[0], upper[0]))
        before = q
        q, v = q + dt * v + 0.5 * dt**2 * a, v + dt * a
        if before <= 2.0 < q:
            impact = max(impact, v)
        highest = max(highest, q)
    return highest, impact


def test_naive_bounds_break_the_limit_and_larger_steps_only_soften_it():
    """Fig. 4a and 4b."""
    highest, impact = pull_to_the_limit(naive_bounds)
    softer, softer_impact = pull_to_the_limit(naive_bounds, dt_bounds=0.03)
    assert 2.0 + 1e-3 < softer < highest
    assert highest > 2.0 + 0.05
    assert softer_impact < impact


@pytest.mark.parametrize("factor", [1, 3])
def test_exact_bounds_let_the_joint_come_to_its_limit_and_no_further(factor):
    """Fig. 4c and 4d."""
    assert 2.0 - 1e-2 < pull_to_the_limit(acceleration_bounds, 0.01 * factor)[0] <= 2.0 + 1e-9


def test_velocity_methods_under_constant_acceleration():
    """They count on velocities that change in steps, so that even a consistent one misses."""
    # On the way from speed v to w < v the joint goes dt (v - w) / 2 further than dt w.
    step_error = 0.5 * 12.0 * 0.01**2
    assert 2.0 < pull_to_the_limit(rubrecht_bounds)[0] <= 2.0 + step_error
    assert pull_to_the_limit(decre_bounds)[0] > 2.0 + 10.0 * step_error
