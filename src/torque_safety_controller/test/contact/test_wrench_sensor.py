# SPDX-License-Identifier: Apache-2.0
"""The wrist's force/torque sensor: weight of the tool, bias, filter, and what goes wrong."""

import math
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.parts.contact.wrench_sensor import WrenchError, WrenchSensor
from viability_bounds_pkg.robot.description import inertia_beyond
from viability_bounds_pkg.robot.files import RobotDescriptionError, read_urdf
from viability_bounds_pkg.testing.ros_harness import read_config

DT = 1e-3
GRAVITY = np.array([0.0, 0.0, -9.81])
TOOL = pin.Inertia(0.7, np.array([0.01, -0.02, 0.1]), np.eye(3) * 1e-3)


def sensor(placement=None, tool=TOOL, filter_hz=1e9, **changed) -> WrenchSensor:
    placement = pin.SE3.Identity() if placement is None else placement
    return WrenchSensor(placement, tool, GRAVITY, filter_hz=filter_hz, **changed)


def step(sensor, raw=None, rotation=None) -> np.ndarray:
    if raw is not None:
        sensor.receive(raw)
    sensor.update(np.eye(3) if rotation is None else rotation, DT)
    return sensor.wrench


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_the_weight_of_the_tool_is_not_felt_in_any_orientation(seed):
    """Against the inverse dynamics of the tool alone, held at the sensor."""
    rng = np.random.default_rng(seed)
    placement, hand = pin.SE3.Random(), pin.SE3.Random()
    pushed = rng.normal(size=6) * 20.0  # environment on the tool, in the sensor's axes
    held = TOOL * pin.Motion(-(hand * placement).rotation.T @ GRAVITY, np.zeros(3))
    found = step(sensor(placement), pushed - held.vector, hand.rotation)
    np.testing.assert_allclose(found, placement.act(pin.Force(pushed)).vector, atol=1e-9)
    # Power does not depend on where a wrench is written.
    twist = pin.Motion.Random()
    at_sensor = placement.actInv(twist)
    assert pin.Force(found).dot(twist) == pytest.approx(pin.Force(pushed).dot(at_sensor), abs=1e-8)


def test_the_bias_is_what_a_tare_finds():
    rng = np.random.default_rng(0)
    here = sensor(filter_hz=30.0)
    with pytest.raises(WrenchError, match="silent"):
        here.tare()
    bias = np.array([3.0, -2.0, 1.0, 0.1, 0.2, -0.3])
    weight = np.array([*(TOOL.mass * GRAVITY), *np.cross(TOOL.lever, TOOL.mass * GRAVITY)])
    for _ in range(1500):
        step(here, weight + bias + 0.1 * rng.normal(size=6))
    assert np.abs(here.tare() - bias).max() < 0.03
    for _ in range(100):
        step(here, weight + bias)
    assert np.abs(here.wrench).max() < 0.03


def test_the_filter_has_the_time_constant_of_its_cut_off_and_silence_ends_it():
    """Measured each third step only; after a silence the filter begins anew, without a kick."""
    here = sensor(tool=pin.Inertia.Zero(), filter_hz=10.0, timeout=0.0105)
    assert here.silent
    step(here, np.zeros(6))
    constant = 1.0 / (2.0 * math.pi * 10.0)
    for _ in range(5):
        before = here.wrench
        step(here)
        step(here)
        step(here, np.full(6, 8.0))
        np.testing.assert_allclose(here.wrench - before, 3 * DT * here.rate, atol=1e-9)
    expected = 8.0 * -math.expm1(-15 * DT / constant)
    np.testing.assert_allclose(here.wrench, expected, rtol=1e-9)
    for silent in (*[False] * 10, True):
        step(here)
        assert here.silent == silent
    assert not here.wrench.any()
    np.testing.assert_allclose(step(here, np.full(6, -9.0)), -9.0)
    assert not here.silent
    assert not here.rate.any()


@pytest.mark.parametrize(
    "raw", [np.full(6, np.nan), [1, 2, 3, 4, 5, np.inf], np.zeros(5), [0, 0, 0, -1e300, 0, 0]]
)
def test_a_measurement_that_is_none_changes_nothing(raw):
    here = sensor()
    before = step(here, np.ones(6)).copy()
    with pytest.raises(WrenchError):
        here.receive(raw)
    np.testing.assert_array_equal(step(here), before)


# What hangs on the sensor, from the URDF


def links_below(root: ET.Element, link: str) -> set[str]:
    below = set()
    for joint in root.iter("joint"):
        if joint.find("parent") is not None and joint.find("parent").get("link") == link:
            child = joint.find("child").get("link")
            below |= {child} | links_below(root, child)
    return below


def test_the_tool_is_what_the_urdf_hangs_on_the_sensor():
    """Its weight, by what the joints of the whole robot carry less without it."""
    name = "wrist_left_ft_link"
    urdf = read_urdf(read_config("talos_left_arm", "controller_node")["robot_description"])
    tool = inertia_beyond(urdf, name)
    root = ET.fromstring(urdf)
    links = links_below(root, name)
    for link in root.iter("link"):
        if link.get("name") in links and link.find("inertial") is not None:
            link.remove(link.find("inertial"))
    full, without = pin.buildModelFromXML(urdf), pin.buildModelFromXML(ET.tostring(root).decode())
    q, data, frame = pin.neutral(full), full.createData(), full.getFrameId(name)
    J = pin.computeFrameJacobian(full, data, q, frame, pin.ReferenceFrame.LOCAL)
    pin.framesForwardKinematics(full, data, q)
    force = tool.mass * data.oMf[frame].rotation.T @ GRAVITY
    wrench = np.concatenate([force, np.cross(tool.lever, force)])
    less = pin.computeGeneralizedGravity(full, data, q) - pin.computeGeneralizedGravity(
        without, without.createData(), q
    )
    carrying = np.abs(J).max(axis=0) > 0.0
    np.testing.assert_allclose(less[carrying], -(J.T @ wrench)[carrying], atol=1e-9)
    assert tool.mass > 0.1
    with pytest.raises(RobotDescriptionError, match="nothing_here"):
        inertia_beyond(urdf, "nothing_here")
