# SPDX-License-Identifier: Apache-2.0
"""A robot in PyBullet moves as Pinocchio's equations say."""

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from simulated_robots import AWKWARD, H, Pair, configured

from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf

TOLERANCE = 1e-11  # relative; 5e-15 was measured, with rotors 1e-13
BAXTER = "package://example-robot-data/robots/baxter_description/urdf/baxter.urdf"


def baxter():
    """Joints locked in the middle of the arm: their angles turn all that follows."""
    locked = {"left_e0": 0.7, "left_w1": -1.2, "right_s0": 0.3, "l_gripper_l_finger_joint": 0.01}
    joints = [f"left_{name}" for name in ("s0", "s1", "e1", "w0", "w2")]
    return Pair(read_urdf(BAXTER), joints, locked)


def awkward(rotors=0.0):
    return Pair(AWKWARD, ("shoulder", "slide", "elbow"), {"lock": 0.8}, rotors)


CASES = {
    "baxter": (baxter, "left_gripper", "left_lower_elbow"),
    "awkward": (awkward, "three", "bracket"),
    "awkward with rotors": (lambda: awkward([0.7, 3.0, 0.0]), "three", "bracket"),
    "talos": (
        lambda: configured("talos_left_arm", friction=0.0),
        "wrist_left_ft_link",
        "arm_left_4_link",
    ),
}


@pytest.fixture(scope="module", params=CASES)
def pair(request):
    make, tip, middle = CASES[request.param]
    with make() as made:
        made.links = tip, middle
        yield made


def random_states(pair, count, seed):
    """Yield q, v and tau."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(-1.0, 1.0, (3, pair.n)) * [[2.0], [2.0], [50.0]]


def assert_equal(a, expected, tolerance=TOLERANCE):
    np.testing.assert_allclose(a, expected, rtol=0.0, atol=tolerance * np.abs(expected).max())


def test_a_step_accelerates_as_pinocchio(pair):
    for q, v, tau in random_states(pair, 20, seed=2):
        assert_equal(pair.step(q, v, tau), pair.acceleration(q, v, tau))
        np.testing.assert_array_equal(pair.robot.state().motor_torque, tau)


def test_wrenches_on_links_act_through_their_jacobians(pair):
    rng = np.random.default_rng(3)
    for q, v, tau in random_states(pair, 5, seed=4):
        loaded = tau.copy()
        for link in pair.links:
            force, torque = rng.uniform(-30.0, 30.0, (2, 3))
            pair.robot.apply_wrench(link, 9.0 * torque, force)  # the next one replaces it
            pair.robot.apply_wrench(link, force, torque)
            loaded += pair.torque_of(q, link, force, torque)
        assert_equal(pair.step(q, v, tau), pair.acceleration(q, v, loaded))
        pair.robot.clear_wrenches()
        assert_equal(pair.step(q, v, tau), pair.acceleration(q, v, tau))


def test_link_poses_equal_pinocchio(pair):
    links = [link.get("name") for link in ElementTree.fromstring(pair.urdf).findall("link")]
    for q, v, _ in random_states(pair, 2, seed=4):
        pair.robot.reset(q - 0.5 * H * v, v)
        pin.framesForwardKinematics(pair.model, pair.data, q)
        for link in links:
            expected = pair.data.oMf[pair.model.getFrameId(link)]
            pose = pair.robot.link_pose(link)
            np.testing.assert_allclose(pose.homogeneous, expected.homogeneous, atol=1e-12)


def test_brakes_stop_the_arm_hold_it_and_let_go(pair):
    rng, limits = np.random.default_rng(6), np.full(pair.n, 300.0)
    pair.robot.reset(np.full(pair.n, 0.3), rng.uniform(-2.0, 2.0, pair.n))
    pair.robot.brake(300, limits)
    stopped = pair.robot.state()
    np.testing.assert_allclose(stopped.v, 0.0, atol=1e-6)

    pair.robot.brake(300, limits)
    held = pair.robot.state()
    np.testing.assert_allclose(held.q, stopped.q, atol=1e-6)
    np.testing.assert_allclose(held.motor_torque, pair.gravity(), atol=1e-5)

    tau = rng.uniform(-20.0, 20.0, pair.n)
    pair.robot.step(tau)
    expected = pair.acceleration(held.q + 0.5 * H * held.v, held.v, tau)
    # The brake left its mark in the state, here rebuilt from q and v with rounding.
    assert_equal((pair.robot.state().v - held.v) / H, expected, 1e-9)


def test_heavier_links_move_as_if_the_urdf_said_so():
    scales = {"arm_left_4_link": 1.1, "torso_2_link": 0.8, "arm_right_3_link": 3.0}
    with configured("talos_left_arm", friction=0.0, mass_scales=scales) as pair:
        root = ElementTree.fromstring(pair.urdf)
        for link, scale in scales.items():
            inertial = root.find(f"./link[@name='{link}']/inertial")
            for element in (inertial.find("mass"), inertial.find("inertia")):
                for key, value in element.attrib.items():
                    element.set(key, repr(scale * float(value)))
        urdf = ElementTree.tostring(root, encoding="unicode")
        _, joints, locked = pair.robot.description
        heavy = build_model(urdf, joints, locked, pair.model.armature)
        for q, v, tau in random_states(pair, 5, seed=5):
            expected = pin.aba(heavy, heavy.createData(), q, v, tau)
            assert_equal(pair.step(q, v, tau), expected, 1e-10)
            assert np.abs(pair.acceleration(q, v, tau) - expected).max() > 1e-2


def test_energy_is_kept_the_better_the_shorter_the_step():
    drifts = []
    for physics_dt in (2e-3, 1e-3):
        with configured("panda", physics_dt=physics_dt) as pair:

            def energy(pair=pair):
                q, v, _ = pair.robot.state()
                kinetic = pin.computeKineticEnergy(pair.model, pair.data, q, v)
                return kinetic + pin.computePotentialEnergy(pair.model, pair.data, q)

            pair.robot.reset([0.1, -0.5, 0.2, -2.0, 0.1, 1.5, 0.7], np.full(7, 0.5))
            start, drift = energy(), 0.0
            for _ in range(round(0.5 / physics_dt / 5)):
                pair.robot.step(np.zeros(7), 5)
                drift = max(drift, abs(energy() - start))
            drifts.append(drift)
    assert 0.4 < drifts[1] / drifts[0] < 0.6  # first order in the step
    assert drifts[1] < 1.0  # J, of the 29 J exchanged with gravity, at up to 10 rad/s
