# SPDX-License-Identifier: Apache-2.0
"""Bounds for states that are known up to an error; in motion see `test_motion_with_errors`."""

import numpy as np
import pytest
from adversary import VIOLATION, bring_back, states_in_kernel, states_outside
from joint_cases import CASES, HOLDING, solver_of, states_of

from viability_bounds_pkg.joint_limits import JointLimitsError

# Where condition (11) holds with small errors, too.
ROOMY = [name for name in HOLDING if name != "condition (11) just holds"]


def errors_of(case, share=0.03):
    """Return errors of position and velocity that are small beside what a step can do."""
    q_min, q_max, v_max, a_min, a_max, dt = case
    weaker = min(-a_min, a_max)
    speed = min(v_max, weaker * dt, (q_max - q_min) / dt)
    length = min(q_max - q_min, v_max**2 / weaker)
    return {"position_error": [share * length], "velocity_error": [share * speed]}


def test_no_errors_are_the_bounds_without_them_bit_for_bit():
    for name in ("figure 3", "narrow"):
        case = CASES[name]
        q, v = states_of(case, 2000, seed=1)
        q[:50] += 0.1
        known = solver_of(case, 0.02, 0.5)
        unsure = solver_of(case, 0.02, 0.5, position_error=[0.0], velocity_error=[0.0])
        for found, expected in zip(unsure.bounds(q, v), known.bounds(q, v), strict=True):
            assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("margin", [0.0, 0.02])
@pytest.mark.parametrize("name", ROOMY)
def test_the_bounds_are_those_of_the_worst_states_within_the_errors(name, margin):
    case, errors = HOLDING[name], errors_of(HOLDING[name])
    known, unsure = solver_of(case, margin), solver_of(case, margin, **errors)
    assert unsure.exact.all()
    q, v = states_of(case, 5000, seed=2)
    off, error = errors.values()
    above, below = known.bounds(q + off, v + error), known.bounds(q - off, v - error)
    bounds, both = unsure.bounds(q, v), above.viable & below.viable
    assert both.mean() > 0.3
    np.testing.assert_allclose(bounds.upper[both], above.upper[both], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(bounds.lower[both], below.lower[both], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("share", "margin", "period"),
    [(0.0, 0.0, 1.0), (0.0, 0.3, 0.5), (0.01, 0.02, 1.0), (0.05, 0.02, 1.0)],
)
@pytest.mark.parametrize("name", CASES)
def test_a_step_from_within_the_kernel_stays_in_it_at_all_times(name, share, margin, period):
    """The state that is told is anywhere within the errors, most often at a corner."""
    case, errors = CASES[name], errors_of(CASES[name], share)
    try:
        solver = solver_of(case, margin, period, **errors)
    except JointLimitsError:
        assert share or margin  # what is uncertain throws the joint out within a few steps
        assert name not in ROOMY
        return
    limits, rng = solver.limits, np.random.default_rng(4)
    q, v = states_in_kernel(solver, case, 20_000, rng)
    told = [
        x + error * np.clip(rng.uniform(-3.0, 3.0, q.shape), -1.0, 1.0)
        for x, error in zip((q, v), map(np.array, errors.values()), strict=True)
    ]
    bounds = solver.bounds(*told)
    assert bounds.viable.all()
    w = margin * min(-case[3], case[4])
    for a in (bounds.lower - w, bounds.upper + w):
        for t in np.array([0.1, 0.4, 0.7, 1.0]) * min(solver.steps[0], period * case[5]):
            end, speed = q + t * v + 0.5 * t**2 * a, v + t * a
            inside = np.clip(end, limits.q_min, limits.q_max)
            assert np.abs(end - inside).max() <= 1e-12 * max(1.0, np.abs(q).max())
            slowest, fastest = solver.velocity_range(inside)
            # The squares, because the edge of the kernel is steep at the limits.
            rounding = 1e-9 * limits.v_max**2
            assert (speed * np.abs(speed) <= fastest**2 + rounding).all()
            assert (-speed * np.abs(speed) <= slowest**2 + rounding).all()


@pytest.mark.parametrize("name", CASES)
def test_every_joint_returns_although_its_state_is_unsure(name):
    case, rng = CASES[name], np.random.default_rng(7)
    solver = solver_of(case, **errors_of(case, 0.01))
    run = bring_back(solver, *states_outside(solver, case, 300, rng), 3000, rng)
    assert run.stray == 0
    assert run.speed <= VIOLATION


@pytest.mark.parametrize("name", [name for name in ROOMY if name != "continuous"])
def test_a_state_is_viable_if_one_within_the_errors_is(name):
    case, errors = HOLDING[name], errors_of(HOLDING[name])
    known, unsure = solver_of(case), solver_of(case, **errors)
    q, v = states_of(case, 20_000, seed=5)
    fast_and_high = ((v > 0.2 * case[2]) & (q > 0.5 * (case[0] + case[1])))[:, 0]
    q, v = q[fast_and_high], v[fast_and_high]  # only the upper limit counts
    off, error = errors.values()
    expected = known.bounds(q - off, v - error).viable
    assert 0.1 < expected.mean() < 0.95
    assert (unsure.bounds(q, v).viable == expected).mean() > 0.9999  # rounding on the edge


@pytest.mark.parametrize("name", ROOMY)
def test_the_lower_limit_is_the_mirror_image_of_the_upper(name):
    case, errors = HOLDING[name], errors_of(HOLDING[name], 0.01)
    q_min, q_max, v_max, a_min, a_max, dt = case
    solver = solver_of(case, 0.01, **errors)
    image = solver_of((-q_max, -q_min, v_max, -a_max, -a_min, dt), 0.01, **errors)
    q, v = states_outside(solver, case, 2000, np.random.default_rng(8))
    found, seen = solver.bounds(q, v), image.bounds(-q, -v)
    np.testing.assert_array_equal(found.viable, seen.viable)
    np.testing.assert_allclose(found.lower, -seen.upper, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.upper, -seen.lower, rtol=1e-9, atol=1e-9)
