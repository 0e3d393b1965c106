# SPDX-License-Identifier: Apache-2.0
"""Eq. (10) and (11): against rational arithmetic, a QP solver, and any numbers."""

from fractions import Fraction

import numpy as np
import pytest
from general_solver import nearest
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.anti_windup import (
    project_to_limits,
    scale_factor,
    scale_to_limits,
)

N = 6
SOLVER = 1e-8  # N m; how exact a general solver is
SHARP = 1e-12  # relative; rounding and nothing else


def random_cases(seed, count, decades):
    """u, s and limits of joints that are at odds, saturated, silent or forbidden."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        u = 5.0 * rng.normal(size=N)
        s = rng.normal(size=N) * 10.0 ** rng.uniform(-decades, decades, N)
        u_max = np.exp(rng.normal(size=N)) * 10.0 ** rng.uniform(-1.5, 1.0)
        kind = rng.random()
        if kind < 0.4:  # as with a diagonal K, or just the opposite
            u = np.abs(u) * np.sign(s) * (1.0 if kind < 0.3 else -1.0)
        s[rng.random(N) < 0.1] = 0.0
        u[rng.random(N) < 0.1] = 0.0
        u_max[rng.random(N) < 0.03] = 0.0
        u_max[rng.random(N) < 0.05] = np.inf
        tie = rng.random(N) < 0.1
        u_max[tie] = np.abs(u[tie])
        yield u, s, u_max


def exact_factor(u, u_max) -> Fraction:
    """(10) in rational arithmetic."""
    limited = [(x, m) for x, m in zip(u, u_max, strict=True) if x and np.isfinite(m)]
    return min([Fraction(1), *(Fraction(m) / abs(Fraction(x)) for x, m in limited)])


def exact(u, s, u_max) -> list[Fraction]:
    """(11) in rational arithmetic: the piece of s'x(nu) that reaches the level, tried in turn."""
    factor = exact_factor(u, u_max)
    u, s = [Fraction(x) for x in u], [Fraction(x) for x in s]
    u_max = [None if np.isinf(x) else Fraction(x) for x in u_max]
    wanted = factor * sum(a * b for a, b in zip(s, u, strict=True))

    def x(nu):
        y = [a + nu * b for a, b in zip(u, s, strict=True)]
        return [a if m is None else min(max(a, -m), m) for a, m in zip(y, u_max, strict=True)]

    def power(nu):
        return sum(a * b for a, b in zip(s, x(nu), strict=True))

    corners = {Fraction(0)}
    for a, b, m in zip(u, s, u_max, strict=True):
        if b and m is not None:
            corners |= {(m - a) / b, (-m - a) / b}
    corners = sorted(nu for nu in corners if nu >= 0)
    corners.append(corners[-1] + 1)
    if power(corners[0]) >= wanted:
        return x(corners[0])
    reached = (k for k in range(1, len(corners)) if power(corners[k]) >= wanted)
    k = next(reached, len(corners) - 1)  # behind the last corner s'x grows at the same rate
    low, high = corners[k - 1], corners[k]
    return x(low + (wanted - power(low)) * (high - low) / (power(high) - power(low)))


def surplus(x, u, s, u_max) -> float:
    """s'x - lambda_w s'u relative to the size of its terms; without rounding."""
    factor = exact_factor(u, u_max)
    s, x, u = ([Fraction(float(y)) for y in z] for z in (s, x, u))
    size = sum(abs(a) * (abs(b) + abs(c)) for a, b, c in zip(s, x, u, strict=True))
    power = sum(a * (b - factor * c) for a, b, c in zip(s, x, u, strict=True))
    return float(power / size) if size else 0.0


def assert_allowed(x, u, s, u_max):
    assert np.isfinite(x).all()
    assert (np.abs(x) <= u_max).all()
    assert surplus(x, u, s, u_max) >= -1e-14


def test_projection_agrees_with_rational_arithmetic():
    """With s over 6 orders of magnitude, of which rounding may cost as many digits."""
    binding = 0
    for u, s, u_max in random_cases(2, 300, decades=3.0):
        x = project_to_limits(u, s, u_max)
        expected = np.array([float(y) for y in exact(u, s, u_max)])
        assert scale_factor(u, u_max) == pytest.approx(float(exact_factor(u, u_max)), rel=SHARP)
        digits = np.abs(s).max() / np.abs(s[s != 0.0]).min(initial=np.inf)
        np.testing.assert_allclose(x, expected, rtol=0.0, atol=SHARP * np.abs(u).max() * digits)
        assert_allowed(x, u, s, u_max)
        binding += np.abs(x - np.clip(u, -u_max, u_max)).max() > 1e-3
    assert binding > 45  # the half-space has a say


def test_projection_agrees_with_a_general_solver():
    used = 0
    # Of s that differ by 1e6, the general solver loses the small ones.
    for u, s, u_max in random_cases(1, 300, decades=0.6):
        expected = nearest(u, -u_max, u_max, s, scale_factor(u, u_max) * (s @ u))
        if expected is not None:
            used += 1
            found = project_to_limits(u, s, u_max)
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=SOLVER)
    assert used > 280


magnitudes = st.one_of(
    st.just(0.0),
    st.floats(1e-3, 1e3),
    st.integers(-75, 75).map(lambda e: 10.0**e),
)
numbers = st.tuples(magnitudes, st.sampled_from([-1.0, 1.0])).map(lambda pair: pair[0] * pair[1])


@given(st.lists(st.tuples(numbers, numbers, magnitudes | st.just(np.inf)), min_size=1, max_size=9))
@settings(max_examples=250, deadline=None, derandomize=True)
def test_never_fails_whatever_the_numbers(rows):
    """Over 150 orders of magnitude: beyond, squares of ratios are no numbers any more."""
    u, s, u_max = np.array(rows).T
    x = project_to_limits(u, s, u_max)
    assert_allowed(x, u, s, u_max)
    scaled = scale_to_limits(u, u_max)
    assert (np.abs(scaled) <= u_max).all()
    # No further from u than what (10) gives.
    size = np.abs(u).max() or 1.0
    far, near = np.linalg.norm((scaled - u) / size), np.linalg.norm((x - u) / size)
    assert near <= far * (1.0 + 1e-9) + 1e-12


def test_is_the_plain_clip_when_each_joint_is_damped_by_its_own_s():
    """So it is for the K of the paper, lambda diag(M): (11) adds to the clip only with others."""
    rng = np.random.default_rng(5)
    for _, s, u_max in random_cases(5, 100, decades=3.0):
        u = rng.uniform(0.1, 10.0, N) * s
        expected = np.clip(u, -u_max, u_max)
        np.testing.assert_allclose(project_to_limits(u, s, u_max), expected, rtol=SHARP)


def test_inequality_has_an_effect():
    """Fig. 2 of the paper: clipped, the torque would drive s instead of damping it."""
    u, s, u_max = np.array([4.0, -1.5]), np.array([1.0, 2.0]), np.array([1.0, 2.0])
    assert s @ np.clip(u, -u_max, u_max) < 0.0 < s @ u
    np.testing.assert_allclose(project_to_limits(u, s, u_max), [1.0, -0.375])


def test_jumps_where_only_one_point_is_left():
    """(11) as printed is not continuous in s: see docs/theory/integral_action.md."""
    u, u_max = np.array([4.0, -1.5]), np.array([1.0, 2.0])
    np.testing.assert_allclose(project_to_limits(u, [1.0, 1e-6], u_max), [1.0, -0.375])
    np.testing.assert_allclose(project_to_limits(u, [1.0, -1e-6], u_max), [1.0, -1.5])


def test_scaling_is_equation_10():
    u, u_max = np.array([4.0, -1.0, 0.0]), np.array([2.0, 3.0, 0.0])
    np.testing.assert_array_equal(scale_to_limits(u, u_max), [2.0, -0.5, 0.0])
    np.testing.assert_array_equal(scale_to_limits(u, [0.0, 3.0, 0.0]), [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(scale_to_limits(u, np.full(3, np.inf)), u)
    for u, u_max in np.random.default_rng(6).uniform(0.0, 1.0, (500, 2)) * [10.0, 1.0]:
        assert scale_to_limits([u], [u_max])[0] <= u_max, "beyond its limit by rounding"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0, np.nan], [1.0, 1.0], [1.0, 1.0]), "u must be finite"),
        (([1.0, 1.0], [np.inf, 1.0], [1.0, 1.0]), "s must be finite"),
        (([1.0, 1.0], [1.0, 1.0], [1.0, np.nan]), "u_max must be numbers >= 0"),
        (([1.0, 1.0], [1.0, 1.0], [1.0, -1.0]), "u_max must be numbers >= 0"),
        (([1.0, 1.0], [1.0], [1.0, 1.0]), r"shape \(n,\): u \(2,\), s \(1,\), u_max \(2,\)"),
        (([[1.0]], [[1.0]], [[1.0]]), r"shape \(n,\)"),
    ],
)
def test_refuses_what_it_cannot_use(arguments, message):
    with pytest.raises(ValueError, match=message):
        project_to_limits(*arguments)
