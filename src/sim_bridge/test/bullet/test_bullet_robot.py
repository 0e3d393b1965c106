# SPDX-License-Identifier: Apache-2.0
from contextlib import closing
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pybullet
import pytest

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.urdf.preparation import prepare_urdf
from viability_bounds_pkg.robot_description import (
    RobotDescriptionError,
    build_model,
    read_urdf,
)

PHYSICS_DT = 1e-3  # s
DYNAMICS_TOLERANCE = 1e-11  # relative; 1e-9 is asked for, 5e-15 was measured
BAXTER = "package://example-robot-data/robots/baxter_description/urdf/baxter.urdf"
PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
LEFT_ARM = tuple(f"left_{name}" for name in ("s0", "s1", "e0", "e1", "w0", "w1", "w2"))
PANDA_ARM = tuple(f"panda_joint{i}" for i in range(1, 8))

# What PyBullet would get wrong by itself: a link without inertia between two that have it, a
# flat and a slender tensor that break the triangle inequality, oblique products of inertia,
# joint damping and friction, a mimic joint, an axis that is not of unit length.
AWKWARD = """
<robot name="awkward">
  <link name="base"/>
  <link name="one"><inertial><origin xyz="0.1 0 0.05" rpy="0.3 1.5707963267948966 -0.2"/>
    <mass value="2"/><inertia ixx="0.02" ixy="0.003" ixz="-0.002" iyy="0.03" iyz="0.001"
    izz="0.06"/></inertial></link>
  <link name="bracket"/>
  <link name="two"><inertial><origin xyz="0 0.2 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.04"/></inertial></link>
  <link name="three"><inertial><origin xyz="0.1 0.2 0"/><mass value="0.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0" iyz="0" izz="0.01"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="one"/>
    <origin xyz="0 0 1" rpy="0.1 -1.5707963267948966 0.4"/><axis xyz="1 2 3"/>
    <dynamics damping="3" friction="2"/></joint>
  <joint name="lock" type="revolute"><parent link="one"/><child link="bracket"/>
    <origin xyz="0.3 0 0" rpy="0 0 0.5"/><axis xyz="0 3 4"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="bracket"/><child link="two"/>
    <origin xyz="0 0.1 0" rpy="0.2 0 0"/><axis xyz="0 0 -2"/>
    <limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>
    <mimic joint="lock" multiplier="2"/></joint>
  <joint name="elbow" type="revolute"><parent link="two"/><child link="three"/>
    <origin xyz="0 0.4 0"/>
    <limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint>
</robot>
"""


class Case(NamedTuple):
    urdf: str
    joints: tuple[str, ...]
    locked_positions: dict[str, float]
    tip: str
    middle: str


CASES = {
    "baxter": Case(
        BAXTER,
        LEFT_ARM,
        {"right_s0": 0.3, "right_e1": 1.0, "head_pan": -0.4, "l_gripper_l_finger_joint": 0.01},
        "left_gripper",
        "left_upper_elbow_visual",
    ),
    "panda": Case(
        PANDA,
        PANDA_ARM,
        {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.03},
        "panda_hand_tcp",
        "panda_link4",
    ),
    # Joints locked in the middle of the arm: their angles turn all that follows.
    "baxter_partly_locked": Case(
        BAXTER,
        tuple(name for name in LEFT_ARM if name not in ("left_e0", "left_w1")),
        {"left_e0": 0.7, "left_w1": -1.2},
        "left_gripper",
        "left_lower_elbow",
    ),
    "awkward": Case(AWKWARD, ("shoulder", "slide", "elbow"), {"lock": 0.8}, "three", "bracket"),
}


class Pair:
    """A robot in PyBullet and the Pinocchio model that it should equal."""

    def __init__(self, case, physics_dt=PHYSICS_DT):
        self.case = case
        self.urdf = read_urdf(case.urdf) if case.urdf.startswith("package") else case.urdf
        self.robot = BulletRobot(
            self.urdf,
            case.joints,
            locked_positions=case.locked_positions,
            physics_dt=physics_dt,
        )
        self.model = build_model(self.urdf, case.joints, case.locked_positions)
        self.data = self.model.createData()
        self.n = len(case.joints)

    def random_state(self, rng):
        return rng.uniform(-2.0, 2.0, self.n), rng.uniform(-2.0, 2.0, self.n)

    def reset_raw(self, q, v):
        """Put PyBullet's own positions, half a step ahead of the state, at q."""
        self.robot.reset(q - 0.5 * self.robot.physics_dt * v, v)


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


def single_joint(kind="revolute", extra="", inertia=0.5):
    # Mass and inertia are equal in number, so that torque and force accelerate alike.
    return f"""
    <robot name="single"><link name="base"/>
      <link name="arm"><inertial><mass value="{inertia}"/>
        <inertia ixx="0.5" ixy="0" ixz="0" iyy="0.5" iyz="0" izz="{inertia}"/></inertial></link>
      <joint name="joint" type="{kind}"><parent link="base"/><child link="arm"/>
        <axis xyz="0 0 1"/>{extra}</joint></robot>"""


def single_robot(physics_dt=PHYSICS_DT, kind="revolute", **options):
    options.setdefault("gravity", (0.0, 0.0, 0.0))
    urdf = single_joint(kind, options.pop("extra", ""))
    return closing(BulletRobot(urdf, ["joint"], physics_dt=physics_dt, **options))


def relative_error(actual, expected):
    return np.abs(actual - expected).max() / np.abs(expected).max()


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


def test_wrenches_on_two_links_add_up():
    with closing(Pair(CASES["panda"]).robot) as robot:
        velocities = []
        for pushes in ((True, False), (False, True), (True, True), (False, False)):
            robot.clear_wrenches()
            robot.reset(np.full(7, 0.4), np.zeros(7))
            if pushes[0]:
                robot.apply_wrench("panda_hand_tcp", [9.0, 9.0, 9.0], [9.0, 9.0, 9.0])  # replaced
                robot.apply_wrench("panda_hand_tcp", [10.0, 0.0, 5.0], [0.0, 1.0, 0.0])
            if pushes[1]:
                robot.apply_wrench("panda_link3", [0.0, -20.0, 0.0], [0.0, 0.0, 2.0])
            robot.step(np.zeros(7))
            velocities.append(robot.state().v)
        first, second, both, neither = velocities
        np.testing.assert_allclose(both - neither, first + second - 2 * neither, atol=1e-14)
        assert np.abs(first - neither).max() > 1e-4
        assert np.abs(second - neither).max() > 1e-4


def test_wrench_is_held_in_world_axes_until_cleared():
    with single_robot() as robot:
        robot.apply_wrench("arm", [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        robot.step([0.0], 5)
        robot.step([0.0], 5)
        assert robot.state().v[0] == pytest.approx(10 * PHYSICS_DT * 1.0 / 0.5, rel=1e-12)
        robot.reset([1.0], [0.0])
        robot.step([0.0])
        assert robot.state().v[0] > 0.0  # a reset does not end the push
        robot.clear_wrenches()
        before = robot.state().v[0]
        robot.step([0.0], 5)
        assert robot.state().v[0] == before


def test_wrench_on_the_base_has_no_effect():
    with closing(Pair(CASES["baxter"]).robot) as robot:
        velocities = []
        for link in ("left_gripper", "right_gripper"):
            robot.clear_wrenches()
            robot.reset(np.zeros(7), np.zeros(7))
            robot.apply_wrench(link, [50.0, 0.0, 0.0], [0.0, 5.0, 0.0])
            robot.step(np.zeros(7))
            velocities.append(robot.state().v)
        robot.clear_wrenches()
        robot.reset(np.zeros(7), np.zeros(7))
        robot.step(np.zeros(7))
        np.testing.assert_array_equal(velocities[1], robot.state().v)
        assert np.abs(velocities[0] - velocities[1]).max() > 1e-3


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


def test_link_pose_follows_the_steps():
    with single_robot() as robot:
        robot.reset([0.2], [1.0])
        robot.step([0.0], 100)
        raw = 0.2 + (100 + 0.5) * PHYSICS_DT * 1.0
        turned = pin.log3(robot.link_pose("arm").rotation)
        np.testing.assert_allclose(turned, [0.0, 0.0, raw], atol=1e-12)


def test_gravity_torque_holds_the_arm(pair):
    q = np.full(pair.n, 0.3)
    hold = pin.rnea(pair.model, pair.data, q, np.zeros(pair.n), np.zeros(pair.n))
    pair.robot.reset(q, np.zeros(pair.n))
    pair.robot.step(hold, 200)
    np.testing.assert_allclose(pair.robot.state().q, q, atol=1e-10)
    pair.robot.reset(q, np.zeros(pair.n))
    pair.robot.step(np.zeros(pair.n), 200)
    assert np.abs(pair.robot.state().q - q).max() > 1e-2


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("substeps", [1, 3, 8])
def test_state_follows_the_constant_acceleration_map_exactly(kind, substeps):
    rng = np.random.default_rng(5)
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    with single_robot(kind=kind, extra=limit) as robot:
        x, v, dt = 0.3, -0.7, substeps * PHYSICS_DT
        robot.reset([x], [v])
        for _ in range(300):
            a = rng.uniform(-15.0, 15.0)
            robot.step([0.5 * a], substeps)
            x, v = x + dt * v + 0.5 * dt**2 * a, v + dt * a
            state = robot.state()
            assert state.q[0] == pytest.approx(x, abs=1e-12)
            assert state.v[0] == pytest.approx(v, abs=1e-12)


def test_raw_position_passes_a_bound_by_at_most_a_h2_over_8():
    h, a, q_max = 0.01, 15.0, 2.0
    overshoot = a * h**2 / 8
    with single_robot(h) as robot:
        for phase in (0.0, 0.25, 0.5, 0.75):
            # The fastest approach from which full braking keeps x at or below q_max.
            v = (10 + phase) * a * h
            robot.monitor = LimitMonitor([-np.inf], [q_max], [9.0], [99.0])
            robot.reset([q_max - v**2 / (2 * a)], [v])
            for _ in range(20):
                robot.step([-0.5 * a])
                assert robot.state().q[0] <= q_max + 1e-12
            violation = robot.monitor.max_position_violation[0]
            assert violation <= overshoot + 1e-12
            if phase == 0.5:  # the steps hit the worst state, v = a h / 2
                assert violation == pytest.approx(overshoot, abs=1e-12)


def test_monitor_sees_every_physics_step():
    with single_robot() as robot:
        robot.monitor = LimitMonitor([-1.0], [1.0], [0.0065], [1.0])
        robot.reset([0.0], [0.008])
        robot.step([-0.5], 16)  # out and back, at 1 rad/s^2
        assert robot.state().q[0] == pytest.approx(0.0, abs=1e-12)
        # The largest position is in the middle, the largest speed at the end.
        assert robot.monitor.closest_to_q_max[0] == pytest.approx(1.0 - 3.2e-5, abs=1e-12)
        assert robot.monitor.max_velocity_violation[0] == pytest.approx(0.0015, abs=1e-12)
        assert robot.monitor.max_torque_ratio[0] == 0.5
        assert robot.monitor.violated


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


def test_brake_is_as_strong_as_its_limit():
    with single_robot() as robot:
        robot.reset([0.0], [1.0])
        robot.brake(100, [2.0])  # 4 rad/s^2
        assert robot.state().v[0] == pytest.approx(1.0 - 0.1 * 4.0, abs=1e-9)
        assert robot.state().motor_torque[0] == pytest.approx(-2.0, abs=1e-9)
        before = robot.state().v[0]
        robot.brake(10, [0.0])
        assert robot.state().v[0] == before
        assert robot.state().motor_torque[0] == 0.0
        robot.brake(500, [2.0])
        assert robot.state().v[0] == pytest.approx(0.0, abs=1e-9)


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


def test_state_belongs_to_the_caller():
    with single_robot() as robot:
        robot.reset([0.5], [1.0])
        for array in robot.state():
            array.fill(9.0)
        np.testing.assert_array_equal(robot.state().v, [1.0])


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


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_there_are_no_joint_stops(kind):
    limit = '<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>'
    with single_robot(kind=kind, extra=limit) as robot:
        robot.reset([0.0], [1.0])
        robot.step([0.0], 500)
        assert robot.state().q[0] == pytest.approx(0.5, abs=1e-12)


def test_fast_joints_are_not_clipped():
    with single_robot() as robot:
        robot.reset([0.0], [500.0])
        robot.step([0.5])
        assert robot.state().v[0] == pytest.approx(500.0 + PHYSICS_DT, abs=1e-12)


def test_joints_may_come_in_any_order():
    case = CASES["panda"]
    rng = np.random.default_rng(8)
    q, v, tau = rng.uniform(-1.0, 1.0, (3, 7))
    order = rng.permutation(7)
    states = []
    for joints in (case.joints, [case.joints[i] for i in order]):
        with closing(BulletRobot(read_urdf(PANDA), joints, physics_dt=PHYSICS_DT)) as robot:
            i = order if joints is not case.joints else np.arange(7)
            robot.reset(q[i], v[i])
            robot.step(tau[i], 3)
            states.append(robot.state())
    for straight, permuted in zip(*states, strict=True):
        np.testing.assert_array_equal(permuted, straight[order])


def test_robots_do_not_share_a_world():
    with single_robot() as one, single_robot() as other:
        one.reset([0.0], [1.0])
        other.reset([0.0], [0.0])
        one.step([0.0], 10)
        np.testing.assert_array_equal(other.state().q, [0.0])
        other.step([0.0], 10)
        np.testing.assert_array_equal(other.state().q, [0.0])
        one.close()
        one.close()  # harmless
        other.step([0.0])


def test_visuals_are_kept_only_when_wanted():
    for visuals in (False, True):
        text = prepare_urdf(read_urdf(PANDA), PANDA_ARM, visuals=visuals).text
        assert text.count(".dae") == (11 if visuals else 0)


def test_visuals_move_with_the_links_they_were_fused_to():
    urdf = single_joint().replace(
        "</robot>",
        """<link name="tool"><visual><origin xyz="0 0 0.5" rpy="0 0 0.5"/>
        <geometry><box size="1 1 1"/></geometry></visual></link>
        <joint name="mount" type="fixed"><parent link="arm"/><child link="tool"/>
        <origin xyz="1 0 0" rpy="1.5707963267948966 0 0"/></joint></robot>""",
    )
    root = ElementTree.fromstring(prepare_urdf(urdf, ["joint"], visuals=True).text)
    origin = root.find("./link[@name='arm']/visual/origin")
    xyz = [float(x) for x in origin.get("xyz").split()]
    np.testing.assert_allclose(xyz, [1.0, -0.5, 0.0], atol=1e-12)
    rpy = [float(x) for x in origin.get("rpy").split()]
    expected = pin.rpy.rpyToMatrix(np.pi / 2, 0.0, 0.0) @ pin.rpy.rpyToMatrix(0.0, 0.0, 0.5)
    np.testing.assert_allclose(pin.rpy.rpyToMatrix(*rpy), expected, atol=1e-12)
    assert not list(ElementTree.fromstring(prepare_urdf(urdf, ["joint"]).text).iter("visual"))


@pytest.mark.parametrize(
    ("joints", "locked", "match"),
    [
        (["nonsense"], {}, "unknown joint 'nonsense'.*panda_joint1"),
        (PANDA_ARM, {"nonsense": 0.0}, "unknown joint 'nonsense'"),
        (["panda_joint8"], {}, "'panda_joint8' is fixed"),
        (["panda_joint1", "panda_joint1"], {}, "once each"),
        ([], {}, "once each"),
        (PANDA_ARM, {"panda_joint2": 0.1}, "both moved and locked"),
        (PANDA_ARM, {"panda_finger_joint1": np.nan}, "cannot be locked at nan"),
    ],
)
def test_bad_joints_are_refused(joints, locked, match):
    with pytest.raises(RobotDescriptionError, match=match):
        BulletRobot(read_urdf(PANDA), joints, locked_positions=locked, physics_dt=PHYSICS_DT)


@pytest.mark.parametrize(
    ("urdf", "match"),
    [
        ("<robot", "not well-formed"),
        (single_joint().replace('parent link="base"', 'parent link="bas"'), "no parent link"),
        (single_joint().replace("</robot>", '<link name="lost"/></robot>'), "one tree"),
        (single_joint().replace('xyz="0 0 1"', 'xyz="0 0 0"'), "without a direction"),
        (single_joint().replace('xyz="0 0 1"', 'xyz="0 1"'), "3 finite number"),
        (single_joint().replace('value="0.5"', 'value="heavy"'), "1 finite number"),
        (single_joint().replace('ixx="0.5"', 'ixx="-0.5"'), "link 'arm'.*positive"),
    ],
)
def test_bad_urdfs_are_refused(urdf, match):
    with pytest.raises(RobotDescriptionError, match=match):
        BulletRobot(urdf, ["joint"], physics_dt=PHYSICS_DT)


def test_missing_mesh_is_refused_only_when_visuals_are_wanted():
    mesh = '<visual><geometry><mesh filename="package://no/such.stl"/></geometry></visual></link>'
    urdf = single_joint().replace("</link>", mesh)
    prepare_urdf(urdf, ["joint"])
    with pytest.raises(RobotDescriptionError, match=r"such\.stl"):
        prepare_urdf(urdf, ["joint"], visuals=True)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="physics_dt"):
        BulletRobot(single_joint(), ["joint"], physics_dt=0.0)
    with pytest.raises(ValueError, match="gravity"):
        BulletRobot(single_joint(), ["joint"], physics_dt=PHYSICS_DT, gravity=(0.0, 9.81))
    with single_robot() as robot:
        for call, match in (
            (lambda: robot.step([0.0, 0.0]), "tau"),
            (lambda: robot.step([np.nan]), "tau"),
            (lambda: robot.step([0.0], 0), "substeps"),
            (lambda: robot.brake(1, [-1.0]), "torque_limits"),
            (lambda: robot.reset([0.0], [0.0, 0.0]), "v must"),
            (lambda: robot.reset([np.inf], [0.0]), "q must"),
            (lambda: robot.apply_wrench("arm", [0.0], [0.0] * 3), "force"),
            (lambda: robot.apply_wrench("arm", [0.0] * 3, [np.inf] * 3), "torque"),
        ):
            with pytest.raises(ValueError, match=match):
                call()
        for call in (
            lambda: robot.link_pose("hand"),
            lambda: robot.apply_wrench("hand", [0.0] * 3, [0.0] * 3),
        ):
            with pytest.raises(RobotDescriptionError, match="unknown link 'hand'.*base, arm"):
                call()
