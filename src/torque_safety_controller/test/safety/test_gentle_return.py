# SPDX-License-Identifier: Apache-2.0
"""Joints that stand beyond their bounds' margins return without a jolt, and get no farther."""

import numpy as np
import pytest

from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver
from torque_safety_controller.safety.gentle_return import return_gently
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import BoundsSolver

DT = 0.004
LIMITS = JointLimits(
    ["a", "b"],
    np.array([-1.0, -2.0]),
    np.array([1.0, 0.5]),
    np.array([1.7, 2.0]),
    np.array([-3.0, -15.0]),
    np.array([3.0, 15.0]),
)
NO_ROOM = np.zeros(2), np.zeros(2)


@pytest.mark.parametrize("ahead", [1, 2])
def test_what_brakes_a_joint_within_its_range_stays(ahead):
    solver = BoundsSolver(LIMITS, ahead * DT, period=DT)
    rng = np.random.default_rng(3)
    # Most of them so near to a limit, and so fast, that they must brake.
    side = rng.choice([-1.0, 1.0], (20_000, 2))
    edge = np.where(side > 0.0, LIMITS.q_max, LIMITS.q_min)
    q = edge - side * 10.0 ** rng.uniform(-9.0, -0.5, side.shape)
    low, high = solver.velocity_range(q)
    v = np.clip(
        side * np.abs(np.where(side > 0.0, high, low)) * rng.uniform(0.0, 1.0, side.shape) ** 0.2,
        low,
        high,
    )
    found = solver.bounds(q, v)
    bounds = AccelerationRange(found.lower, found.upper)
    assert found.viable.mean() > 0.99
    assert ((bounds.lower > 0.0) | (bounds.upper < 0.0)).mean() > 0.1
    room = q - LIMITS.q_min, LIMITS.q_max - q
    eased = return_gently(bounds, v, room, 0.0, DT)
    inside = found.viable
    np.testing.assert_allclose(eased.lower[inside], bounds.lower[inside], atol=1e-6)
    np.testing.assert_allclose(eased.upper[inside], bounds.upper[inside], atol=1e-6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("beyond", [1e-6, 1e-4, 3e-3])
def test_a_joint_that_stands_beyond_its_margin_returns_in_half_a_second(side, beyond):
    solver = BoundsSolver(LIMITS, 2.0 * DT, period=DT)
    edge = LIMITS.q_max if side > 0.0 else LIMITS.q_min
    q, v, before = edge + side * beyond, np.zeros(2), np.zeros(2)
    for k in range(125):
        found = solver.bounds(q, v)
        share = min(1.0, (k + 1) * DT / 0.5)
        bounds = AccelerationRange(found.lower, found.upper)
        low, high = return_gently(bounds, v, NO_ROOM, share, DT)
        a = np.clip(0.0, low, high)
        farther = side * (v * DT + 0.5 * a * DT**2)
        assert (farther <= 1e-12).all()
        if k < 3:  # the bounds demand all at once
            assert np.abs(a - before).max() <= 1.01 * DT / 0.5 * LIMITS.a_max.max()
        q, v, before = q + v * DT + 0.5 * a * DT**2, v + a * DT, a
    assert (side * (q - edge) <= 1e-9).all()
    assert np.abs(v).max() < 0.1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_noise_of_a_velocity_does_not_choose_between_a_push_and_none(side):
    """As of an arm that stands beyond its margin, whose velocities are estimates."""
    q = LIMITS.q_max + 1e-3 if side > 0.0 else LIMITS.q_min - 1e-3
    solver = BoundsSolver(LIMITS, 2.0 * DT, period=DT)

    def least(speed, rough):
        v = np.full(2, side * speed)
        found = solver.bounds(q, v)
        bounds = AccelerationRange(found.lower, found.upper)
        low, high = return_gently(bounds, v, NO_ROOM, 0.0, DT, rough)
        return -side * np.clip(0.0, low, high), -side * np.clip(0.0, *bounds)

    for speed in (1e-6, 1e-3):
        np.testing.assert_allclose(least(-speed, True)[0], 0.0)
        np.testing.assert_allclose(least(speed, True)[0], speed / DT)  # it stands in a period
    # Without noise it does move, but for what a controller that has stopped it leaves.
    np.testing.assert_allclose(least(1e-6, False)[0], 1e-6 / DT)
    eased, demanded = least(1e-3, False)
    np.testing.assert_allclose(eased, demanded)
    eased, demanded = least(0.1, True)
    np.testing.assert_allclose(eased, demanded)  # as it must
    assert (demanded >= 2.9).all()
    # One count of an encoder of 16 bits just before a limit is a little braking, not a jolt.
    bounds = AccelerationRange(-side * demanded, -side * demanded)
    noise = 6.6e-3
    v = np.full(2, side * noise)
    for left, expected in ((1.2e-3, noise / 0.04), (0.4e-3, noise / 0.012), (2e-5, noise / 1e-3)):
        room = np.full(2, left), np.full(2, left)
        low, high = return_gently(bounds, v, room, 0.0, 1e-3, True)
        np.testing.assert_allclose(-side * np.clip(0.0, low, high), np.minimum(expected, demanded))
        back = [return_gently(bounds, w, room, 0.1, 1e-3, True) for w in (0.0 * v, -v)]
        back = [np.clip(0.0, *each) for each in back]
        assert (np.abs(back[1] - back[0]) <= noise / 0.04 + 1e-9).all()


MARGIN = 2e-3  # rad
DISTURBANCE = np.array([0.5, 5.0])  # rad/s^2


@pytest.fixture(scope="module")
def within_margins():
    """Return bounds that keep `MARGIN`, and a disturbance, as of an arm with friction."""
    inner = JointLimits(
        LIMITS.names,
        LIMITS.q_min + MARGIN,
        LIMITS.q_max - MARGIN,
        LIMITS.v_max,
        LIMITS.a_min,
        LIMITS.a_max,
    )
    return BoundsSolver(inner, 2e-3, DISTURBANCE, period=1e-3)


@pytest.mark.parametrize("noise", [0.0, 7e-3])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_within_the_margins_a_joint_that_can_stop_passes_no_limit(within_margins, side, noise):
    """It brakes gently, and always enough: also where the share does not grow.

    Where velocities are estimates, with noise, rad/s, it may come nearer.
    """
    rng = np.random.default_rng(5)
    edge = LIMITS.q_max if side > 0.0 else LIMITS.q_min
    for _ in range(60):
        room = MARGIN * rng.uniform(0.01, 1.0, 2)
        # As fast as lets it stop in a half of the room, at most.
        v = side * np.sqrt(LIMITS.a_max * room) * 10.0 ** rng.uniform(-5.0, 0.0, 2)
        q, least, share = edge - side * room, 0.5 * room, rng.uniform(0.0, 0.9)
        for _ in range(400):
            seen = v + noise * rng.uniform(-1.0, 1.0, 2)
            found = within_margins.bounds(q, seen)
            bounds = AccelerationRange(found.lower, found.upper)
            ways = q - LIMITS.q_min, LIMITS.q_max - q
            low, high = return_gently(bounds, seen, ways, share, 1e-3, noise > 0.0)
            a = np.clip(0.0, low, high)
            q, v = q + v * 1e-3 + 0.5e-6 * a, v + 1e-3 * a
            assert (side * (edge - q) > 0.0).all()
        assert (side * (edge - q) >= (0.2 if noise == 0.0 else 0.05) * least).all()
        assert (side * v < 1e-3 + noise).all()  # it has stopped, or comes back


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("push", "lost"), [(0.1, 0.1), (1.0, 0.0)])
def test_a_push_within_the_margins_that_is_not_known_passes_no_limit(
    within_margins, side, push, lost
):
    """Friction lets go, as the arm stands, and the share does not grow.

    Args:
        push: share of the disturbance that the bounds hold for.
        lost: of the commands, in place of which the last one acts.
    """
    rng = np.random.default_rng(7)
    edge = LIMITS.q_max if side > 0.0 else LIMITS.q_min
    for _ in range(40):
        room = MARGIN * rng.uniform(0.02, 1.0, 2)
        q, v, acting = edge - side * room, np.zeros(2), np.zeros(2)
        for _ in range(300):
            found = within_margins.bounds(q, v)
            bounds = AccelerationRange(found.lower, found.upper)
            ways = q - LIMITS.q_min, LIMITS.q_max - q
            low, high = return_gently(bounds, v, ways, 0.0, 1e-3)
            if rng.random() >= lost:
                acting = np.clip(0.0, low, high)
            a = acting + side * push * DISTURBANCE
            q, v = q + v * 1e-3 + 0.5e-6 * a, v + 1e-3 * a
            assert (side * (edge - q) > 0.0).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_nor_does_it_where_velocities_are_estimates_and_it_is_observed(within_margins, side):
    """Noise is braked little. Of a push, the observer learns in time from 0.1 mrad on."""
    rng = np.random.default_rng(11)
    edge = LIMITS.q_max if side > 0.0 else LIMITS.q_min
    for _ in range(40):
        observer = DisturbanceObserver(2, 0.012)
        q, v, a = edge - side * MARGIN * rng.uniform(0.05, 0.5, 2), np.zeros(2), np.zeros(2)
        for _ in range(300):
            seen = v + 3e-3 * rng.uniform(-1.0, 1.0, 2)
            observer.observe(seen, a, 1e-3, np.full(2, 1e3), np.eye(2))
            found = within_margins.bounds(q, seen)
            bounds = AccelerationRange(found.lower, found.upper)
            ways = q - LIMITS.q_min, LIMITS.q_max - q
            a = np.clip(0.0, *observer.shift(*return_gently(bounds, seen, ways, 0.0, 1e-3, True)))
            given = a + side * DISTURBANCE
            q, v = q + v * 1e-3 + 0.5e-6 * given, v + 1e-3 * given
            assert (side * (edge - q) > 0.0).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_what_stiction_lets_slip_just_before_a_limit_is_no_jolt(within_margins, side):
    """A joint 0.06 mrad before its limit was braked by all that there is in every other period."""
    q = (LIMITS.q_max if side > 0.0 else LIMITS.q_min) - 6e-5 * side
    room = np.full(2, 6e-5), np.full(2, 6e-5)
    for speed, gentle in ((1e-4, True), (5e-3, True), (2e-2, False)):
        v = np.full(2, side * speed)
        found = within_margins.bounds(q, v)
        bounds = AccelerationRange(found.lower, found.upper)
        demanded = -side * np.clip(0.0, *bounds)
        assert (demanded >= 2.9).all()
        low, high = return_gently(bounds, v, room, 0.0, 1e-3)
        least = -side * np.clip(0.0, low, high)
        expected = np.minimum(speed / 1e-3, demanded) if gentle else demanded
        np.testing.assert_allclose(least, expected)  # it stands in a period, if that is in time


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_push_by_friction_within_the_margins_is_no_jolt(within_margins, side):
    """The bounds ask for all that there is, and did so in every other period."""
    q = (LIMITS.q_max if side > 0.0 else LIMITS.q_min) - 0.9 * side * MARGIN
    room = np.full(2, 0.9 * MARGIN), np.full(2, 0.9 * MARGIN)
    for speed in (1e-9, 1e-6, 1e-4, 1e-3):
        v = np.full(2, side * speed)
        found = within_margins.bounds(q, v)
        bounds = AccelerationRange(found.lower, found.upper)
        low, high = return_gently(bounds, v, room, 0.0, 1e-3)
        assert (-side * np.clip(0.0, *bounds) >= 2.9).all()
        least = -side * np.clip(0.0, low, high)
        assert ((least > 0.0) & (least <= 60.0 * speed)).all()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_it_comes_back_to_its_bounds_slower_and_slower(within_margins, side):
    """Without them it was pushed with all of the margin until it was back, and then let go."""
    edge = (LIMITS.q_max if side > 0.0 else LIMITS.q_min) - side * MARGIN
    q, v, before = edge + 0.2 * side * MARGIN, np.zeros(2), np.zeros(2)
    room = np.full(2, 0.8 * MARGIN), np.full(2, 0.8 * MARGIN)
    for k in range(500):
        found = within_margins.bounds(q, v)
        bounds = AccelerationRange(found.lower, found.upper)
        low, high = return_gently(bounds, v, room, min(1.0, (k + 1) * 2e-3), 1e-3)
        a = np.clip(-20.0 * v, low, high)
        assert np.abs(a - before).max() < 0.05 * LIMITS.a_max.max()
        q, v, before = q + v * 1e-3 + 0.5e-6 * a, v + 1e-3 * a, a
    assert (side * (q - edge) <= 1e-5).all()
