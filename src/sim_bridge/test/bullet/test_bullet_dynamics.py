# SPDX-License-Identifier: Apache-2.0
"""A robot in PyBullet moves as Pinocchio's equations say."""

from contextlib import closing
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pybullet
import pytest
from bullet_pairs import (
    CASES,
    DYNAMICS_TOLERANCE,
    PHYSICS_DT,
    Pair,
    relative_error,
)

from sim_bridge.bullet.limit_monitor import LimitMonitor


@pytest.fixture(scope="module", params=list(CASES))
def pair(request):
    pair = Pair(CASES[request.param])
    with closing(pair.robot):
        yield pair


@pytest.fixture(autouse=True)
def no_leftovers(request):
    yield
    if "pair" in request.fixturenames:
        robot = request.getfixturevalue("pair").robot
        robot.clear_wrenches()
        robot.monitor = None


# PyBullet's inverse dynamics refuse the awkward tensors, which its steps take.
@pytest.mark.parametrize("pair", [name for name in CASES if name != "awkward"], indirect=True)
def test_inverse_dynamics_equal_pinocchio(pair):
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, v = pair.random_state(rng)
        a = rng.uniform(-20.0, 20.0, pair.n)
        expected = pin.rnea(pair.model, pair.data, q, v, a)
        tau = pybullet.calculateInverseDynamics(
            pair.robot.body_id,
            q.tolist(),
            v.tolist(),
            a.tolist(),
            physicsClientId=pair.robot.client_id,
        )
        assert relative_error(np.array(tau), expected) < DYNAMICS_TOLERANCE


def test_step_accelerates_as_pinocchio(pair):
    rng = np.random.default_rng(2)
    for _ in range(20):
        q, v = pair.random_state(rng)
        tau = rng.uniform(-50.0, 50.0, pair.n)
        expected = pin.aba(pair.model, pair.data, q, v, tau)
        pair.reset_raw(q, v)
        pair.robot.step(tau)
        state = pair.robot.state()
        a = (state.v - v) / PHYSICS_DT
        assert relative_error(a, expected) < DYNAMICS_TOLERANCE
        np.testing.assert_array_equal(state.motor_torque, tau)


def test_wrench_acts_through_the_jacobian(pair):
    rng = np.random.default_rng(3)
    for link in (pair.case.tip, pair.case.middle):
        for _ in range(5):
            q, v = pair.random_state(rng)
            tau = rng.uniform(-20.0, 20.0, pair.n)
            wrench = rng.uniform(-30.0, 30.0, 6)
            jacobian = pin.computeFrameJacobian(
                pair.model,
                pair.data,
                q,
                pair.model.getFrameId(link),
                pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
            )
            expected = pin.aba(pair.model, pair.data, q, v, tau + jacobian.T @ wrench)
            without = pin.aba(pair.model, pair.data, q, v, tau)
            assert relative_error(without, expected) > 1e-3  # the wrench matters
            pair.reset_raw(q, v)
            pair.robot.clear_wrenches()
            pair.robot.apply_wrench(link, wrench[:3], wrench[3:])
            pair.robot.step(tau)
            a = (pair.robot.state().v - v) / PHYSICS_DT
            assert relative_error(a, expected) < DYNAMICS_TOLERANCE


def test_link_poses_equal_pinocchio(pair):
    rng = np.random.default_rng(4)
    links = [link.get("name") for link in ElementTree.fromstring(pair.urdf).findall("link")]
    for _ in range(3):
        q, v = pair.random_state(rng)
        pair.reset_raw(q, v)
        pin.framesForwardKinematics(pair.model, pair.data, q)
        for link in links:
            expected = pair.data.oMf[pair.model.getFrameId(link)]
            pose = pair.robot.link_pose(link)
            np.testing.assert_allclose(pose.homogeneous, expected.homogeneous, atol=1e-12)


def test_gravity_torque_holds_the_arm(pair):
    q = np.full(pair.n, 0.3)
    hold = pin.rnea(pair.model, pair.data, q, np.zeros(pair.n), np.zeros(pair.n))
    pair.robot.reset(q, np.zeros(pair.n))
    pair.robot.step(hold, 200)
    np.testing.assert_allclose(pair.robot.state().q, q, atol=1e-10)
    pair.robot.reset(q, np.zeros(pair.n))
    pair.robot.step(np.zeros(pair.n), 200)
    assert np.abs(pair.robot.state().q - q).max() > 1e-2


def test_brake_stops_holds_and_lets_go(pair):
    n = pair.n
    limits = np.full(n, 300.0)
    rng = np.random.default_rng(6)
    pair.robot.reset(np.full(n, 0.3), rng.uniform(-2.0, 2.0, n))
    pair.robot.monitor = LimitMonitor(np.full(n, -9.0), np.full(n, 9.0), np.full(n, 99.0), limits)
    pair.robot.brake(300, limits)
    stopped = pair.robot.state()
    np.testing.assert_allclose(stopped.v, 0.0, atol=1e-6)
    pair.robot.brake(300, limits)
    held = pair.robot.state()
    np.testing.assert_allclose(held.q, stopped.q, atol=1e-6)
    gravity = pin.rnea(pair.model, pair.data, held.q, np.zeros(n), np.zeros(n))
    np.testing.assert_allclose(held.motor_torque, gravity, atol=1e-5)
    assert not pair.robot.monitor.violated

    tau = rng.uniform(-20.0, 20.0, n)
    raw = held.q + 0.5 * PHYSICS_DT * held.v
    expected = pin.aba(pair.model, pair.data, raw, held.v, tau)
    pair.robot.step(tau)
    a = (pair.robot.state().v - held.v) / PHYSICS_DT
    # The brake left its mark in the state, here rebuilt from q and v with rounding.
    assert relative_error(a, expected) < 1e-9
    np.testing.assert_array_equal(pair.robot.state().motor_torque, tau)


def test_reset_sets_the_state_and_ends_what_went_before(pair):
    n = pair.n
    rng = np.random.default_rng(7)
    pair.robot.step(np.ones(n))
    pair.robot.brake(3, np.ones(n))
    q, v = pair.random_state(rng)
    pair.robot.reset(q, v)
    state = pair.robot.state()
    np.testing.assert_allclose(state.q, q, atol=1e-15)
    np.testing.assert_array_equal(state.v, v)
    np.testing.assert_array_equal(state.motor_torque, np.zeros(n))
    pair.robot.step(np.zeros(n))
    expected = pin.aba(pair.model, pair.data, q + 0.5 * PHYSICS_DT * v, v, np.zeros(n))
    a = (pair.robot.state().v - v) / PHYSICS_DT
    assert relative_error(a, expected) < DYNAMICS_TOLERANCE


def test_energy_is_kept_the_better_the_shorter_the_step():
    drifts = []
    for physics_dt in (2e-3, 1e-3):
        pair = Pair(CASES["panda"], physics_dt)
        with closing(pair.robot) as robot:
            q, v = np.array([0.1, -0.5, 0.2, -2.0, 0.1, 1.5, 0.7]), np.full(7, 0.5)

            def energy(q, v, pair=pair):
                kinetic = pin.computeKineticEnergy(pair.model, pair.data, q, v)
                return kinetic + pin.computePotentialEnergy(pair.model, pair.data, q)

            robot.reset(q, v)
            start, drift = energy(q, v), 0.0
            for _ in range(round(0.5 / physics_dt / 5)):
                robot.step(np.zeros(7), 5)
                drift = max(drift, abs(energy(robot.state().q, robot.state().v) - start))
            drifts.append(drift)
    assert 0.4 < drifts[1] / drifts[0] < 0.6  # first order in the step
    assert drifts[1] < 1.0  # J, of the 29 J exchanged with gravity, at up to 10 rad/s
