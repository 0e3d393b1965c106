# SPDX-License-Identifier: Apache-2.0
"""State-dependent limits: on a pendulum, where everything is known, and on arms in motion."""

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.acceleration_limits import estimate_acceleration_limits
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.state_dependent import limits as state_dependent_limits
from viability_bounds_pkg.state_dependent.certificate import BrakingCertificate, Reach
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds
from viability_bounds_pkg.state_dependent.reach import available
from viability_bounds_pkg.viability import BoundsSolver

MASS, LENGTH, GRAVITY = 2.0, 0.5, 9.81
WEIGHT = MASS * GRAVITY * LENGTH
DT = 1e-3


def pendulum(angle_of_vertical):
    """Return a point mass on a rod; the joint turns about y, `angle_of_vertical` is upright."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "swing")
    turned = pin.SE3(pin.utils.rotate("y", -angle_of_vertical), np.zeros(3))
    tip = pin.SE3(np.eye(3), np.array([0.0, 0.0, LENGTH]))
    inertia = pin.Inertia(MASS, np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(joint, inertia, turned * tip)
    return model


def limits_of(model, tau_max, q_range, v_max, factor=1.0):
    """Return the limits with the worst case found by the estimator."""
    n = model.nv
    q_min, q_max = (np.full(n, x) for x in q_range)
    found = estimate_acceleration_limits(
        model, q_min, q_max, np.full(n, v_max), np.full(n, tau_max), 2000, 0, method="refined"
    )
    names = [f"joint_{j}" for j in range(n)]
    return JointLimits(
        names, q_min, q_max, np.full(n, v_max), factor * found.a_min, factor * found.a_max
    )


def greedy(model, solver, limits, tau_max, target, q, steps, dt=DT):
    """Race to `target` with the highest acceleration that bounds and torque allow.

    Returns the position at each step, the deepest violations of position and velocity, and the
    largest shortfall of torque, all continuous-time for the (nearly constant) accelerations.
    """
    data = model.createData()
    v = np.zeros(model.nv)
    path, worst = [], np.zeros(3)
    for _ in range(steps):
        path.append(q.copy())
        lower, upper, _ = solver.bounds(q, v)
        M, h = pin.crba(model, data, q), pin.nonLinearEffects(model, data, q, v)
        # One joint: the torque limits are an interval of accelerations.
        low, high = ((s * tau_max - h) / M[0, 0] for s in (-1.0, 1.0))
        a = np.where(target > q, upper, lower)
        worst[2] = max(worst[2], (lower - high).max(), (low - upper).max())
        tau = np.clip(M @ np.clip(a, lower, upper) + h, -tau_max, tau_max)
        for _ in range(4):
            a = pin.aba(model, data, q, v, tau)
            h4 = dt / 4
            q = q + h4 * v + 0.5 * h4 * h4 * a
            v = v + h4 * a
            worst[0] = max(worst[0], (q - limits.q_max).max(), (limits.q_min - q).max())
            worst[1] = max(worst[1], (np.abs(v) - limits.v_max).max())
    return np.array(path), worst


def pendulum_solvers(q_max, tau_max=1.3 * WEIGHT, peak=60.0):
    """Return a pendulum, upright at zero, its limits, and both kinds of bounds.

    With the rod horizontal, at pi/2, braking a fall has to hold the whole weight. A limit beyond
    that leaves more on the way to it; for one just there it is less than before.
    """
    model = pendulum(0.0)
    limits = limits_of(model, tau_max, (-1.0, q_max), 6.0)
    # More than the drift of the acceleration in a step of 1 ms.
    margin = np.array([0.2])
    worst = BoundsSolver(limits, 2 * DT, margin, period=DT)
    ours = StateDependentBounds(
        model, limits, [tau_max], [peak], 2 * DT, margin, DT, tolerance=1e-5
    )
    return model, limits, worst, ours, tau_max


BEYOND, JUST_THERE = 3.0, 1.7


def test_worst_case_of_the_pendulum():
    _, limits, *_ = pendulum_solvers(BEYOND)
    inertia = MASS * LENGTH**2
    np.testing.assert_allclose(limits.a_min, -0.3 * WEIGHT / inertia, rtol=1e-3)
    np.testing.assert_allclose(limits.a_max, (1.3 - np.sin(1.0)) * WEIGHT / inertia, rtol=1e-3)


@pytest.mark.parametrize("angle", [-0.8, 0.0, 1.5, 2.5])
def test_weight_helps_to_brake_one_way_and_hinders_the_other(angle):
    model, tau_max, v = pendulum(0.0), 1.3 * WEIGHT, np.zeros(1)
    data, q = model.createData(), np.array([angle])
    M, h = pin.crba(model, data, q).copy(), pin.nonLinearEffects(model, data, q, v).copy()
    none, peak = np.zeros(1), np.full(1, np.inf)
    low, high, braking = available(M, h, np.array([tau_max]), none, none, peak)
    down, up = (pin.aba(model, data, q, v, np.array([s * tau_max]))[0] for s in (-1.0, 1.0))
    np.testing.assert_allclose(braking, [[-down, up]])
    np.testing.assert_allclose([low[0], high[0]], [down, up])


def test_faster_and_still_within_every_limit():
    model, limits, worst, ours, tau_max = pendulum_solvers(BEYOND)
    times = []
    for solver in (worst, ours):
        path, broken = greedy(model, solver, limits, tau_max, 5.0, np.array([-0.9]), 3000)
        # Within 1e-5 rad, the tolerance; no bound ever asks for more than the motor has.
        assert broken[0] <= 1e-5 and broken[1] <= 0.0 and broken[2] <= 0.0
        assert abs(path[-1, 0] - BEYOND) < 1e-3
        times.append(int(np.argmax(path[:, 0] > BEYOND - 0.05)))
    assert times[1] < 0.9 * times[0]
    assert ours.outcomes["certified"] > 50


def test_without_a_look_at_the_path_the_limit_is_broken(monkeypatch):
    """The braking available on top is not there further down: what the certificate is for."""
    broken = []
    for blind in (False, True):
        if blind:
            monkeypatch.setattr(BrakingCertificate, "holds", lambda self, reach: True)
        model, limits, _, ours, tau_max = pendulum_solvers(JUST_THERE)
        _, worst = greedy(model, ours, limits, tau_max, 5.0, np.array([-0.9]), 3000)
        broken.append(worst[0])
    assert broken[0] <= 1e-5
    assert broken[1] > 0.05


def test_a_torque_that_always_suffices_needs_no_path():
    """Where torque is plenty, the braking is that of the peak, not of the worst case."""
    model, limits, worst, _, _ = pendulum_solvers(BEYOND)
    ours = StateDependentBounds(model, limits, [1e4], [20.0], 2 * DT, None, DT)
    state = [BEYOND - 0.1], [1.9]
    bounds = ours.bounds(*state)
    assert bounds.viable.all()
    exact = BoundsSolver(
        JointLimits(limits.names, limits.q_min, limits.q_max, limits.v_max, [-20.0], [20.0]),
        2 * DT,
        period=DT,
    ).bounds(*state)
    np.testing.assert_allclose(bounds.lower, exact.lower)
    np.testing.assert_allclose(bounds.upper, exact.upper)
    assert not worst.bounds(*state).viable.all()


def test_where_nothing_can_be_shown_it_is_the_worst_case(monkeypatch):
    """With a certificate that never holds, the kernel of the worst case is never left."""
    monkeypatch.setattr(BrakingCertificate, "holds", lambda self, reach: False)
    model, limits, worst, ours, tau_max = pendulum_solvers(BEYOND)
    _, broken = greedy(model, ours, limits, tau_max, 5.0, np.array([-0.9]), 3000)
    assert broken[0] <= 1e-5
    assert set(ours.outcomes) == {"worst case"}
    for q, v in ((1.0, 1.0), (2.9, 0.4), (-0.5, -1.0)):
        ours.reset()
        mine, theirs = ours.bounds([q], [v]), worst.bounds([q], [v])
        # Only the input limits differ.
        inside = limits.a_min, limits.a_max
        np.testing.assert_allclose(np.clip(mine.upper, *inside), theirs.upper, atol=1e-9)
        np.testing.assert_allclose(np.clip(mine.lower, *inside), theirs.lower, atol=1e-9)


def test_a_shove():
    """No path is known there: the joint is brought back as hard as the motor can."""
    _, limits, _, ours, _ = pendulum_solvers(BEYOND)
    shoved = ours.bounds([2.99], [5.9])
    assert not shoved.viable.any()
    assert shoved.upper < limits.a_min
    assert ours.outcomes["outside"] == 1
    assert np.isfinite(ours.bounds([3.5], [9.0]).lower).all()


@pytest.mark.parametrize("seed", range(3))
def test_certificate_covers_the_reach(seed):
    """Torque along braking paths from random states in reach, against the certificate."""
    rng = np.random.default_rng(seed)
    model = pin.buildSampleModelManipulator()
    data = model.createData()
    n = model.nv
    held = 0
    for _ in range(60):
        reach = Reach(
            rng.uniform(-1.0, 1.0, n),
            rng.uniform(-1.5, 1.5, n),
            rng.uniform(0.0, 1e-4, n),
            rng.uniform(0.0, 0.01, n),
            rng.uniform(4.0, 12.0, n),
            rng.uniform(0.02, 0.25),
        )
        needed = np.zeros(n)
        for _ in range(40):
            q0 = reach.q + rng.choice([-1.0, 1.0], n) * reach.dq
            v0 = reach.v + rng.choice([-1.0, 1.0], n) * reach.dv
            for t in np.linspace(0.0, reach.horizon, 15):
                stop = np.minimum(t, np.abs(v0) / reach.braking)
                a = np.where(t < np.abs(v0) / reach.braking, -np.sign(v0) * reach.braking, 0.0)
                q = q0 + v0 * stop - 0.5 * np.sign(v0) * reach.braking * stop**2
                v = v0 - np.sign(v0) * reach.braking * stop
                needed = np.maximum(needed, np.abs(pin.rnea(model, data, q, v, a)))
        # The reserve is for what the first order leaves out.
        reserve = state_dependent_limits.TORQUE_RESERVE
        assert not BrakingCertificate(model, (1.0 - reserve) * 0.99 * needed).holds(reach)
        held += BrakingCertificate(model, 2.0 * needed).holds(reach)
    assert held > 20  # it is of use, too


def test_bad_peak():
    model, limits, *_ = pendulum_solvers(BEYOND)
    with pytest.raises(JointLimitsError, match="peak of joint 'joint_0' is 1"):
        StateDependentBounds(model, limits, [10.0], [1.0], DT)
