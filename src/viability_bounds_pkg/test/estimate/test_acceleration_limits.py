# SPDX-License-Identifier: Apache-2.0
"""Algorithm 4 and the refined search, against Pinocchio."""

from __future__ import annotations

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
    EmptyIntervalError,
    estimate_acceleration_limits,
    largest_velocity_scale,
    limits_from_worst_cases,
    limits_in_share,
    unavailable_share,
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
    model, count = panda(), 3000
    q_min, q_max, v_max, tau_max = limits_of(model)
    unit = np.random.default_rng(5).random((count, 14))
    q = q_min + unit[:, :7] * (q_max - q_min)
    v = (2 * unit[:, 7:] - 1) * v_max
    lower, upper = algorithm_4(model, q, v, tau_max)
    limits = estimate_acceleration_limits(model, q_min, q_max, v_max, tau_max, count, 5)
    np.testing.assert_allclose(limits.a_min, lower, rtol=1e-10)
    np.testing.assert_allclose(limits.a_max, upper, rtol=1e-10)
    assert limits.worst.evaluations == count


@pytest.mark.parametrize("method", ["sampling", "refined"])
def test_worst_states_give_the_limits(method):
    model = panda()
    q_min, q_max, v_max, tau_max = limits_of(model)
    worst = estimate_acceleration_limits(
        model, q_min, q_max, 0.5 * v_max, tau_max, 2000, 1, method=method
    ).worst
    for j in range(model.nv):
        for q, v, expected, side in (
            (worst.q[0, j], worst.v[0, j], worst.a_max[j], 1),
            (worst.q[1, j], worst.v[1, j], worst.a_min[j], -1),
        ):
            assert np.all((q_min <= q) & (q <= q_max))
            assert np.all(np.abs(v) <= 0.5 * v_max)
            a = np.zeros(model.nv)
            a[j] = expected
            tau = pin.rnea(model, model.createData(), q, v, a)
            assert tau[j] == pytest.approx(side * tau_max[j], rel=1e-9)


@pytest.mark.parametrize("method", ["sampling", "refined"])
def test_pendulum_limits_are_the_analytic_ones(method):
    inertia = PENDULUM_MASS * PENDULUM_LENGTH**2
    weight = PENDULUM_MASS * GRAVITY * PENDULUM_LENGTH
    model = pendulum()
    assert np.isinf(model.upperPositionLimit).all()  # so that the angle is drawn from a full turn
    limits = estimate_acceleration_limits(
        model, [-np.inf], [np.inf], [4.0], [30.0], 4000, 0, method=method
    )
    expected = (30.0 - weight) / inertia
    assert limits.a_max[0] == pytest.approx(expected, rel=1e-5)
    assert limits.a_min[0] == pytest.approx(-expected, rel=1e-5)
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


@pytest.mark.long
def test_refined_beats_a_million_samples_with_ten_thousand_evaluations():
    model = baxter()
    space = StateSpace.of(model, *limits_of(model))
    sampled = search_by_sampling(model, space, 1_000_000, 0)
    refined = search_refined(model, space, 10_000, 0)
    assert refined.evaluations <= 10_000
    assert np.all(refined.a_max <= sampled.a_max)
    assert np.all(refined.a_min >= sampled.a_min)
    # The gain is not marginal: several limits are a fifth tighter.
    gain = (sampled.a_max - refined.a_max) / np.abs(sampled.a_max)
    assert np.count_nonzero(gain > 0.2) >= 2


def test_search_counts_every_evaluation(monkeypatch):
    calls = 0
    for name in ("crba", "computeRNEADerivatives"):
        original = getattr(pin, name)

        def counted(*arguments, original=original):
            nonlocal calls
            calls += 1
            return original(*arguments)

        monkeypatch.setattr(pin, name, counted)
    model = panda()
    worst = search_refined(model, StateSpace.of(model, *limits_of(model)), 1000, 0)
    assert calls == worst.evaluations <= 1000


@pytest.mark.parametrize("method", ["sampling", "refined"])
def test_same_seed_same_limits(method):
    model = baxter()
    space = StateSpace.of(model, *limits_of(model))
    search = {"sampling": search_by_sampling, "refined": search_refined}[method]
    first = search(model, space, 3000, 7)
    again = search(model, space, 3000, 7)
    other = search(model, space, 3000, 8)
    np.testing.assert_array_equal(first.a_max, again.a_max)
    np.testing.assert_array_equal(first.q, again.q)
    assert np.any(first.a_max != other.a_max)


def test_shorter_run_is_the_start_of_a_longer_one():
    model = baxter()
    space = StateSpace.of(model, *limits_of(model))
    short = search_by_sampling(model, space, 64, 3)
    long = search_by_sampling(model, space, 300, 3)
    assert (long.a_max <= short.a_max).all() and (long.a_max < short.a_max).any()
    assert (long.a_max == short.a_max).any()


def test_caps_and_overrides():
    model = baxter()
    limits = limits_of(model)
    arguments = {"samples": 2000, "seed": 0, "overrides": {"left_s1": (-3.0, 2.0)}}
    plain = estimate_acceleration_limits(model, *limits, **arguments)
    assert (plain.a_min[1], plain.a_max[1]) == (-3.0, 2.0)
    assert plain.overridden == {"left_s1"}
    capped = estimate_acceleration_limits(model, *limits, **arguments, cap=15.0)
    assert capped.a_max[6] == 15.0 and capped.a_min[6] == -15.0
    assert capped.a_max[0] == plain.a_max[0] < 15.0
    assert (capped.a_min[1], capped.a_max[1]) == (-3.0, 2.0)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_limits_of_a_share_are_available_in_as_many_other_states(share):
    """By Algorithm 4's lines for single states, which are others than those used."""
    model = baxter()
    q_min, q_max, v_max, tau_max = limits_of(model)
    found = limits_in_share(model, StateSpace.of(model, q_min, q_max, v_max, tau_max), share)
    rng, count = np.random.default_rng(3), 3000
    available = np.zeros(model.nv)
    for _ in range(count):
        q, v = rng.uniform(q_min, q_max), rng.uniform(-v_max, v_max)
        lower, upper = algorithm_4(model, [q], [v], tau_max)
        available += (lower <= -found) & (found <= upper)
    np.testing.assert_allclose(available / count, share, atol=0.03)


def test_gravity_beyond_the_torque_is_named():
    model = baxter()
    with pytest.raises(EmptyIntervalError) as raised:
        estimate_acceleration_limits(model, *limits_of(model), 20_000, 0)
    error = raised.value
    assert (error.joint, error.scale) == ("left_s1", 0.0)
    found = largest_velocity_scale(model, StateSpace.of(model, *limits_of(model)))
    assert found.joint == "left_s1"
    static = pin.computeGeneralizedGravity(model, model.createData(), found.q)
    assert abs(static[1]) > 50.0
    assert f"takes {abs(static[1]):.3g} N m just to hold still" in str(error)
    assert "left_s1" in str(error) and "50 N m" in str(error) and "\n" not in str(error)
    assert "lower velocities do not help" in str(error)


def test_too_much_speed_is_told_with_the_scale_that_helps():
    model = panda()
    limits = limits_of(model)
    with pytest.raises(EmptyIntervalError) as raised:
        estimate_acceleration_limits(model, *limits, 10_000, 0, method="refined")
    error = raised.value
    assert error.joint == "panda_joint2"
    scale = error.scale
    assert 0.8 < scale < 0.95
    assert f"{scale:.3f}" in str(error)

    def least_room(factor):
        slower = (*limits[:2], factor * limits[2], limits[3])
        worst = search_refined(model, StateSpace.of(model, *slower), 10_000, 11)
        return min(worst.a_max.min(), -worst.a_min.max())

    # The scale leaves 1 rad/s^2 either way, and hardly any more.
    assert least_room(scale) == pytest.approx(1.0, abs=0.1)
    assert least_room(1.1 * scale) < 0.2


def test_velocity_scale_of_a_pendulum_in_closed_form():
    """At the tip of a two-link arm only the Coriolis torque grows with speed."""
    model = pendulum(links=2, joint_type="revolute")
    space = StateSpace.of(model, [-3, -3], [3, 3], [8.0, 8.0], [60.0, 30.0])
    found = largest_velocity_scale(model, space, 1.0)
    assert 0.0 < found.scale < 1.0
    assert found.joint == "joint1" or found.joint == "joint2"
    h = pin.nonLinearEffects(model, model.createData(), found.q, found.v)
    inertia = pin.crba(model, model.createData(), found.q).diagonal()
    room = (space.tau_max - np.abs(h)) / inertia
    assert room.min() == pytest.approx(1.0, abs=0.01)
    stronger = StateSpace.of(model, [-3, -3], [3, 3], [8.0, 8.0], [600.0, 300.0])
    assert largest_velocity_scale(model, stronger, 1.0).scale == 1.0


def test_unavailable_share_counts_states():
    model = baxter()
    space = StateSpace.of(model, *limits_of(model))
    worst = search_refined(model, space, 5000, 0)
    limits = limits_from_worst_cases(model, space, worst, {"left_s1": (-3.0, 3.0)})
    share = unavailable_share(model, space, limits)
    assert 0.15 < share[1] < 0.25
    np.testing.assert_array_equal(np.delete(share, 1), 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q_min": [0.0]}, "q_min must have 7 values"),
        ({"q_min": np.full(7, 9.0)}, "joint left_s0: position limits"),
        ({"q_max": np.full(7, np.inf)}, "joint left_s0: position limits"),
        ({"v_max": np.zeros(7)}, "joint left_s0: v_max must be positive"),
        ({"tau_max": np.full(7, np.nan)}, "joint left_s0: tau_max must be positive"),
        ({"samples": 0}, "samples must be at least 1, is 0"),
        ({"samples": 0, "method": "refined"}, "samples must be at least 1, is 0"),
        ({"method": "guess"}, "method must be one of sampling, refined"),
        ({"overrides": {"elbow": (-1, 1)}}, "unknown joint 'elbow'"),
        ({"overrides": {"left_s0": (1, 2)}}, "joint left_s0: override"),
        ({"cap": 0.0}, "cap must be positive"),
    ],
)
def test_bad_arguments(change, message):
    model = baxter()
    keys = ("q_min", "q_max", "v_max", "tau_max")
    arguments = dict(zip(keys, limits_of(model), strict=True)) | {"samples": 10, "seed": 0}
    with pytest.raises(LimitEstimateError, match=message):
        estimate_acceleration_limits(model, **arguments | change)


@pytest.mark.parametrize("count", [4, 400])
def test_joint_that_moves_nothing_is_named(count):
    model = pendulum(tip_mass=0.0)
    with pytest.raises(LimitEstimateError, match="joint joint1 moves no inertia"):
        estimate_acceleration_limits(model, [-1], [1], [1], [1], count, 0)
