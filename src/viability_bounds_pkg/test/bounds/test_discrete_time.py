# SPDX-License-Identifier: Apache-2.0
"""Condition (11): when all braking counts, and what is done where it fails."""

import numpy as np
import pytest
from joint_cases import CASES, FAILING, HOLDING, condition_holds, one_joint, solver_of

from viability_bounds_pkg.viability import BoundsSolver


@pytest.mark.parametrize("name", CASES)
def test_braking_is_reduced_only_where_the_condition_fails(name):
    solver = solver_of(CASES[name])
    all_there_is = np.array([[-solver.limits.a_min[0], solver.limits.a_max[0]]])
    assert solver.exact.all() == (name in HOLDING)
    assert (solver.braking == all_there_is).all() == (name in HOLDING)
    assert (solver.braking <= all_there_is).all()


@pytest.mark.parametrize(("w", "off", "error"), [(0, 0, 0), (2, 0, 0), (2, 0.01, 0.05)])
def test_the_condition_is_that_of_the_paper_with_margins(w, off, error):
    """Without margins it is v_max >= dt a and q_max - q_min >= dt^2 a."""
    dt, a = 0.1, 10.0
    b = a + w + 2.0 * error / dt  # a joint may be thrown back as fast as b dt
    speed, room = b * dt, 0.5 * dt**2 * b * (1.0 + b / (a - w)) + 2.0 * off + dt * error

    def holds(length, v_max):
        limits = one_joint(0.0, length, v_max, -a, a)
        return condition_holds(limits, dt, [w], position_error=[off], velocity_error=[error])

    assert holds(1.001 * room, 1.001 * speed)
    assert not holds(0.999 * room, 1.001 * speed)
    assert not holds(1.001 * room, 0.999 * speed)


@pytest.mark.parametrize("name", ["narrow", "weak one way", "hardly affected"])
def test_the_braking_is_the_largest_for_which_the_condition_holds(name):
    case = FAILING[name]
    q_min, q_max, v_max, a_min, a_max, dt = case
    w = 0.02 * min(-a_min, a_max)
    off, error = 0.01 * (q_max - q_min), 0.01 * min(v_max, w / 0.02 * dt)
    solver = solver_of(case, 0.02, position_error=[off], velocity_error=[error])
    up, lo = solver.braking[0]

    def fits(up, lo):
        length = q_max - q_min - 2.0 * off - dt * error
        good = [up <= -a_min - w, lo <= a_max - w]
        for b, other in ((up, lo), (lo, up)):
            full = b + 2.0 * w + 2.0 * error / dt
            good += [full * dt <= v_max, length >= 0.5 * dt**2 * full * (1.0 + full / other)]
        return all(good)

    assert fits(up * (1.0 - 1e-9), lo * (1.0 - 1e-9))
    for more in ((1.001 * up, 1.001 * lo), (1.001 * max(up, lo), lo), (up, 1.001 * max(up, lo))):
        assert not fits(*more)


def test_the_step_is_as_long_as_the_condition_allows():
    limits, dt = one_joint(-2.9, 2.9, 2.6, -15.0, 15.0), 0.004
    long = BoundsSolver(limits, 105.0 * dt, period=dt)
    assert dt <= long.steps[0] < 105.0 * dt
    assert long.exact.all()
    assert condition_holds(limits, long.steps[0])
    assert not condition_holds(limits, 2.0 * long.steps[0])
    assert BoundsSolver(limits, 2.0 * dt, period=dt).steps == 2.0 * dt  # it suits all states


def test_the_step_is_no_shorter_than_commands_act_for():
    *limits, dt = HOLDING["condition (11) just holds"]
    assert BoundsSolver(one_joint(*limits), 1.5 * dt, period=dt).steps == dt


def test_without_position_limits_only_errors_of_the_velocity_count():
    limits, errors = one_joint(-np.inf, np.inf, 1.0, -9.0, 9.0), {"velocity_error": [0.81]}
    assert condition_holds(limits, 0.1, [1.8], **errors)
    assert not condition_holds(limits, 0.1, [2.0], **errors)
