# SPDX-License-Identifier: Apache-2.0
import math
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.parts.contact.wrench_sensor import (
    WrenchError,
    WrenchSensor,
)
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    inertia_beyond,
    read_urdf,
)
from viability_bounds_pkg.testing.ros_harness import read_config

DT = 1e-3
GRAVITY = np.array([0.0, 0.0, -9.81])
TOOL = pin.Inertia(0.7, np.array([0.01, -0.02, 0.1]), np.eye(3) * 1e-3)
UNFILTERED = {"filter_hz": 1e9}


def sensor(placement=None, tool=TOOL, **changed) -> WrenchSensor:
    return WrenchSensor(
        pin.SE3.Identity() if placement is None else placement,
        tool,
        GRAVITY,
        **UNFILTERED | changed,
    )


def step(sensor, raw=None, rotation=None, elapsed=DT) -> np.ndarray:
    if raw is not None:
        sensor.receive(raw)
    sensor.update(np.eye(3) if rotation is None else rotation, elapsed)
    return sensor.wrench


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_weight_of_the_tool_is_not_felt_in_any_orientation(seed):
    """Against the inverse dynamics of the tool alone, held at the sensor."""
    rng = np.random.default_rng(seed)
    placement, hand = pin.SE3.Random(), pin.SE3.Random()
    pushed = rng.normal(size=6) * 20.0  # environment on the tool, in the sensor's axes
    here = sensor(placement)
    held = TOOL * pin.Motion(-(hand * placement).rotation.T @ GRAVITY, np.zeros(3))
    found = step(here, pushed - held.vector, hand.rotation)
    expected = placement.act(pin.Force(pushed)).vector
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # Power does not depend on where a wrench is written.
    twist = pin.Motion.Random()
    at_sensor = placement.actInv(twist)
    assert pin.Force(found).dot(twist) == pytest.approx(pin.Force(pushed).dot(at_sensor), abs=1e-8)


def test_the_bias_is_what_a_tare_finds():
    rng = np.random.default_rng(0)
    here = sensor(filter_hz=30.0)
    bias = np.array([3.0, -2.0, 1.0, 0.1, 0.2, -0.3])
    weight = np.array([*(TOOL.mass * GRAVITY), *np.cross(TOOL.lever, TOOL.mass * GRAVITY)])
    for _ in range(1500):
        step(here, weight + bias + 0.1 * rng.normal(size=6))
    assert np.abs(here.tare() - bias).max() < 0.03
    for _ in range(100):
        step(here, weight + bias)
    assert np.abs(here.wrench).max() < 0.03


@pytest.mark.parametrize("every", [1, 3])
def test_the_filter_has_the_time_constant_of_its_cut_off(every):
    """Measured each step, or each third only."""
    here = sensor(tool=pin.Inertia.Zero(), filter_hz=10.0)
    step(here, np.zeros(6))
    constant = 1.0 / (2.0 * math.pi * 10.0)
    total, done = np.zeros(6), 0
    for k in range(1, round(constant / DT / every) * every + 1):
        before = here.wrench
        step(here, np.full(6, 8.0) if k % every == 0 else None)
        if k % every == 0:
            total += every * DT * here.rate
            np.testing.assert_allclose(here.wrench - before, every * DT * here.rate, atol=1e-9)
            done = k
    expected = 8.0 * -math.expm1(-done * DT / constant)
    np.testing.assert_allclose(here.wrench, expected, rtol=1e-9)
    np.testing.assert_allclose(total, here.wrench, rtol=1e-9)


def test_a_silent_sensor_says_so_and_comes_back_without_a_kick():
    here = sensor(tool=pin.Inertia.Zero(), filter_hz=30.0, timeout=0.0105)
    assert here.silent
    step(here, np.full(6, 5.0))
    assert not here.silent
    np.testing.assert_allclose(here.wrench, 5.0)  # the filter begins where it is
    for _ in range(10):
        step(here)
    assert not here.silent
    step(here)
    assert here.silent
    assert not here.wrench.any()
    step(here, np.full(6, -9.0))
    assert not here.silent
    np.testing.assert_allclose(here.wrench, -9.0)
    assert not here.rate.any()


@pytest.mark.parametrize(
    "raw", [np.full(6, np.nan), [1, 2, 3, 4, 5, np.inf], np.zeros(5), [0, 0, 0, -1e300, 0, 0]]
)
def test_a_measurement_that_is_none_changes_nothing(raw):
    here = sensor()
    step(here, np.ones(6))
    before = here.wrench.copy()
    with pytest.raises(WrenchError):
        here.receive(raw)
    step(here)
    np.testing.assert_array_equal(here.wrench, before)


def test_no_tare_of_a_silent_sensor():
    with pytest.raises(WrenchError, match="silent"):
        sensor().tare()


# What hangs on the sensor, from the URDF


def _hanging(root: ET.Element, link: str) -> set[str]:
    """Return the links below `link`, without it, by walking the XML."""
    below = set()
    for joint in root.iter("joint"):
        if joint.find("parent") is not None and joint.find("parent").get("link") == link:
            child = joint.find("child").get("link")
            below |= {child} | _hanging(root, child)
    return below


@pytest.mark.parametrize(
    ("robot", "frame"), [("talos_left_arm", "wrist_left_ft_link"), ("panda", "panda_link8")]
)
def test_the_tool_is_what_the_urdf_hangs_on_the_sensor(robot, frame):
    """Mass by walking the XML; the moment of its weight by inverse dynamics of the whole robot."""
    config = read_config(robot, "controller_node")
    urdf = read_urdf(config["robot_description"])
    tool = inertia_beyond(urdf, frame)
    root = ET.fromstring(urdf)
    links = _hanging(root, frame)
    masses = {
        link.get("name"): float(link.find("inertial/mass").get("value"))
        for link in root.iter("link")
        if link.find("inertial") is not None
    }
    assert tool.mass == pytest.approx(sum(masses.get(link, 0.0) for link in links))
    # Take the tool away: what the joints carry less is its weight at its centre of mass.
    for link in root.iter("link"):
        if link.get("name") in links and link.find("inertial") is not None:
            link.remove(link.find("inertial"))
    full, without = pin.buildModelFromXML(urdf), pin.buildModelFromXML(ET.tostring(root).decode())
    q = pin.neutral(full)
    data = full.createData()
    pin.framesForwardKinematics(full, data, q)
    jacobian = pin.computeFrameJacobian(
        full, data, q, full.getFrameId(frame, pin.FrameType.BODY), pin.ReferenceFrame.LOCAL
    )
    R = data.oMf[full.getFrameId(frame, pin.FrameType.BODY)].rotation
    force = tool.mass * R.T @ GRAVITY
    wrench = np.concatenate([force, np.cross(tool.lever, force)])
    less = pin.computeGeneralizedGravity(full, data, q) - pin.computeGeneralizedGravity(
        without, without.createData(), q
    )
    carrying = np.abs(jacobian).max(axis=0) > 0.0
    np.testing.assert_allclose(less[carrying], -(jacobian.T @ wrench)[carrying], atol=1e-9)


def test_nothing_hangs_on_an_unknown_link():
    urdf = read_urdf(read_config("panda", "controller_node")["robot_description"])
    with pytest.raises(RobotDescriptionError, match="nothing_here"):
        inertia_beyond(urdf, "nothing_here")
