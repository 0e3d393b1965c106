# SPDX-License-Identifier: Apache-2.0
"""Braking plans: where they end, what is left of them after a step, and how torques change."""

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.whole_arm.braking_plan import (
    fill_plan,
    passed,
    samples,
    sensitivity,
    stop_times,
)

DT = 0.01
N = 7
LOW, HIGH = np.full(N, -1.0), np.full(N, 1.2)
BRAKING = np.linspace(3.0, 15.0, N)
TOLERANCE = np.full(N, 1e-3)


class Plan:
    """A plan and its samples; of time T, or of given times."""

    def __init__(self, q, v, T=None, times=None):
        self.q, self.v, self.times = q, v, np.zeros(N)
        if times is None:
            stop_times(q, v, T, LOW, HIGH, TOLERANCE, BRAKING, DT, self.times)
        else:
            self.times = times
        self.beyond = passed(q, v, self.times, LOW, HIGH, TOLERANCE)
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
    assert plan.beyond == 0.0
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


def periods(place, speed, T):
    """How many periods joint 3 takes."""
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    return Plan(q, v, T).times[3] / DT


A = BRAKING[3]


@pytest.mark.parametrize(
    ("place", "speed", "T", "expected"),
    [
        (0.0, 0.1, 0.3, 30),  # the time of the plan
        (0.0, 0.1, 0.305, 31),  # rounded up
        (0.0, 1.0, 0.05, np.ceil(1.0 / A / DT)),  # no harder than A
        (1.1, 1.0, 0.3, 20),  # stands at the limit
        (1.1, -1.0, 0.3, 30),  # which is not ahead
        (-0.9, -1.0, 0.3, 20),  # the lower one
        (1.2 - 0.0595, 1.0, 0.3, 12),  # with A, though it stands 0.5 mrad beyond
        (1.2 - 0.02, 1.0, 0.3, 4),  # harder than A, as nothing else helps
        (1.2, 0.0, 0.3, 30),  # at rest at the limit
        (1.3, 0.0, 0.3, 30),  # and beyond
        (1.3, 0.1, 0.3, 1),  # at once
    ],
)
def test_what_decides_how_long_a_joint_takes(place, speed, T, expected):
    assert A == 9.0
    assert periods(place, speed, T) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("place", "speed", "beyond"),
    [
        (1.2, 0.1, 0.0),
        (1.2, 1.0, 0.5 * 1.0 * DT - 1e-3),
        (1.21, 0.0, 0.01 - 1e-3),
        (-1.02, -0.5, 0.02 + 0.5 * 0.5 * DT - 1e-3),
        (-1.02, 0.5, 0.02 - 1e-3),
    ],
)
def test_a_limit_that_cannot_be_kept_is_told(place, speed, beyond):
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    assert Plan(q, v, 0.3).beyond == pytest.approx(beyond)


@pytest.mark.parametrize("seed", range(20))
def test_the_rest_of_a_plan_are_the_times_that_are_left(seed):
    """What makes one plan, once found, enough for ever."""
    rng = np.random.default_rng(seed)
    plan = Plan(*random_state(rng), rng.uniform(3.0 * DT, 0.8))
    left = Plan(*plan.at(DT), times=np.maximum(plan.times - DT, DT))
    assert left.beyond <= 1e-12
    for t in np.linspace(0.0, 1.0, 41):
        for mine, other in zip(left.at(t), plan.at(DT + t), strict=True):
            np.testing.assert_allclose(mine, other, atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_torques_change_as_the_derivatives_say(seed):
    """Against the torques of plans from states a little apart, at each kind of sample."""
    rng = np.random.default_rng(seed)
    model = pin.buildSampleModelManipulator()
    joints = [model.addJoint(model.njoints - 1, pin.JointModelRX(), pin.SE3.Random(), "more")]
    model.appendBodyToJoint(joints[0], pin.Inertia.Random(), pin.SE3.Identity())
    assert model.nv == N
    data = model.createData()
    step = 1e-4
    q, v = random_state(rng)
    plan = Plan(q, v, 0.4)
    a_plan = -v / plan.times
    left = np.maximum(plan.times - DT, DT)

    def torque(a, t):
        after = Plan(q + v * DT + 0.5 * DT * DT * a, v + DT * a, times=left)
        return pin.rnea(model, data, *after.at(t), np.where(t < left, -after.v / left, 0.0))

    ends = np.unique(plan.times)
    for clock in (DT, 0.5 * (ends[0] + ends[-1]) + 0.3 * DT, ends[-1] + 1.0):
        moving = clock < plan.times
        a = np.where(moving, a_plan, 0.0)
        by_q, by_v, M = pin.computeRNEADerivatives(model, data, *plan.at(clock), a)
        gradient = np.zeros((N, N))
        sensitivity(DT, plan.times, clock, by_q, by_v, M, gradient)
        for j in np.flatnonzero(plan.times > 1.5 * DT):
            da = np.zeros(N)
            da[j] = step
            high, low = (torque(a_plan + s * da, clock - DT) for s in (1.0, -1.0))
            measured = (high - low) / (2.0 * step)
            scale = max(np.abs(measured).max(), 1e-6)
            np.testing.assert_allclose(gradient[:, j], measured, atol=1e-4 * scale)
