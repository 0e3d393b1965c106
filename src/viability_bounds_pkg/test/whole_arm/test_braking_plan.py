# SPDX-License-Identifier: Apache-2.0
"""Braking plans: where they end, what is left of them after a step, and how torques change."""

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.whole_arm.braking_plan import (
    AT_LIMIT,
    HARDEST,
    TIMED,
    fill_plan,
    samples,
    sensitivity,
    stop_times,
)

DT = 0.01
N = 7
LOW, HIGH = np.full(N, -1.0), np.full(N, 1.2)
BRAKING = np.linspace(3.0, 15.0, N)
TOLERANCE = np.full(N, 1e-5)


class Plan:
    """A plan and its samples."""

    def __init__(self, q, v, T, dt=DT):
        self.q, self.v = q, v
        self.times, self.kind = np.zeros(N), np.zeros(N)
        self.beyond = stop_times(q, v, T, LOW, HIGH, BRAKING, dt, TOLERANCE, self.times, self.kind)
        count = samples(N)
        self.clock = np.zeros(count)
        self.positions, self.velocities, self.accelerations = (
            np.zeros((count, N)) for _ in range(3)
        )
        fill_plan(
            q,
            v,
            self.times,
            self.positions,
            self.velocities,
            self.accelerations,
            self.clock,
        )

    def at(self, t):
        """The state after time t, by the definition."""
        t = np.minimum(t, self.times)
        a = -self.v / self.times
        return self.q + (self.v + 0.5 * a * t) * t, self.v + a * t


def random_state(rng):
    """A state from which no joint has to brake harder than it can within a step."""
    q = rng.uniform(LOW, HIGH)
    room = np.where(rng.random(N) < 0.5, HIGH - q, LOW - q)
    hardest = np.sqrt(2.0 * BRAKING * np.abs(room))
    return q, np.sign(room) * rng.uniform(0.0, 1.0, N) * np.minimum(hardest, 2.0)


@pytest.mark.parametrize("seed", range(20))
def test_a_plan_ends_at_rest_within_the_limits(seed):
    rng = np.random.default_rng(seed)
    plan = Plan(*random_state(rng), rng.uniform(DT, 1.0))
    assert plan.beyond <= 0.0
    slack = TOLERANCE + 1e-12
    assert (plan.positions >= LOW - slack).all()
    assert (plan.positions <= HIGH + slack).all()
    assert (np.abs(plan.velocities) <= np.abs(plan.v) + 1e-12).all()
    np.testing.assert_array_equal(plan.velocities[-1], 0.0)
    np.testing.assert_array_equal(plan.accelerations[-1], 0.0)
    for k, t in enumerate(plan.clock):
        q, v = plan.at(t)
        np.testing.assert_allclose(plan.positions[k], q, atol=1e-12)
        np.testing.assert_allclose(plan.velocities[k], v, atol=1e-6)


def test_times_and_hardest_braking_and_limits_decide():
    q = np.array([0.0, 0.0, 1.1, 1.2, -1.0, 0.0, 0.0])
    v = np.array([0.1, 2.0, 1.0, 0.0, -1e-4, 0.0, -0.3])
    plan = Plan(q, v, 0.3)
    assert plan.kind.tolist()[:3] == [TIMED, HARDEST, AT_LIMIT]
    assert plan.times[0] == 0.3
    assert plan.times[1] == pytest.approx(2.0 / BRAKING[1])
    assert plan.times[2] == pytest.approx(2.0 * (0.1 + TOLERANCE[2]) / 1.0)
    assert plan.times[4] == pytest.approx(2.0 * TOLERANCE[4] / 1e-4)
    assert plan.beyond == 0.0


@pytest.mark.parametrize(
    ("place", "speed", "beyond"),
    [
        (1.2, 0.1, 0.5 * 0.1 * DT - 1e-5),
        (1.21, 0.0, 0.01 - 1e-5),
        (-1.02, -0.5, 0.02 + 0.5 * 0.5 * DT - 1e-5),
    ],
)
def test_a_limit_that_cannot_be_kept_is_told(place, speed, beyond):
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    assert Plan(q, v, 0.3).beyond == pytest.approx(beyond)


@pytest.mark.parametrize("seed", range(20))
def test_the_rest_of_a_plan_is_the_plan_of_the_time_that_is_left(seed):
    """What makes one plan, once found, enough for ever."""
    rng = np.random.default_rng(seed)
    T = rng.uniform(3.0 * DT, 0.8)
    plan = Plan(*random_state(rng), T)
    left = Plan(*plan.at(DT), T - DT)
    moving = plan.times > 2.0 * DT
    np.testing.assert_allclose(left.times[moving], plan.times[moving] - DT, rtol=1e-6)
    for t in np.linspace(0.0, T, 17):
        for mine, other in zip(left.at(t), plan.at(DT + t), strict=True):
            np.testing.assert_allclose(mine[moving], other[moving], atol=1e-8)


@pytest.mark.parametrize("seed", range(10))
def test_torques_change_as_the_derivatives_say(seed):
    """Against the torques of plans from states a little apart, at each kind of sample."""
    rng = np.random.default_rng(seed)
    model = pin.buildSampleModelManipulator()
    joints = [model.addJoint(model.njoints - 1, pin.JointModelRX(), pin.SE3.Random(), "more")]
    model.appendBodyToJoint(joints[0], pin.Inertia.Random(), pin.SE3.Identity())
    assert model.nv == N
    data = model.createData()
    T, step = 0.4, 1e-6
    q, v = random_state(rng)
    plan = Plan(q, v, T)
    a_plan = -v / plan.times

    def torque(a, t, kinds):
        after = Plan(q + v * DT + 0.5 * DT * DT * a, v + DT * a, T - DT)
        if not np.array_equal(after.kind[kinds], plan.kind[kinds]):
            pytest.skip("a joint changed its kind")
        states = after.at(t)
        moving = t < after.times
        return pin.rnea(model, data, *states, np.where(moving, -after.v / after.times, 0.0))

    times = np.sort(plan.times)
    for clock in (DT, 0.5 * (times[2] + times[3]), T + 1.0):
        if np.abs(plan.times - clock).min() < 1e-3:
            continue
        states = plan.at(clock)
        moving = clock < plan.times
        a = np.where(moving, a_plan, 0.0)
        by_q, by_v, M = pin.computeRNEADerivatives(model, data, *states, a)
        gradient = np.zeros((N, N))
        sensitivity(DT, plan.times, plan.kind, clock, by_q, by_v, M, gradient)
        for j in np.flatnonzero(plan.times > 3.0 * DT):
            da = np.zeros(N)
            da[j] = step
            kinds = np.arange(N) == j
            high, low = (torque(a_plan + s * da, clock - DT, kinds) for s in (1.0, -1.0))
            measured = (high - low) / (2.0 * step)
            scale = max(np.abs(measured).max(), 1e-3)
            np.testing.assert_allclose(gradient[:, j], measured, atol=2e-3 * scale)
