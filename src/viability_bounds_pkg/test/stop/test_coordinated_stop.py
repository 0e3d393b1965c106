# SPDX-License-Identifier: Apache-2.0
"""The stop of an arm, against adversaries and the motion of the model under held torques."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import lsq_linear
from stopping_arm import FEW_STEPS, Arm, H

from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.robot.dynamics import within_torque_limits
from viability_bounds_pkg.stop import CoordinatedStop
from viability_bounds_pkg.viability import BoundsSolver

FIELDS = ("q_min", "q_max", "v_max", "a_min", "a_max")


@pytest.fixture(scope="module")
def panda():
    return Arm("panda")


@pytest.fixture(scope="module")
def talos():
    return Arm("talos_left_arm")


@pytest.fixture(params=["panda", "talos"])
def arm(request):
    return request.getfixturevalue(request.param)


def test_all_joints_slow_down_together_along_the_direction_of_motion(arm):
    stop = arm.stop()
    q, v = arm.inside(np.random.default_rng(0))
    v0, time = v, stop.time_to_rest(v)
    # No joint could have been faster: the one that decides brakes as hard as it may.
    assert time == pytest.approx(np.max(np.abs(v0) / arm.braking(v0)))
    stop.start(q, v)
    steps = 0
    while not stop.at_rest:
        q, v = arm.move(q, v, stop.torque(q, v))
        across = v - v0 * (v @ v0) / (v0 @ v0)
        assert np.linalg.norm(across) < 2e-3 * np.linalg.norm(v0)
        assert (stop.acceleration >= arm.limits.a_min - 1e-9).all()
        assert (stop.acceleration <= arm.limits.a_max + 1e-9).all()
        steps += 1
    assert time <= steps * H < time + FEW_STEPS


def test_no_limit_is_passed_from_the_edge_of_the_kernel(arm):
    stop, rng = arm.stop(), np.random.default_rng(0)
    for _ in range(8):
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


@pytest.mark.parametrize("share", [0.5, 1.5], ids=["braking enough", "too little"])
def test_speed_limits_that_depend_on_position_are_kept(share):
    arm = Arm("panda", (0.15, share))
    stop, rng, nearest = arm.stop(), np.random.default_rng(3), np.inf
    for _ in range(5):
        q, v = arm.edge(rng)
        stop.start(q, v)
        steps = round((stop.time_to_rest(v) + FEW_STEPS) / H)
        for _ in range(steps):
            q, v = arm.move(q, v, stop.torque(q, v))
            lowest, highest = arm.limits.velocities(q)
            nearest = min(nearest, (highest - v).min(), (v - lowest).min())
        assert stop.at_rest
    assert 0.0 <= nearest < 0.01  # rad/s


def test_joints_come_to_rest_clear_of_their_limits_where_they_can(panda):
    """Where friction holds them they stay there, and what lets them slip takes them no further."""
    stop, limits, clearance = panda.stop(), panda.limits, 4e-4
    lowest, highest = limits.q_min + clearance, limits.q_max - clearance
    solver = BoundsSolver(replace(limits, q_min=lowest, q_max=highest), H, panda.margin)
    rng, nearest = np.random.default_rng(0), 0
    for _ in range(6):
        q = np.clip(panda.edge(rng)[0], lowest, highest)
        low, high = solver.velocity_range(q)
        v = rng.uniform(0.7, 1.0, panda.n) * np.where(rng.random(panda.n) < 0.5, low, high)
        stop.start(q, v)
        while not stop.at_rest:
            q, v = panda.move(q, v, stop.torque(q, v))
            assert (np.minimum(highest - q, q - lowest) >= -2e-5).all()
        nearest += (np.minimum(highest - q, q - lowest) < 1e-4).sum()
    assert nearest >= 1  # the limits did matter


@pytest.mark.parametrize("adversary", ["out", "back", "random", "alternating"])
def test_an_adversary_of_accelerations_within_the_margin_passes_no_limit(panda, adversary):
    """As in docs/theory/whole_arm.md, accelerations are off by all of the margin in each step."""
    rng, stop, limits = np.random.default_rng(1), panda.stop(), panda.limits
    for _ in range(3):
        q, v = panda.edge(rng)
        way = np.sign(v)
        stop.start(q, v)
        for k in range(round((stop.time_to_rest(v) / 0.95 + 4 * FEW_STEPS) / H)):
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
            for t in (np.minimum(turns, H), H):  # furthest within the step, and its end
                assert panda.beyond(q + t * v + 0.5 * t * t * a).max() <= 1e-12
            q, v = q + H * v + 0.5 * H * H * a, v + H * a
            assert (np.abs(v) <= limits.v_max * (1.0 + 1e-12)).all()
        assert (np.abs(v) <= panda.margin / 30.0).all()


@pytest.mark.parametrize("options", [{"observer_time": 0.002}, {}])
def test_only_with_the_observer_it_rests_under_torques_that_the_model_does_not_know(
    panda, options
):
    rng, stop = np.random.default_rng(2), panda.stop(**options)
    unknown = 0.1 * panda.tau_max * rng.uniform(-1.0, 1.0, panda.n)
    q, v = panda.inside(rng)
    stop.start(q, v)
    place = q
    for _ in range(600):
        q, v = panda.move(q, v, stop.torque(q, v) + unknown)
        place = place if stop.at_rest else q
    assert stop.at_rest == bool(options)
    if options:
        assert np.abs(q - place).max() < 3e-4
        assert np.abs(v).max() < 1e-6


def test_at_rest_it_holds_its_place_and_gives_way_to_a_long_push(panda):
    stop = panda.stop(observer_time=0.005)
    q, v = panda.inside(np.random.default_rng(3))
    stop.start(q, v)

    def go_on(steps, knock=0.0):
        nonlocal q, v
        for _ in range(steps):
            q, v = panda.move(q, v, stop.torque(q, v) + knock)

    go_on(300)
    held = q
    go_on(20, knock=np.array([0.0, 0, 0, 10, 0, 0, 0]))
    assert 2e-4 < np.abs(q - held).max() < 0.02
    go_on(600)
    assert np.abs(q - held).max() < 1e-3
    q = held + 0.04  # carried off: it stays where it is then
    go_on(300)
    assert stop.at_rest
    assert np.abs(q - held - 0.04).max() < 0.01


def test_from_outside_it_goes_no_further_than_full_braking_and_comes_back_slowly(panda):
    limits, rng, stop = panda.limits, np.random.default_rng(4), panda.stop()
    for _ in range(2):
        q, v = panda.edge(rng)
        v = v * rng.uniform(1.0, 1.3, panda.n)
        j = rng.integers(panda.n)
        q[j] = limits.q_max[j] + 0.02
        end = q + v * np.abs(v) / (2.0 * panda.braking(v))
        allowed = np.maximum(panda.beyond(end), panda.beyond(q)) + 2e-5
        fastest = np.maximum(np.abs(v), limits.v_max)
        stop.start(q, v)
        for _ in range(2000):
            beyond, before = panda.beyond(q), np.abs(v)
            hardest = 3.0 * panda.braking(v) + 1e-9
            tau = stop.torque(q, v)
            q, v = panda.move(q, v, tau)
            assert (panda.beyond(q) <= allowed).all()
            assert (np.abs(v) <= fastest).all()
            if (np.abs(tau) < panda.tau_max).all():
                assert (np.abs(stop.acceleration) <= hardest).all()
            back = (panda.beyond(q) > 0.0) & (panda.beyond(q) < beyond)
            slow = np.maximum(before, 1.01 * 0.1 * limits.v_max)
            assert (np.abs(v) <= slow)[back].all()
        assert stop.at_rest
        assert panda.beyond(q).max() < 1e-6


def test_torque_limits_win_whatever_the_state(arm):
    rng = np.random.default_rng(5)
    weak = 0.2 * arm.tau_max
    stop = CoordinatedStop(arm.model, arm.limits, weak, H, observer_time=0.002)
    for _ in range(100):
        q = rng.uniform(arm.limits.q_min - 0.3, arm.limits.q_max + 0.3)
        v = rng.normal(size=arm.n) * arm.limits.v_max
        stop.start(q, v)
        tau = stop.torque(q, v)
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= weak).all()
        # The accelerations told are those that the torques give.
        a = pin.aba(arm.model, arm.data, q + 0.5 * H * v, v + 0.5 * H * stop.acceleration, tau)
        assert np.linalg.norm(a - stop.acceleration) < 0.02 * (1.0 + np.linalg.norm(a))


@pytest.mark.parametrize("seed", range(5))
def test_motors_that_are_too_weak_change_accelerations_by_the_least_amount(seed):
    """Against another solver: with the torque as unknown it is bounded least squares."""
    rng, n = np.random.default_rng(seed), 5
    root = rng.normal(size=(n, n))
    M = root @ root.T + 0.3 * np.eye(n)
    a, scale, wide = rng.uniform(-1.0, 1.0, n), rng.uniform(1.0, 5.0, n), np.full(n, np.inf)
    tau = M @ a + rng.normal(size=n)
    tau_max = np.where(np.arange(n) < 2, 0.6 * np.abs(tau), 1.2 * np.abs(tau) + 0.5)
    found = within_torque_limits(a, -wide, wide, scale, M, tau, -tau_max, tau_max)
    change = np.linalg.inv(M * scale)
    best = lsq_linear(change, change @ tau, (-tau_max, tau_max), method="bvls").x
    np.testing.assert_allclose(tau + M @ (found - a), best, atol=1e-6)
    enough = within_torque_limits(
        a, -wide, wide, scale, M, tau, -1.01 * np.abs(tau), 1.01 * np.abs(tau)
    )
    np.testing.assert_array_equal(enough, a)


def test_a_joint_at_its_limit_is_helped_by_the_others():
    """The first motor is too weak; the second joint helps where the first is at its limit."""
    M = np.array([[1.0, 0.8], [0.8, 1.0]])
    a, tau = np.array([-3.0, 0.0]), np.array([-3.0, -2.4])
    tau_max = np.array([2.0, 20.0])
    wide, edge = np.full(2, np.inf), np.array([-3.0, np.inf])
    alone = within_torque_limits(a, -wide, wide, np.ones(2), M, tau, -tau_max, tau_max)
    helped = within_torque_limits(a, -wide, edge, np.ones(2), M, tau, -tau_max, tau_max)
    assert alone[0] > -2.5
    assert helped[0] == pytest.approx(-3.0, abs=0.01)
    assert helped[1] > 1.0


def test_joints_may_be_in_any_order(panda):
    order, limits = np.array([3, 0, 6, 1, 5, 2, 4]), panda.limits
    arrays = (getattr(limits, field)[order] for field in FIELDS)
    mixed = JointLimits([limits.names[i] for i in order], *arrays)
    weak = 0.3 * panda.tau_max
    one = CoordinatedStop(panda.model, limits, weak, H, observer_time=0.01)
    other = CoordinatedStop(panda.model, mixed, weak[order], H, observer_time=0.01)
    q, v = panda.edge(np.random.default_rng(6))
    one.start(q, v)
    other.start(q[order], v[order])
    for k in range(3):  # the second on: what it observes counts too
        moved = q + k * H * v
        found = other.torque(moved[order], 0.9 * v[order])
        np.testing.assert_allclose(found, one.torque(moved, 0.9 * v)[order], atol=1e-5)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"tau_max": np.zeros(7)}, "panda_joint1"),
        ({"tau_max": np.ones(3)}, "7 joints"),
        ({"dt": 0.0}, "dt"),
        ({"limits": JointLimits(["elbow"], [-1.0], [1.0], [1.0], [-1.0], [1.0])}, "elbow"),
    ],
)
def test_settings_that_cannot_be_are_refused(panda, changed, says):
    given = {"model": panda.model, "limits": panda.limits, "tau_max": panda.tau_max, "dt": H}
    with pytest.raises(JointLimitsError, match=says):
        CoordinatedStop(**given | changed)
