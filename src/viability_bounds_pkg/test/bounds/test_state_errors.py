# SPDX-License-Identifier: Apache-2.0
"""Bounds for states that are known up to an error; in motion see `test_motion_with_errors`."""

import numpy as np
import pytest
from adversary import POLICIES, VIOLATION, bring_back, states_in_kernel, states_outside
from joint_cases import CASES, HOLDING, column, discrete_time_condition, one_joint, states_of

from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

ROOMY = [name for name in HOLDING if name != "condition (11) just holds"]
"""Joints for which condition (11) holds with small errors, too."""


def step_speed(case):
    """Return a speed that a step can make or stop, and that does not cross the range, rad/s."""
    q_min, q_max, v_max, a_min, a_max, dt = case
    return min(v_max, min(-a_min, a_max) * dt, (q_max - q_min) / dt)


def errors_of(case, share=0.03):
    """Return errors of position and velocity that are small beside what a step can do."""
    q_min, q_max, v_max, a_min, a_max, _ = case
    length = min(q_max - q_min, v_max**2 / min(-a_min, a_max))
    return {"position_error": [share * length], "velocity_error": [share * step_speed(case)]}


def margin_of(case, share):
    return [share * step_speed(case) / case[5]]


def robust(case, share=0.03, margin=0.0, period=1.0):
    limits, dt = one_joint(*case[:5]), case[5]
    return BoundsSolver(limits, dt, margin_of(case, margin), period * dt, **errors_of(case, share))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("period", [1.0, 0.5])
@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_no_errors_are_the_bounds_without_them_bit_for_bit(name, margin, period):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    w = margin_of(case, margin)
    q, v = (column(x) for x in states_of(case, 2000, seed=1))
    q[:50] += 0.1
    known = BoundsSolver(limits, dt, w, period * dt)
    bounds = robust(case, 0.0, margin, period).bounds(q, v)
    for found, expected in zip(bounds, known.bounds(q, v), strict=True):
        assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("name", ROOMY)
@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_the_bounds_are_those_of_the_worst_states_within_the_errors(name, margin):
    case = HOLDING[name]
    limits, dt = one_joint(*case[:5]), case[5]
    errors = errors_of(case)
    w = margin_of(case, margin)
    assert discrete_time_condition(limits, dt, w, **errors)
    known, unsure = BoundsSolver(limits, dt, w), robust(case, 0.03, margin)
    q, v = (column(x) for x in states_of(case, 5000, seed=2))
    off, error = errors["position_error"], errors["velocity_error"]
    above, below = known.bounds(q + off, v + error), known.bounds(q - off, v - error)
    bounds = unsure.bounds(q, v)
    both = above.viable & below.viable
    assert both.mean() > 0.3
    np.testing.assert_allclose(bounds.upper[both], above.upper[both], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(bounds.lower[both], below.lower[both], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ROOMY)
def test_joints_count_as_outside_only_where_no_state_within_the_errors_is_viable(name):
    case = HOLDING[name]
    known, unsure = BoundsSolver(one_joint(*case[:5]), case[5]), robust(case)
    assert unsure.exact.all()
    errors = errors_of(case)
    off, error = map(np.array, errors.values())
    q, v = (column(x) for x in states_of(case, 2000, seed=3))
    q, v = q * 1.05, v * 1.05
    viable = unsure.bounds(q, v).viable
    assert (~viable).any()
    for x in np.linspace(-1.0, 1.0, 9):
        for y in np.linspace(-1.0, 1.0, 9):
            inside = known.bounds(q + x * off, v + y * error).viable
            assert not (inside & ~viable).any()
    q_min, q_max, v_max = case[:3]
    if np.isfinite(q_max):
        assert not unsure.bounds([q_max + 1.001 * off[0]], [0.0]).viable[0]
        assert unsure.bounds([q_max + 0.999 * off[0]], [0.0]).viable[0]
    if np.isfinite(q_min):
        assert not unsure.bounds([q_min - 1.001 * off[0]], [0.0]).viable[0]
        assert unsure.bounds([q_min - 0.999 * off[0]], [0.0]).viable[0]
    assert not unsure.bounds([0.0], [v_max + 1.001 * error[0]]).viable[0]


def test_discrete_time_condition_with_errors():
    # z = 2 W dt + 2 E_v = 0.5 rad/s: up to (A - W) dt + z = 1.3 rad/s backwards.
    def holds(length, v_max, off, error):
        limits = one_joint(0.0, length, v_max, -10.0, 10.0)
        return bool(
            discrete_time_condition(
                limits, 0.1, [2.0], position_error=[off], velocity_error=[error]
            )
        )

    room = 0.5 * 0.1 * 1.3 * (1.0 + 13.0 / 8.0) + 2.0 * 0.01 + 0.1 * 0.05
    assert holds(1.001 * room, 1.301, 0.01, 0.05)
    assert not holds(0.999 * room, 1.301, 0.01, 0.05)
    assert not holds(1.001 * room, 1.299, 0.01, 0.05)
    assert holds(0.999 * room, 1.301, 0.009, 0.05)
    assert holds(0.999 * room, 1.301, 0.01, 0.049)
    assert not discrete_time_condition(
        one_joint(-np.inf, np.inf, 1.0, -9.0, 9.0), 0.1, [2.0], velocity_error=[0.81]
    )


@pytest.mark.parametrize("name", [name for name in CASES if np.isfinite(CASES[name][:2]).all()])
def test_where_the_condition_fails_the_braking_is_the_largest_for_which_it_holds(name):
    case = CASES[name]
    q_min, q_max, v_max, a_min, a_max, dt = case
    (off,), (error,) = errors_of(case).values()
    solver = robust(case, 0.03, 0.02)
    (w,) = margin_of(case, 0.02)
    up, lo = solver.braking[0]

    def fits(up, lo):
        length = q_max - q_min - 2.0 * off - dt * error
        good = [up <= -a_min - w, lo <= a_max - w]
        for b, other, limit in ((up, lo, q_max), (lo, up, -q_min)):
            full = b + 2.0 * w + 2.0 * error / dt
            if np.isfinite(limit):
                good += [full * dt <= v_max, length >= 0.5 * dt**2 * full * (1.0 + full / other)]
        return all(good)

    assert fits(up * (1.0 - 1e-9), lo * (1.0 - 1e-9))
    for more in ((1.001 * up, 1.001 * lo), (1.001 * max(up, lo), lo), (up, 1.001 * max(up, lo))):
        assert not fits(*more)


@pytest.mark.parametrize("margin", [0.0, 0.02])
@pytest.mark.parametrize("share", [0.01, 0.1])
@pytest.mark.parametrize("name", CASES)
def test_a_step_from_within_the_kernel_stays_in_it_at_all_times(name, share, margin):
    """The state that is told being anywhere within the errors, most often at a corner."""
    case = CASES[name]
    try:
        solver = robust(case, share, margin)
    except JointLimitsError:
        assert name in ("far too narrow", "narrow and too fast")
        return
    limits, dt = solver.limits, case[5]
    rng = np.random.default_rng(4)
    q, v = states_in_kernel(solver, case, 20_000, rng)
    signs = [np.clip(rng.uniform(-3.0, 3.0, q.shape), -1.0, 1.0) for _ in range(2)]
    off, error = map(np.array, errors_of(case, share).values())
    bounds = solver.bounds(q + signs[0] * off, v + signs[1] * error)
    assert bounds.viable.all()
    (w,) = margin_of(case, margin)
    scale = max(1.0, np.abs(q).max())
    for a in (bounds.lower - w, bounds.upper + w):
        for share_of_step in (0.1, 0.4, 0.7, 1.0):
            t = share_of_step * dt
            end, speed = q + t * v + 0.5 * t**2 * a, v + t * a
            inside = np.clip(end, limits.q_min, limits.q_max)
            assert np.abs(end - inside).max() <= 1e-12 * scale
            slowest, fastest = solver.velocity_range(inside)
            # The squares, because the edge of the kernel is steep at the limits.
            rounding = 1e-9 * limits.v_max**2
            assert (speed * np.abs(speed) <= fastest**2 + rounding).all()
            assert (-speed * np.abs(speed) <= slowest**2 + rounding).all()


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", CASES)
def test_every_joint_returns_although_its_state_is_unsure(name, policy):
    case = CASES[name]
    solver = robust(case, 0.01)
    rng = np.random.default_rng(7)
    q, v = states_outside(solver, case, 100, rng)
    run = bring_back(solver, q, v, policy, 3000, rng)
    assert run.stray == 0
    assert run.speed <= VIOLATION


@pytest.mark.parametrize(
    ("errors", "field", "said"),
    [
        ({"position_error": [-0.1]}, "position_error", "at least 0"),
        ({"position_error": [np.inf]}, "position_error", "half the range"),
        ({"velocity_error": [np.inf]}, "velocity_error", "finite"),
        ({"velocity_error": [0.1, 0.1]}, "velocity_error", "one value for each of the 1 joints"),
        ({"position_error": [0.5]}, "position_error", "below half the range, 0.5 rad"),
        ({"velocity_error": [1.01]}, "velocity_error", "must be smaller"),
    ],
)
def test_errors_that_cannot_be_held_against(errors, field, said):
    limits = one_joint(-0.5, 0.5, 2.0, -10.0, 10.0)
    with pytest.raises(JointLimitsError) as error:
        BoundsSolver(limits, 0.1, **errors)
    assert error.value.field == field
    assert said in str(error.value)
