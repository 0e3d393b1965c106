# SPDX-License-Identifier: Apache-2.0
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

N = 9
EXACT = 1e-11  # N m, for numbers of a few N m
SOLVER = 1e-8  # N m; how exact a general solver is
SHARP = 1e-12  # relative; rounding and nothing else
BISECTIONS = 110


def random_cases(rng, count):
    """u, s and limits of joints that are at odds, saturated, silent or forbidden."""
    u, s = rng.normal(size=(count, N)), rng.normal(size=(count, N))
    u_max = np.exp(rng.normal(size=(count, N))) * 10.0 ** rng.uniform(-2.0, 0.5, (count, 1))
    s *= 10.0 ** rng.uniform(-3.0, 3.0, s.shape)
    together = rng.random((count, 1)) < 0.3  # as with a diagonal K
    u = np.where(together, np.abs(u) * np.sign(s), u)
    opposed = rng.random((count, 1)) < 0.1
    u = np.where(opposed, -np.abs(u) * np.sign(s), u)
    s[rng.random(s.shape) < 0.1] = 0.0
    u[rng.random(u.shape) < 0.1] = 0.0
    u_max[rng.random(u_max.shape) < 0.03] = 0.0
    u_max[rng.random(u_max.shape) < 0.05] = np.inf
    tie = rng.random(u.shape) < 0.1
    u_max = np.where(tie, np.abs(u), u_max)
    return 5.0 * u, s, 5.0 * u_max


def bisected(u, s, u_max):
    """(11) for a batch by bisection on its multiplier, in extended precision."""
    u, s, u_max = (np.asarray(x, dtype=np.longdouble) for x in (u, s, u_max))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(u == 0.0, np.inf, u_max / np.abs(u))
    factor = np.minimum(1.0, ratios.min(axis=1))
    wanted = factor * (s * u).sum(axis=1)

    def x(nu):
        with np.errstate(over="ignore"):
            return np.clip(u + nu[:, None] * s, -u_max, u_max)

    def short(y):
        return (s * y).sum(axis=1) < wanted

    low = np.zeros(len(u), dtype=np.longdouble)
    # Beyond this, s'x does not grow any more, or the unlimited joints have done it all.
    finite = np.where(np.isfinite(u_max), u_max, 0.0)
    least = np.where(s == 0.0, np.inf, np.abs(s)).min(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        high = 2.0 * (np.abs(u) + finite).max(axis=1) * N / least**2 * np.abs(s).max(axis=1)
    high = np.where(np.isfinite(high), high, 0.0)
    result = x(low)
    hard = short(result)
    u, s, u_max, wanted = u[hard], s[hard], u_max[hard], wanted[hard]
    low, high = low[hard], high[hard]
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        far = ~short(x(middle))
        high = np.where(far, middle, high)
        low = np.where(far, low, middle)
    result[hard] = x(high)
    return result.astype(float)


def exact(u, s, u_max):
    """(11) in rational arithmetic: the piece of s'x(nu) that reaches the level, tried in turn."""
    u, s = [Fraction(x) for x in u], [Fraction(x) for x in s]
    u_max = [None if np.isinf(x) else Fraction(x) for x in u_max]
    n = len(u)
    factor = min(
        [Fraction(1), *(m / abs(x) for x, m in zip(u, u_max, strict=True) if x and m is not None)]
    )
    wanted = factor * sum(a * b for a, b in zip(s, u, strict=True))

    def x(nu):
        y = [a + nu * b for a, b in zip(u, s, strict=True)]
        return [a if m is None else min(max(a, -m), m) for a, m in zip(y, u_max, strict=True)]

    def power(nu):
        return sum(a * b for a, b in zip(s, x(nu), strict=True))

    points = {Fraction(0)}
    for i in range(n):
        if s[i] and u_max[i] is not None:
            points |= {(side * u_max[i] - u[i]) / s[i] for side in (1, -1)}
    points = sorted(p for p in points if p >= 0)
    if power(points[0]) >= wanted:
        return x(points[0]), factor
    for low, high in zip(points, points[1:], strict=False):
        if power(high) >= wanted:
            return x(
                low + (wanted - power(low)) * (high - low) / (power(high) - power(low))
            ), factor
    low, high = points[-1], points[-1] + 1
    return x(low + (wanted - power(low)) / (power(high) - power(low))), factor


def surplus(x, u, s, u_max) -> float:
    """s'x - lambda_w s'u relative to the size of its terms; without rounding."""
    s, x, u = ([Fraction(float(y)) for y in z] for z in (s, x, u))
    factor = min(
        [Fraction(1), *(Fraction(m) / abs(y) for y, m in zip(u, u_max, strict=True) if abs(y) > m)]
    )
    size = sum(abs(a) * (abs(b) + abs(c)) for a, b, c in zip(s, x, u, strict=True))
    power = sum(a * (b - factor * c) for a, b, c in zip(s, x, u, strict=True))
    return float(power / size) if size else 0.0


def assert_allowed(x, u, s, u_max):
    assert np.isfinite(x).all()
    assert (np.abs(x) <= u_max).all()
    assert surplus(x, u, s, u_max) >= -1e-14


def test_closed_form_agrees_with_bisection():
    u, s, u_max = random_cases(np.random.default_rng(0), 30_000)
    expected = bisected(u, s, u_max)
    found = np.array([project_to_limits(*case) for case in zip(u, s, u_max, strict=True)])
    assert np.abs(found - expected).max() < EXACT
    clipped = np.clip(u, -u_max, u_max)
    # The half-space has a say in a good part of the cases, or they would prove little.
    assert (np.abs(found - clipped).max(axis=1) > 1e-3).mean() > 0.15
    assert (np.abs(found) <= u_max).all()


def test_closed_form_agrees_with_a_general_solver():
    rng = np.random.default_rng(1)
    used = 0
    for u, s, u_max in zip(*random_cases(rng, 3000), strict=True):
        # Of factors that differ by 1e6, the general solver loses the small ones.
        s = np.sign(s) * np.abs(s) ** 0.2
        expected = nearest(u, -u_max, u_max, s, scale_factor(u, u_max) * (s @ u))
        if expected is not None:
            used += 1
            np.testing.assert_allclose(
                project_to_limits(u, s, u_max), expected, rtol=0.0, atol=SOLVER
            )
    assert used > 2900


def test_closed_form_agrees_with_rational_arithmetic():
    """With s over 6 orders of magnitude, of which rounding may cost as many digits."""
    rng = np.random.default_rng(2)
    for _ in range(1500):
        n = rng.integers(1, 7)
        s = rng.choice([-1.0, 1.0], n) * 10.0 ** rng.integers(-3, 4, n)
        u = rng.choice([-1.0, 1.0], n) * 10.0 ** rng.integers(-3, 4, n) * rng.integers(1, 9, n)
        u_max = np.abs(u) * rng.choice([0.25, 0.5, 1.0, 4.0, np.inf], n)
        expected, factor = exact(u, s, u_max)
        assert scale_factor(u, u_max) == factor  # a power of two
        x = project_to_limits(u, s, u_max)
        size = np.abs(u).max() * (np.abs(s).max() / np.abs(s).min())
        np.testing.assert_allclose(x, [float(y) for y in expected], rtol=0.0, atol=SHARP * size)
        assert_allowed(x, u, s, u_max)


def test_inequality_holds_to_rounding():
    for u, s, u_max in zip(*random_cases(np.random.default_rng(3), 5000), strict=True):
        assert_allowed(project_to_limits(u, s, u_max), u, s, u_max)


magnitudes = st.one_of(
    st.just(0.0),
    st.floats(1e-3, 1e3),
    st.integers(-75, 75).map(lambda e: 10.0**e),
)
numbers = st.tuples(magnitudes, st.sampled_from([-1.0, 1.0])).map(lambda pair: pair[0] * pair[1])


@given(st.lists(st.tuples(numbers, numbers, magnitudes | st.just(np.inf)), min_size=1, max_size=9))
@settings(max_examples=500, deadline=None, derandomize=True)
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


@pytest.mark.parametrize("scale_u", [1e-150, 1e-8, 1e8, 1e150])
@pytest.mark.parametrize("scale_s", [1e-150, 1.0, 1e150])
def test_scales_do_not_matter(scale_u, scale_s):
    for u, s, u_max in zip(*random_cases(np.random.default_rng(4), 200), strict=True):
        x = project_to_limits(u, s, u_max)
        other = project_to_limits(scale_u * u, scale_s * s, scale_u * u_max)
        np.testing.assert_allclose(other / scale_u, x, rtol=1e-9, atol=1e-9)


def test_is_the_plain_clip_when_each_joint_is_damped_by_its_own_s():
    """So it is for the K of the paper, lambda diag(M): (11) adds to the clip only with others."""
    rng = np.random.default_rng(5)
    for _, s, u_max in zip(*random_cases(rng, 2000), strict=True):
        u = rng.uniform(0.1, 10.0, N) * s
        expected = np.clip(u, -u_max, u_max)
        np.testing.assert_allclose(project_to_limits(u, s, u_max), expected, rtol=SHARP)


def test_inequality_has_an_effect():
    """Fig. 2 of the paper: clipped, the torque would drive s instead of damping it."""
    u, s, u_max = np.array([4.0, -1.5]), np.array([1.0, 2.0]), np.array([1.0, 2.0])
    factor = scale_factor(u, u_max)
    assert factor == 0.25
    clipped = np.clip(u, -u_max, u_max)
    assert s @ clipped < 0.0 < s @ u
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
    assert scale_factor(np.zeros(3), np.zeros(3)) == 1.0


def test_no_component_is_beyond_its_limit_by_rounding():
    rng = np.random.default_rng(6)
    for u, u_max in rng.uniform(0.0, 1.0, (2000, 2)) * [10.0, 1.0]:
        scaled = scale_to_limits([u], [u_max])[0]
        assert u_max * (1.0 - SHARP) <= scaled <= u_max or scaled == u < u_max


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


def test_arguments_are_left_alone():
    u, s, u_max = np.array([4.0, -1.5]), np.array([1.0, 2.0]), np.array([1.0, 2.0])
    for function, arguments in (
        (project_to_limits, (u, s, u_max)),
        (scale_to_limits, (u, u_max)),
    ):
        before = [x.copy() for x in arguments]
        result = function(*arguments)
        assert all(result is not x for x in arguments)
        for x, y in zip(arguments, before, strict=True):
            np.testing.assert_array_equal(x, y)
