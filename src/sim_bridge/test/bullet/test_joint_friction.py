# SPDX-License-Identifier: Apache-2.0
"""Joint friction and rotors against their equations."""

import numpy as np
import pinocchio as pin
import pytest
from simulated_robots import H, configured, single_joint

from viability_bounds_pkg.testing.ros_harness import read_config

INERTIA, ROTOR = 0.5, 2.0  # kg m^2, of the single joint
TALOS = {
    key: np.array(value)
    for key, value in read_config("talos_left_arm", "bullet_node").items()
    if isinstance(value, list) and isinstance(value[0], float)
}
TAU_MAX, STICTION = TALOS["torque_max"], TALOS["friction_static"]
N = len(TAU_MAX)


def test_a_step_solves_the_equations_of_motion_with_friction_exactly():
    """Optimality: the only v+ whose impulse is in the box, and at its bound where v+ is not 0."""
    rng = np.random.default_rng(2)
    coulomb, excess = TALOS["friction_coulomb"], STICTION - TALOS["friction_coulomb"]
    stuck = moving = 0
    with configured("talos_left_arm") as pair:
        for _ in range(60):
            q = rng.uniform(-1.0, 1.0, N)
            v = rng.uniform(-0.2, 0.2, N) * (rng.random(N) < 0.5)
            h = pin.nonLinearEffects(pair.model, pair.data, q, v)
            tau = h + rng.uniform(-0.3, 0.3, N) * TAU_MAX
            pair.step(q, v, tau)
            end = pair.robot.state().v
            M = pin.crba(pair.model, pair.data, q)
            impulse = M @ (end - v) + H * (h - tau + TALOS["friction_viscous"] * end)
            limit = H * (coulomb + excess * np.exp(-((v / TALOS["stribeck_velocity"]) ** 2)))
            sticks = np.abs(end) < 1e-12
            tolerance = 1e-10 * H * TAU_MAX
            assert (np.abs(impulse) <= limit + tolerance).all()
            slides = -np.sign(end) * limit
            np.testing.assert_array_less(np.abs(impulse - slides)[~sticks], tolerance[~sticks])
            stuck, moving = stuck + sticks.sum(), moving + (~sticks).sum()
            np.testing.assert_array_equal(pair.robot.state().motor_torque, tau)
    assert min(stuck, moving) > 100  # both matter


def test_at_rest_under_half_its_stiction_nothing_creeps():
    load = 0.5 * STICTION * np.random.default_rng(3).choice([-1.0, 1.0], N)
    q = TALOS["start_positions"]
    with configured("talos_left_arm") as pair:
        pair.robot.reset(q, np.zeros(N))
        pair.robot.step(pair.gravity() + load, 1000)
        np.testing.assert_allclose(pair.robot.state().q, q, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(pair.robot.state().v, 0.0, atol=1e-12)


@pytest.mark.parametrize("rotor", [0.0, ROTOR])
def test_it_breaks_loose_above_its_stiction_only(rotor):
    with single_joint(
        friction_coulomb=1.0, friction_static=3.0, stribeck_velocity=0.01, rotor_inertia=rotor
    ) as robot:
        robot.reset([0.0], [0.0])
        robot.step([2.999], 500)
        assert robot.state().q[0] == 0.0
        robot.step([3.001], 1000)
        assert robot.state().v[0] > 0.1
        v = robot.state().v[0]
        robot.step([2.0], 100)  # less than the stiction, more than it takes now
        a = (robot.state().v[0] - v) / (100 * H)
        assert a == pytest.approx((2.0 - 1.0) / (INERTIA + rotor), rel=1e-9)


def test_coulomb_and_viscous_friction_stop_a_joint_as_the_analytic_solution():
    """I v' = -F - d v: v = (v0 + F/d) exp(-t d/I) - F/d until it is zero, for good."""
    inertia, F, d, v0 = INERTIA + ROTOR, 0.8, 0.6, 2.0
    stop = inertia / d * np.log1p(v0 * d / F)
    # Its integral: what is left of the momentum when it stops, F stop, did not go into d q.
    distance = (inertia * v0 - F * stop) / d
    errors = []
    for physics_dt in (2e-3, 1e-3):
        with single_joint(
            physics_dt=physics_dt, friction_coulomb=F, friction_viscous=d, rotor_inertia=ROTOR
        ) as robot:
            robot.reset([0.0], [v0])
            half = round(0.5 * stop / physics_dt)
            robot.step([0.0], half)
            expected = (v0 + F / d) * np.exp(-half * physics_dt * d / inertia) - F / d
            errors.append(abs(robot.state().v[0] - expected))
            last = v0
            for _ in range(half, round(stop / physics_dt) + 3):
                robot.step([0.0])
                v = robot.state().v[0]
                assert -1e-15 < v < max(last, 1e-15)
                last = v
            assert last < 1e-15
            rest = robot.state().q[0]
            assert rest == pytest.approx(distance, abs=2.0 * v0 * physics_dt)
            robot.step([0.0], 500)
            assert robot.state().q[0] == pytest.approx(rest, abs=1e-12)
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.05)  # first order in the step
    assert errors[1] < 6e-4 * v0


def test_viscous_friction_is_stable_for_any_coefficient():
    for d in (1.0, 1e3, 1e6):  # explicit, the joint would explode beyond 2 I / h = 1e3
        with single_joint(friction_viscous=d) as robot:
            robot.reset([0.0], [1.0])
            robot.step([0.0], 3)
            expected = (1.0 + H * d / INERTIA) ** -3
            assert robot.state().v[0] == pytest.approx(expected, rel=1e-9)


def test_brakes_add_to_the_friction():
    with single_joint(friction_coulomb=0.5, friction_viscous=0.2, rotor_inertia=ROTOR) as robot:
        robot.reset([0.0], [1.0])
        robot.brake(1, [2.0])
        v = (1.0 - H * 2.5 / (INERTIA + ROTOR)) / (1.0 + H * 0.2 / (INERTIA + ROTOR))
        assert robot.state().v[0] == pytest.approx(v, rel=1e-12)
        assert robot.state().motor_torque[0] == pytest.approx(-2.0, rel=1e-12)
        robot.brake(1500, [2.0])
        robot.step([0.4])  # off again: what is left is the friction
        assert robot.state().v[0] == pytest.approx(0.0, abs=1e-15)


def test_the_solver_is_chosen_in_silence(capfd):
    with single_joint(friction_coulomb=1.0):
        pass
    assert capfd.readouterr() == ("", "")
