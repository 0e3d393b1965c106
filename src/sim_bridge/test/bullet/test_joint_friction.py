# SPDX-License-Identifier: Apache-2.0
"""Joint friction and rotors against their equations for, and in contact with the world."""

from contextlib import closing
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pybullet
import pytest

from sim_bridge.bullet.joint_friction import JointFriction
from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.robot_description import (
    RobotDescriptionError,
    build_model,
    read_urdf,
)

H = 1e-3  # s
TALOS = "package://example-robot-data/robots/talos_data/robots/talos_full_v2.urdf"
JOINTS = ("torso_1_joint", "torso_2_joint", *(f"arm_left_{i}_joint" for i in range(1, 8)))
N = len(JOINTS)
TAU_MAX = np.array([200.0, 200.0, 100.0, 100.0, 70.0, 70.0, 20.0, 8.0, 8.0])
ROTORS = np.array([0.5, 0.5, 0.2, 0.2, 0.1, 0.1, 0.08, 0.05, 0.05])
Q = np.array([0.1, 0.1, -0.3, 0.4, 0.3, -1.4, 0.2, -0.3, 0.1])

INERTIA, ROTOR = 0.5, 2.0  # kg m^2, of the single joint


def single_joint(gravity=(0.0, 0.0, 0.0), physics_dt=H, **options):
    """A link that turns about a vertical axis, without gravity, with a ball 1 m out."""
    urdf = f"""
    <robot name="single"><link name="base"/>
      <link name="arm"><inertial><mass value="0.5"/>
        <inertia ixx="0.5" ixy="0" ixz="0" iyy="{INERTIA}" iyz="0" izz="{INERTIA}"/></inertial>
        <collision><origin xyz="1 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
      </link>
      <joint name="joint" type="revolute"><parent link="base"/><child link="arm"/>
        <axis xyz="{options.pop("axis", "0 0 1")}"/></joint></robot>"""
    return closing(
        BulletRobot(
            urdf,
            ["joint"],
            physics_dt=physics_dt,
            gravity=gravity,
            joint_friction=JointFriction(1, **options),
        )
    )


def talos(scales=None, gravity=(0.0, 0.0, -9.81), **options):
    joint_friction = JointFriction(N, **options)
    return closing(
        BulletRobot(
            read_urdf(TALOS),
            JOINTS,
            physics_dt=H,
            gravity=gravity,
            joint_friction=joint_friction,
            mass_scales=scales,
        )
    )


FRICTION = {
    "friction_coulomb": 0.1 * TAU_MAX,
    "friction_static": 0.15 * TAU_MAX,
    "friction_viscous": 0.02 * TAU_MAX,
    "stribeck_velocity": np.linspace(0.01, 0.05, N),
}


@pytest.fixture(scope="module")
def model():
    return build_model(read_urdf(TALOS), JOINTS, rotor_inertia=ROTORS)


def reset_raw(robot, q, v):
    """Put PyBullet's own positions, half a step ahead of the state, at q."""
    robot.reset(q - 0.5 * robot.physics_dt * v, v)


def test_rotors_are_on_the_diagonal_of_the_inertia_matrix(model):
    rng = np.random.default_rng(1)
    data = model.createData()
    with talos(rotor_inertia=ROTORS) as robot:
        for _ in range(20):
            q, v, tau = rng.uniform(-1.0, 1.0, (3, N)) * np.array([[1.5], [3.0], [50.0]])
            reset_raw(robot, q, v)
            robot.step(tau)
            a = (robot.state().v - v) / H
            expected = pin.aba(model, data, q, v, tau)
            np.testing.assert_allclose(a, expected, atol=1e-11 * np.abs(expected).max())


def test_rotors_of_prismatic_joints_and_of_some_joints_only():
    urdf = """<robot name="two"><link name="base"/>
      <link name="one"><inertial><origin xyz="0.2 0.1 0"/><mass value="2"/>
        <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial></link>
      <link name="two"><inertial><origin xyz="0 0.1 0.3"/><mass value="1"/>
        <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
      <joint name="turn" type="continuous"><parent link="base"/><child link="one"/>
        <axis xyz="0 1 1"/></joint>
      <joint name="slide" type="prismatic"><parent link="one"/><child link="two"/>
        <axis xyz="1 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
    for rotors in ([0.0, 3.0], [0.7, 0.0], [0.7, 3.0]):
        model = build_model(urdf, ["turn", "slide"], rotor_inertia=rotors)
        joint_friction = JointFriction(2, rotor_inertia=rotors)
        with closing(
            BulletRobot(urdf, ["turn", "slide"], physics_dt=H, joint_friction=joint_friction)
        ) as robot:
            q, v, tau = np.array([0.3, 0.2]), np.array([1.0, -0.5]), np.array([2.0, 9.0])
            reset_raw(robot, q, v)
            robot.step(tau)
            a = pin.aba(model, model.createData(), q, v, tau)
            np.testing.assert_allclose((robot.state().v - v) / H, a, rtol=1e-10)


def test_a_step_solves_the_equations_of_motion_with_friction_exactly(model):
    """Optimality: the only v+ whose impulse is in the box, and at its bound where v+ is not 0."""
    rng = np.random.default_rng(2)
    data = model.createData()
    stuck = moving = 0
    bias = 0.02 * TAU_MAX * np.linspace(-1.0, 1.0, N)
    with talos(rotor_inertia=ROTORS, torque_bias=bias, **FRICTION) as robot:
        for _ in range(100):
            q = rng.uniform(-1.0, 1.0, N)
            v = rng.uniform(-0.2, 0.2, N) * (rng.random(N) < 0.5)
            h = pin.nonLinearEffects(model, data, q, v)
            tau = h + rng.uniform(-0.3, 0.3, N) * TAU_MAX
            reset_raw(robot, q, v)
            robot.step(tau)
            end = robot.state().v
            M = pin.crba(model, data, q)
            viscous = FRICTION["friction_viscous"] * end
            impulse = M @ (end - v) + H * (h - tau - bias + viscous)
            excess = FRICTION["friction_static"] - FRICTION["friction_coulomb"]
            curve = np.exp(-((v / FRICTION["stribeck_velocity"]) ** 2))
            limit = H * (FRICTION["friction_coulomb"] + excess * curve)
            sticks = np.abs(end) < 1e-12
            tolerance = 1e-10 * H * TAU_MAX
            assert (np.abs(impulse) <= limit + tolerance).all()
            slides = -np.sign(end) * limit
            np.testing.assert_array_less(np.abs(impulse - slides)[~sticks], tolerance[~sticks])
            stuck, moving = stuck + sticks.sum(), moving + (~sticks).sum()
            np.testing.assert_array_equal(robot.state().motor_torque, tau)  # without the bias
    assert min(stuck, moving) > 200  # both matter


def test_at_rest_under_half_its_stiction_nothing_creeps(model):
    rng = np.random.default_rng(3)
    with talos(rotor_inertia=ROTORS, **FRICTION) as robot:
        robot.reset(Q, np.zeros(N))
        hold = pin.computeGeneralizedGravity(model, model.createData(), Q)
        load = 0.5 * FRICTION["friction_static"] * rng.choice([-1.0, 1.0], N)
        robot.step(hold + load, 15_000)  # 15 s
        state = robot.state()
        np.testing.assert_allclose(state.q, Q, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(state.v, 0.0, atol=1e-12)


@pytest.mark.parametrize("rotor", [0.0, ROTOR])
def test_it_breaks_loose_above_its_stiction_only(rotor):
    inertia = INERTIA + rotor
    with single_joint(
        friction_coulomb=1.0, friction_static=3.0, stribeck_velocity=0.01, rotor_inertia=rotor
    ) as robot:
        robot.reset([0.0], [0.0])
        robot.step([2.999], 1000)
        assert robot.state().q[0] == 0.0
        robot.step([3.001], 1000)
        assert robot.state().v[0] > 0.1
        robot.step([2.0], 1000)  # less than the stiction, more than it takes now
        v = robot.state().v[0]
        robot.step([2.0], 100)
        a = (robot.state().v[0] - v) / (100 * H)
        assert a == pytest.approx((2.0 - 1.0) / inertia, rel=1e-9)


def test_friction_at_speed_follows_stribecks_curve():
    with single_joint(
        friction_coulomb=1.0, friction_static=3.0, friction_viscous=0.4, stribeck_velocity=0.05
    ) as robot:
        for v in (0.02, 0.05, 0.1, 0.7, -0.05, -0.3):
            robot.reset([0.0], [v])
            robot.step([0.0])
            end = robot.state().v[0]
            dry = np.sign(v) * (1.0 + 2.0 * np.exp(-((v / 0.05) ** 2)))
            assert INERTIA * (end - v) / H == pytest.approx(-dry - 0.4 * end, rel=1e-9)


@pytest.mark.parametrize("rotor", [0.0, ROTOR])
def test_coulomb_and_viscous_friction_stop_a_joint_as_the_analytic_solution(rotor):
    """I v' = -F - d v: v = (v0 + F/d) exp(-t d/I) - F/d until it is zero, for good."""
    inertia, F, d, v0 = INERTIA + rotor, 0.8, 0.6, 2.0
    stop = inertia / d * np.log1p(v0 * d / F)
    # Its integral: what is left of the momentum when it stops, F stop, did not go into d q.
    distance = (inertia * v0 - F * stop) / d
    errors = []
    for physics_dt in (2e-3, 1e-3, 5e-4):
        with single_joint(
            physics_dt=physics_dt, friction_coulomb=F, friction_viscous=d, rotor_inertia=rotor
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
            assert robot.state().q[0] == pytest.approx(distance, abs=2.0 * v0 * physics_dt)
            rest = robot.state().q[0]
            robot.step([0.0], 1000)
            assert robot.state().q[0] == pytest.approx(rest, abs=1e-12)
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.05)  # first order in the step
    assert errors[2] / errors[1] == pytest.approx(0.5, abs=0.05)
    assert errors[2] < 3e-4 * v0


def test_viscous_friction_is_stable_for_any_coefficient():
    for d in (1.0, 1e3, 1e6):  # explicit, the joint would explode beyond 2 I / h = 1e3
        with single_joint(friction_viscous=d) as robot:
            robot.reset([0.0], [1.0])
            robot.step([0.0], 3)
            expected = (1.0 + H * d / INERTIA) ** -3
            assert robot.state().v[0] == pytest.approx(expected, rel=1e-9)


def test_motion_against_friction_by_an_independent_integration(model):
    """All joints slide one way: the dynamics are smooth, and Runge and Kutta's method applies."""
    data = model.createData()
    start, v0 = 0.3 * Q, np.array([0.5, 0.3, -0.6, 0.8, 1.0, -1.0, 1.2, -0.9, 0.9])
    coulomb, viscous = 0.1 * TAU_MAX, 0.02 * TAU_MAX

    def torque(t):
        return pin.computeGeneralizedGravity(model, data, start) + np.sign(v0) * TAU_MAX * (
            0.15 + 0.05 * np.sin(20.0 * t)
        )

    def rate(t, y):
        v = y[N:]
        friction = coulomb * np.sign(v0) + viscous * v
        return np.concatenate([v, pin.aba(model, data, y[:N], v, torque(t) - friction)])

    duration, y, t, dt = 0.2, np.concatenate([start, v0]), 0.0, 2e-3
    for _ in range(round(duration / dt)):
        k1 = rate(t, y)
        k2 = rate(t + dt / 2, y + dt / 2 * k1)
        k3 = rate(t + dt / 2, y + dt / 2 * k2)
        k4 = rate(t + dt, y + dt * k3)
        y, t = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), t + dt
        assert (y[N:] * v0 > 0.0).all()  # none stopped or turned

    errors = []
    for physics_dt in (1e-3, 5e-4):
        joint_friction = JointFriction(
            N, friction_coulomb=coulomb, friction_viscous=viscous, rotor_inertia=ROTORS
        )
        with closing(
            BulletRobot(
                read_urdf(TALOS), JOINTS, physics_dt=physics_dt, joint_friction=joint_friction
            )
        ) as robot:
            robot.reset(start, v0)
            for k in range(round(duration / physics_dt)):
                robot.step(torque((k + 0.5) * physics_dt))
            state = robot.state()
        errors.append(np.abs(np.concatenate([state.q, state.v]) - y).max())
    assert errors[0] < 0.02 * np.abs(y[N:] - v0).max()
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.1)  # first order in the step


def test_energy_only_decreases(model):
    data = model.createData()
    with talos(gravity=(0.0, 0.0, 0.0), rotor_inertia=ROTORS, **FRICTION) as robot:
        rng = np.random.default_rng(4)
        for _ in range(3):
            v = rng.uniform(-2.0, 2.0, N)
            reset_raw(robot, Q, v)
            energy, start = np.inf, pin.computeKineticEnergy(model, data, Q, v)
            while energy > 0.0:
                last, energy = energy, pin.computeKineticEnergy(model, data, robot._q, robot._v)
                assert energy <= last
                robot.step(np.zeros(N))
                if np.abs(robot._v).max() < 1e-12:
                    break
            assert energy < 1e-3 * start


def test_the_motor_torque_is_reported_and_the_bias_acts():
    with single_joint(torque_bias=-0.3) as robot:
        robot.reset([0.0], [0.0])
        robot.step([1.0], 10)
        assert robot.state().motor_torque[0] == 1.0
        assert robot.state().v[0] == pytest.approx(10 * H * 0.7 / INERTIA, rel=1e-12)


def test_heavier_links_move_as_if_the_urdf_said_so():
    scales = {"arm_left_4_link": 1.1, "torso_2_link": 0.8, "arm_right_3_link": 3.0}
    rng = np.random.default_rng(5)
    urdf = read_urdf(TALOS)
    model = build_model(urdf, JOINTS)
    root = ElementTree.fromstring(urdf)
    for link, scale in scales.items():
        inertial = root.find(f"./link[@name='{link}']/inertial")
        for element in (inertial.find("mass"), inertial.find("inertia")):
            for key, value in element.attrib.items():
                element.set(key, repr(scale * float(value)))
    heavy = build_model(ElementTree.tostring(root, encoding="unicode"), JOINTS)
    data = heavy.createData()
    with talos(scales=scales) as robot:
        for _ in range(5):
            q, v, tau = rng.uniform(-1.0, 1.0, (3, N)) * np.array([[1.0], [2.0], [30.0]])
            reset_raw(robot, q, v)
            robot.step(tau)
            a, expected = (robot.state().v - v) / H, pin.aba(heavy, data, q, v, tau)
            np.testing.assert_allclose(a, expected, atol=1e-10 * np.abs(expected).max())
            nominal = pin.aba(model, model.createData(), q, v, tau)
            assert np.abs(nominal - expected).max() > 1e-2


def test_pushes_are_felt_through_rotors_and_friction(model):
    data = model.createData()
    with talos(rotor_inertia=ROTORS) as robot:
        reset_raw(robot, Q, np.zeros(N))
        wrench = np.array([30.0, -20.0, 10.0, 1.0, 2.0, -3.0])
        robot.apply_wrench("wrist_left_ft_link", wrench[:3], wrench[3:])
        robot.step(np.zeros(N))
        frame = model.getFrameId("wrist_left_ft_link")
        J = pin.computeFrameJacobian(model, data, Q, frame, pin.LOCAL_WORLD_ALIGNED)
        expected = pin.aba(model, data, Q, np.zeros(N), J.T @ wrench)
        np.testing.assert_allclose(robot.state().v / H, expected, rtol=1e-9)


def test_brakes_add_to_the_friction_and_hold(model):
    with single_joint(
        friction_coulomb=0.5, friction_viscous=0.2, torque_bias=9.0, rotor_inertia=ROTOR
    ) as robot:
        robot.reset([0.0], [1.0])
        robot.brake(1, [2.0])
        v = (1.0 - H * 2.5 / (INERTIA + ROTOR)) / (1.0 + H * 0.2 / (INERTIA + ROTOR))
        assert robot.state().v[0] == pytest.approx(v, rel=1e-12)
        assert robot.state().motor_torque[0] == pytest.approx(-2.0, rel=1e-12)
        robot.brake(2000, [2.0])
        assert robot.state().v[0] == pytest.approx(0.0, abs=1e-15)
        robot.step([-9.0])  # off again: what is left is the friction
        assert robot.state().v[0] == pytest.approx(0.0, abs=1e-15)
    with talos(rotor_inertia=ROTORS, **FRICTION) as robot:
        robot.reset(Q, np.full(N, 0.5))
        robot.brake(1000, TAU_MAX)
        state = robot.state()
        np.testing.assert_allclose(state.v, 0.0, atol=1e-12)
        hold = pin.computeGeneralizedGravity(model, model.createData(), state.q)
        np.testing.assert_allclose(state.motor_torque, hold, atol=1e-8)


@pytest.mark.parametrize("reach", [0.09, 0.2])
def test_an_impact_meets_the_rotor(reach):
    """Angular momentum about the axis, rotor included, is what ball and arm share."""
    with single_joint(rotor_inertia=ROTOR) as robot:
        world = {"physicsClientId": robot.client_id}
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1, **world)
        place = [1.0, 0.19 + reach / 100.0, 0.0]
        ball = pybullet.createMultiBody(1.0, shape, basePosition=place, **world)
        pybullet.changeDynamics(ball, -1, linearDamping=0.0, angularDamping=0.0, **world)
        pybullet.changeDynamics(ball, -1, lateralFriction=0.0, restitution=0.0, **world)
        robot.reset([0.0], [1.0])
        for _ in range(30):
            robot.step([0.0])
        v = robot.state().v[0]
        (x, y, _), _ = pybullet.getBasePositionAndOrientation(ball, **world)
        (vx, vy, _), _ = pybullet.getBaseVelocity(ball, **world)
        assert vy > 0.5
        momentum = (INERTIA + ROTOR) * v + 1.0 * (x * vy - y * vx)
        assert momentum == pytest.approx(INERTIA + ROTOR, rel=1e-3)
        assert v < 0.9


def test_stiction_bears_what_lies_on_the_arm():
    """A box of 2 kg comes to lie 1 m out on an arm that turns about a horizontal axis."""
    for stiction, holds in ((25.0, True), (15.0, False)):
        with single_joint(
            axis="0 1 0",
            gravity=(0.0, 0.0, -9.81),
            friction_coulomb=stiction,
            rotor_inertia=ROTOR,
        ) as robot:
            world = {"physicsClientId": robot.client_id}
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=[0.05] * 3, **world
            )
            pybullet.createMultiBody(2.0, shape, basePosition=[1.0, 0.0, 0.1501], **world)
            robot.reset([0.0], [0.0])
            robot.step([0.0], 300)
            if holds:  # apart from the small knock when it comes to lie
                assert robot.state().q[0] == pytest.approx(0.0, abs=1e-3)
                assert robot.state().v[0] == pytest.approx(0.0, abs=1e-6)
            else:
                assert robot.state().q[0] > 1e-2


def test_friction_of_zero_changes_nothing():
    states = []
    for joint_friction in (None, JointFriction(N), JointFriction(N, stribeck_velocity=2.0)):
        with closing(
            BulletRobot(read_urdf(TALOS), JOINTS, physics_dt=H, joint_friction=joint_friction)
        ) as robot:
            robot.reset(Q, np.full(N, 0.3))
            robot.step(np.ones(N), 50)
            robot.brake(20, TAU_MAX)
            states.append(robot.state())
    for state in states[1:]:
        np.testing.assert_array_equal(np.stack(state), np.stack(states[0]))


def test_the_solver_is_chosen_in_silence(capfd):
    with single_joint(friction_coulomb=1.0):
        pass
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"friction_coulomb": -1.0}, "friction_coulomb"),
        ({"friction_coulomb": [1.0] * 3}, "friction_coulomb must be 2"),
        ({"friction_coulomb": 2.0, "friction_static": 1.0}, "friction_static"),
        ({"friction_viscous": np.nan}, "friction_viscous"),
        ({"stribeck_velocity": 0.0}, "stribeck_velocity"),
        ({"torque_bias": [np.inf, 0.0]}, "torque_bias"),
        ({"rotor_inertia": [0.1, -0.1]}, "rotor_inertia"),
    ],
)
def test_invalid_friction_is_refused(options, match):
    with pytest.raises(ValueError, match=match):
        JointFriction(2, **options)


def test_robots_that_cannot_be_are_refused():
    urdf = read_urdf(TALOS)
    with pytest.raises(ValueError, match="that of 3 joints, not of 9"):
        BulletRobot(urdf, JOINTS, physics_dt=H, joint_friction=JointFriction(3))
    for scales, match in (
        ({"wing": 1.1}, "unknown link 'wing'.*torso_2_link"),
        ({"torso_2_link": 0.0}, "'torso_2_link' cannot be scaled by 0"),
        ({"torso_2_link": np.nan}, "cannot be scaled by nan"),
    ):
        with pytest.raises(RobotDescriptionError, match=match):
            BulletRobot(urdf, JOINTS, physics_dt=H, mass_scales=scales)
