# SPDX-License-Identifier: Apache-2.0
"""The stop of an arm, against adversaries and the motion of the model under held torques."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from stopping_arm import Arm, H

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.stop import (
    GIVE_WAY,
    HARDER,
    HOLD_CLEARANCE,
    HOLD_GAIN,
    MARGIN,
    RETURN_SPEED,
    CoordinatedStop,
)
from viability_bounds_pkg.viability import BoundsSolver

ROUNDING = 1e-9
FEW_STEPS = 6 * H


@pytest.fixture(scope="module", params=["panda", "talos_left_arm"])
def arm(request):
    return Arm(request.param)


@pytest.fixture(scope="module")
def panda():
    return Arm("panda")


def test_all_joints_slow_down_together_along_the_direction_of_motion(arm):
    stop = arm.stop()
    for seed in range(3):
        q, v = arm.inside(np.random.default_rng(seed))
        v0, time = v, stop.time_to_rest(v)
        stop.start(q, v)
        steps = 0
        while not stop.at_rest:
            q, v = arm.move(q, v, stop.torque(q, v))
            across = v - v0 * (v @ v0) / (v0 @ v0)
            assert np.linalg.norm(across) < 2e-3 * np.linalg.norm(v0)
            assert (stop.acceleration >= arm.limits.a_min - ROUNDING).all()
            assert (stop.acceleration <= arm.limits.a_max + ROUNDING).all()
            steps += 1
        assert time <= steps * H < time + FEW_STEPS
        # No joint could have been faster: the one that decides brakes as hard as it may.
        assert time == pytest.approx(np.max(np.abs(v0) / stop._braking(v0)))


def test_no_limit_is_passed_from_the_edge_of_the_kernel(arm):
    stop = arm.stop()
    rng = np.random.default_rng(0)
    for _ in range(10):
        q, v = arm.edge(rng)
        time = stop.time_to_rest(v)
        stop.start(q, v)
        fastest = np.abs(v)
        for _ in range(round((time + FEW_STEPS) / H)):
            tau = stop.torque(q, v)
            assert (np.abs(tau) <= arm.tau_max).all()
            q, v = arm.move(q, v, tau)
            assert arm.beyond(q).max() == 0.0
            # A joint that stops on a limit may move back from it for less than a step.
            allowed = np.maximum(fastest, -H * np.minimum(arm.limits.a_min, -arm.limits.a_max))
            assert (np.abs(v) <= allowed).all()
        assert stop.at_rest


def test_joints_come_to_rest_clear_of_their_limits_where_they_can(arm):
    """Where friction holds them they stay there, and what lets them slip takes them no further."""
    stop, limits = arm.stop(), arm.limits
    lowest, highest = limits.q_min + HOLD_CLEARANCE, limits.q_max - HOLD_CLEARANCE
    inner = replace(limits, q_min=lowest, q_max=highest)
    rng, nearest = np.random.default_rng(0), 0
    for _ in range(10):
        q, _ = arm.edge(rng)
        q = np.clip(q, lowest, highest)
        low, high = BoundsSolver(inner, H, arm.margin).velocity_range(q)
        v = rng.uniform(0.7, 1.0, arm.n) * np.where(rng.random(arm.n) < 0.5, low, high)
        stop.start(q, v)
        while not stop.at_rest:
            q, v = arm.move(q, v, stop.torque(q, v))
            assert (np.minimum(highest - q, q - lowest) >= -2e-5).all()
        nearest += (np.minimum(highest - q, q - lowest) < 1e-4).sum()
    assert nearest >= 3  # the limits did matter


@pytest.mark.parametrize("adversary", ["out", "back", "random", "alternating"])
def test_an_adversary_of_accelerations_within_the_margin_passes_no_limit(panda, adversary):
    """As in docs/theory/whole_arm.md, accelerations are off by all of the margin in each step."""
    rng = np.random.default_rng(1)
    stop, limits = panda.stop(), panda.limits
    for _ in range(10):
        q, v = panda.edge(rng)
        way = np.sign(v)
        stop.start(q, v)
        time = stop.time_to_rest(v) / (1.0 - MARGIN)
        for k in range(round((time + 4 * FEW_STEPS) / H)):
            stop.torque(q, v)
            strays = {
                "out": way,
                "back": -way,
                "random": rng.uniform(-1.0, 1.0, panda.n),
                "alternating": (-1.0) ** k * way,
            }[adversary]
            a = stop.acceleration + panda.margin * strays
            turns = np.full(panda.n, np.inf)
            np.divide(-v, a, out=turns, where=a * v < 0.0)
            turn = np.minimum(turns, H)  # furthest within the step
            for t in (turn, H):
                assert panda.beyond(q + t * v + 0.5 * t * t * a).max() <= 1e-12
            q, v = q + H * v + 0.5 * H * H * a, v + H * a
            assert (np.abs(v) <= limits.v_max * (1.0 + 1e-12)).all()
        assert (np.abs(v) <= panda.margin / HOLD_GAIN).all()


@pytest.mark.parametrize("told", [True, False])
def test_motors_with_a_lag_pass_no_limit_where_the_law_knows_it(arm, told):
    rng = np.random.default_rng(0)
    lag = np.full(arm.n, 1.0 / (2.0 * np.pi * 50.0))  # s
    share = -np.expm1(-H / lag)  # of the way to a new torque in a step
    stop = arm.stop(motor_lag=lag)
    for _ in range(3):
        q, v = arm.edge(rng)
        tau = pin.rnea(arm.model, arm.data, q, v, np.zeros(arm.n)).copy()
        stop.start(q, v)
        for _ in range(round((stop.time_to_rest(v) + 0.2) / H)):
            asked = stop.torque(q, v, tau if told else None)
            before = tau
            tau = tau + share * (asked - tau)
            mean = asked + (before - asked) * lag / H * share
            q, v = arm.move(q, v, mean, 1)
            assert arm.beyond(q).max() <= (0.0 if told else 1e-4)
            assert (np.abs(v) <= arm.limits.v_max).all()
        assert stop.at_rest
        assert np.abs(v).max() < 5e-3


def test_the_observer_balances_what_the_model_does_not_know(arm):
    rng = np.random.default_rng(2)
    q, v = arm.inside(rng)
    unknown = 0.1 * arm.tau_max * rng.uniform(-1.0, 1.0, arm.n)
    without, with_it = arm.stop(), arm.stop(observer_time=0.002)
    for stop in (without, with_it):
        stop.start(q, v)
    state = {without: (q, v), with_it: (q, v)}
    for _ in range(600):
        for stop in state:
            state[stop] = arm.move(*state[stop], stop.torque(*state[stop]) + unknown, 1)
    assert np.abs(state[with_it][1]).max() < 1e-6
    assert with_it.at_rest
    assert np.abs(state[with_it][0] - with_it._place).max() < 3e-4
    np.testing.assert_allclose(with_it._disturbance, unknown, atol=0.02 * arm.tau_max.max())
    drift = [np.abs(state[stop][0] - stop._place).max() for stop in state]
    assert drift[0] > 10.0 * drift[1]


def test_at_rest_it_holds_its_place_and_gives_way_to_a_long_push(panda):
    stop = panda.stop(observer_time=0.005)
    q, v = panda.inside(np.random.default_rng(3))
    stop.start(q, v)
    for _ in range(300):
        q, v = panda.move(q, v, stop.torque(q, v), 1)
    held = q
    knock = np.zeros(7)
    knock[3] = 10.0
    for _ in range(20):
        q, v = panda.move(q, v, stop.torque(q, v) + knock, 1)
    moved = np.abs(q - held).max()
    assert 2e-4 < moved < GIVE_WAY
    for _ in range(600):
        q, v = panda.move(q, v, stop.torque(q, v), 1)
    assert np.abs(q - held).max() < 1e-3
    q = held + 2.0 * GIVE_WAY  # carried off: it stays where it is then
    for _ in range(300):
        q, v = panda.move(q, v, stop.torque(q, v), 1)
    assert stop.at_rest
    assert np.abs(q - held - 2.0 * GIVE_WAY).max() < GIVE_WAY / 2.0


def test_from_outside_it_goes_no_further_than_full_braking_and_comes_back_slowly(panda):
    limits = panda.limits
    rng = np.random.default_rng(4)
    stop = panda.stop()
    for _ in range(3):
        q, v = panda.edge(rng)
        v = v * rng.uniform(1.0, 1.3, panda.n)
        j = rng.integers(panda.n)
        q[j] = limits.q_max[j] + 0.02
        end = q + v * np.abs(v) / (2.0 * stop._braking(v))
        allowed = np.maximum(panda.beyond(end), panda.beyond(q)) + 2e-5
        fastest = np.maximum(np.abs(v), limits.v_max)
        stop.start(q, v)
        for _ in range(2500):
            beyond, before = panda.beyond(q), np.abs(v)
            hardest = HARDER * stop._braking(v) + ROUNDING
            tau = stop.torque(q, v)
            q, v = panda.move(q, v, tau, 1)
            assert (panda.beyond(q) <= allowed).all()
            assert (np.abs(v) <= fastest).all()
            if (np.abs(tau) < panda.tau_max).all():
                assert (np.abs(stop.acceleration) <= hardest).all()
            back = (panda.beyond(q) > 0.0) & (panda.beyond(q) < beyond)
            slow = np.maximum(before, 1.01 * RETURN_SPEED * limits.v_max)
            assert (np.abs(v) <= slow)[back].all()
        assert stop.at_rest
        assert panda.beyond(q).max() < 1e-6


def test_torque_limits_win_whatever_the_state(arm):
    rng = np.random.default_rng(5)
    weak = 0.2 * arm.tau_max
    stop = CoordinatedStop(arm.model, arm.limits, weak, H, observer_time=0.002)
    for _ in range(200):
        q = rng.uniform(arm.limits.q_min - 0.3, arm.limits.q_max + 0.3)
        v = rng.normal(size=arm.n) * arm.limits.v_max
        stop.start(q, v)
        tau = stop.torque(q, v)
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= weak).all()
        # The accelerations told are those that the torques give.
        a = pin.aba(arm.model, arm.data, q + 0.5 * H * v, v + 0.5 * H * stop.acceleration, tau)
        assert np.linalg.norm(a - stop.acceleration) < 0.02 * (1.0 + np.linalg.norm(a))


def test_joints_may_be_in_any_order(panda):
    order = np.array([3, 0, 6, 1, 5, 2, 4])
    limits = panda.limits
    fields = ("q_min", "q_max", "v_max", "a_min", "a_max")
    arrays = (getattr(limits, field)[order] for field in fields)
    mixed = JointLimits([limits.names[i] for i in order], *arrays)
    weak = 0.3 * panda.tau_max
    one = CoordinatedStop(panda.model, limits, weak, H, observer_time=0.01)
    other = CoordinatedStop(panda.model, mixed, weak[order], H, observer_time=0.01)
    rng = np.random.default_rng(6)
    for _ in range(5):
        q, v = panda.edge(rng)
        one.start(q, v)
        other.start(q[order], v[order])
        for k in range(3):  # the second on: what it observes counts too
            moved = q + k * H * v
            expected = one.torque(moved, 0.9 * v)[order]
            found = other.torque(moved[order], 0.9 * v[order])
            np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_stop_begun_anew_remembers_nothing(panda):
    rng = np.random.default_rng(7)
    q, v = panda.edge(rng)
    fresh, used = panda.stop(observer_time=0.002), panda.stop(observer_time=0.002)
    used.start(*panda.edge(rng))
    for _ in range(5):
        used.torque(*panda.edge(rng))
    for stop in (fresh, used):
        stop.start(q, v)
    np.testing.assert_array_equal(fresh.torque(q, v), used.torque(q, v))


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"tau_max": np.zeros(7)}, "panda_joint1"),
        ({"tau_max": np.ones(3)}, "7 joints"),
        ({"dt": 0.0}, "dt"),
    ],
)
def test_settings_that_cannot_be_are_refused(panda, changed, says):
    given = {"model": panda.model, "limits": panda.limits, "tau_max": panda.tau_max, "dt": H}
    with pytest.raises(JointLimitsError, match=says):
        CoordinatedStop(**given | changed)


def test_limits_of_other_joints_are_refused(panda):
    limits = panda.limits
    names = ("elbow", *limits.names[1:])
    fields = ("q_min", "q_max", "v_max", "a_min", "a_max")
    other = JointLimits(names, *(getattr(limits, field) for field in fields))
    with pytest.raises(JointLimitsError, match="elbow"):
        CoordinatedStop(panda.model, other, panda.tau_max, H)
