# SPDX-License-Identifier: Apache-2.0
"""Algorithm 4 and the refined search, against Pinocchio."""

import math

import numpy as np
import pinocchio as pin
import pytest
from estimated_models import (
    GRAVITY,
    PENDULUM_LENGTH,
    PENDULUM_MASS,
    baxter,
    limits_of,
    panda,
    pendulum,
)

from viability_bounds_pkg.acceleration_limits import (
    estimate_acceleration_limits,
    limits_in_share,
)
from viability_bounds_pkg.estimate.worst_case import (
    LimitEstimateError,
    StateSpace,
    search_by_sampling,
    search_refined,
)


def algorithm_4(model, q, v, tau_max):
    """Lines 6 to 12 of Algorithm 4 as printed, over the states given."""
    data = model.createData()
    upper, lower = np.full(model.nv, np.inf), np.full(model.nv, -np.inf)
    for q_i, v_i in zip(q, v, strict=True):
        inertia = pin.crba(model, data, q_i)
        h = pin.nonLinearEffects(model, data, q_i, v_i)
        for j in range(model.nv):
            upper[j] = min(upper[j], (tau_max[j] - h[j]) / inertia[j, j])
            lower[j] = max(lower[j], (-tau_max[j] - h[j]) / inertia[j, j])
    return lower, upper


def test_sampling_is_algorithm_4():
    model, count = panda(), 1000
    q_min, q_max, v_max, tau_max = limits_of(model)
    unit = np.random.default_rng(5).random((count, 14))
    q = q_min + unit[:, :7] * (q_max - q_min)
    v = (2 * unit[:, 7:] - 1) * v_max
    lower, upper = algorithm_4(model, q, v, tau_max)
    limits = estimate_acceleration_limits(model, q_min, q_max, v_max, tau_max, count, 5)
    np.testing.assert_allclose(limits.a_min, lower, rtol=1e-10)
    np.testing.assert_allclose(limits.a_max, upper, rtol=1e-10)
    assert limits.worst.evaluations == count


def test_worst_states_give_the_limits():
    model = panda()
    q_min, q_max, v_max, tau_max = limits_of(model)
    worst = estimate_acceleration_limits(
        model, q_min, q_max, 0.5 * v_max, tau_max, 2000, 1, method="refined"
    ).worst
    for j in range(model.nv):
        for side, expected, limit in ((0, worst.a_max, tau_max), (1, worst.a_min, -tau_max)):
            q, v = worst.q[side, j], worst.v[side, j]
            assert np.all((q_min <= q) & (q <= q_max))
            assert np.all(np.abs(v) <= 0.5 * v_max)
            a = np.zeros(model.nv)
            a[j] = expected[j]
            tau = pin.rnea(model, model.createData(), q, v, a)
            assert tau[j] == pytest.approx(limit[j], rel=1e-9)


@pytest.mark.parametrize("method", ["sampling", "refined"])
def test_pendulum_limits_are_the_analytic_ones(method):
    inertia = PENDULUM_MASS * PENDULUM_LENGTH**2
    weight = PENDULUM_MASS * GRAVITY * PENDULUM_LENGTH
    limits = estimate_acceleration_limits(
        pendulum(), [-np.inf], [np.inf], [4.0], [30.0], 4000, 0, method=method
    )
    expected = (30.0 - weight) / inertia
    assert limits.a_max[0] == pytest.approx(expected, rel=1e-5)
    assert limits.a_min[0] == pytest.approx(-expected, rel=1e-5)
    # A joint without limits turns all the way round.
    assert abs(limits.worst.q[0, 0, 0]) == pytest.approx(math.pi / 2, abs=0.01)


def test_two_link_limits_are_the_analytic_ones():
    """Joint 1's room, h and M written out for two equal point masses on equal rods."""
    model = pendulum(links=2, joint_type="revolute")
    mass, length, v_max, tau_max = PENDULUM_MASS, PENDULUM_LENGTH, 1.0, 60.0
    grid = np.linspace(-3.0, 3.0, 601)
    q_1, q_2 = np.meshgrid(grid, grid)
    expected = np.inf
    for v_1 in (-v_max, v_max):
        for v_2 in (-v_max, 0.0, v_max):
            coriolis = -mass * length**2 * np.sin(q_2) * (2 * v_1 * v_2 + v_2**2)
            weight = mass * GRAVITY * length * (2 * np.sin(q_1) + np.sin(q_1 + q_2))
            inertia = mass * length**2 * (3 + 2 * np.cos(q_2))
            expected = min(expected, ((tau_max - coriolis - weight) / inertia).min())
    limits = estimate_acceleration_limits(
        model, [-3, -3], [3, 3], [v_max] * 2, [tau_max] * 2, 2000, method="refined"
    )
    assert limits.a_max[0] == pytest.approx(expected, rel=1e-3)
    assert limits.a_min[0] == pytest.approx(-expected, rel=1e-3)  # mirror image


def test_refined_search_beats_twenty_times_as_many_samples():
    model = baxter()
    space = StateSpace.of(model, *limits_of(model))
    sampled = search_by_sampling(model, space, 100_000, 0)
    refined = search_refined(model, space, 5000, 0)
    assert refined.evaluations <= 5000
    assert np.all(refined.a_max <= sampled.a_max)
    assert np.all(refined.a_min >= sampled.a_min)
    # The gain is not marginal: several limits are a fifth tighter.
    gain = (sampled.a_max - refined.a_max) / np.abs(sampled.a_max)
    assert np.count_nonzero(gain > 0.2) >= 2


@pytest.mark.parametrize("search", [search_by_sampling, search_refined])
def test_same_seed_same_limits(search):
    model = pendulum(links=2, joint_type="revolute")
    space = StateSpace.of(model, *limits_of(model))
    first, again, other = (search(model, space, 200, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.a_max, again.a_max)
    np.testing.assert_array_equal(first.q, again.q)
    assert np.any(first.q != other.q)


@pytest.mark.parametrize("search", [search_by_sampling, search_refined])
def test_progress_grows_up_to_the_whole(search):
    model, shares = pendulum(), []
    search(model, StateSpace.of(model, *limits_of(model)), 3000, 0, shares.append)
    assert len(shares) > 2 and shares == sorted(shares)
    assert 0.0 < shares[0] < 1.0 and shares[-1] <= 1.0


def test_limits_of_a_share_are_available_in_as_many_other_states():
    """By Algorithm 4's lines for single states, which are others than those used."""
    model, share = baxter(), 0.8
    q_min, q_max, v_max, tau_max = limits_of(model)
    space = StateSpace.of(model, q_min, q_max, v_max, tau_max)
    found = limits_in_share(model, space, share)
    rng, count = np.random.default_rng(3), 2000
    available = np.zeros(model.nv)
    for _ in range(count):
        q, v = rng.uniform(q_min, q_max), rng.uniform(-v_max, v_max)
        lower, upper = algorithm_4(model, [q], [v], tau_max)
        available += (lower <= -found) & (found <= upper)
    np.testing.assert_allclose(available / count, share, atol=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q_min": [0.0]}, "q_min must have 7 values"),
        ({"q_max": np.full(7, np.inf)}, "joint left_s0: position limits"),
        ({"v_max": np.zeros(7)}, "joint left_s0: v_max must be positive"),
        ({"tau_max": np.full(7, np.nan)}, "joint left_s0: tau_max must be positive"),
        ({"samples": 0}, "samples must be at least 1, is 0"),
        ({"method": "guess"}, "method must be one of sampling, refined"),
        ({"overrides": {"elbow": (-1, 1)}}, "unknown joint 'elbow'"),
        ({"overrides": {"left_s0": (1, 2)}}, "joint left_s0: override"),
        ({"cap": 0.0}, "cap must be positive"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    model = baxter()
    keys = ("q_min", "q_max", "v_max", "tau_max")
    arguments = dict(zip(keys, limits_of(model), strict=True)) | {"samples": 10, "seed": 0}
    with pytest.raises(LimitEstimateError, match=message):
        estimate_acceleration_limits(model, **arguments | change)


def test_a_joint_that_moves_nothing_is_named():
    with pytest.raises(LimitEstimateError, match="joint joint1 moves no inertia"):
        estimate_acceleration_limits(pendulum(tip_mass=0.0), [-1], [1], [1], [1], 10)
