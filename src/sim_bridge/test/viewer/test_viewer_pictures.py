# SPDX-License-Identifier: Apache-2.0
"""What the viewer draws: joints with their limits, and the robot's shapes."""

import math
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bridge.node.viewer_node import passed_limits
from sim_bridge.viewer.joint_pictures import JointPictures, JointValues, usage
from sim_bridge.viewer.shapes import visual_shapes
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import RobotDescriptionError

LIMITS = JointLimits(
    ("shoulder", "elbow", "<wrist>"),
    np.array([-1.0, -2.0, -math.inf]),
    np.array([1.0, 0.5, math.inf]),
    np.array([2.0, 3.0, 4.0]),
    np.array([-5.0, -10.0, -20.0]),
    np.array([5.0, 10.0, 20.0]),
)
TAU_MAX = np.array([50.0, 20.0, 5.0])
SVG = "{http://www.w3.org/2000/svg}"


def values(q=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), tau=(0.0, 0.0, 0.0), limits=math.nan):
    three = np.full(3, limits)
    return JointValues(*map(np.array, (q, v, tau)), np.zeros(3), three, three)


def test_usage_is_the_nearest_to_a_limit():
    # From q the speed sqrt(2 a (q_max - q)) can just be braked before q_max.
    q = np.array([0.9, 0.4, 7.0])
    v = np.array([math.sqrt(2 * 5.0 * 0.1), math.sqrt(2 * 10.0 * 0.1), 4.0])
    assert usage(values(q, v), LIMITS, TAU_MAX) == pytest.approx(1.0)
    assert usage(values(q, 0.5 * v), LIMITS, TAU_MAX) == pytest.approx(0.5)
    # Away from the limit only the speed limit counts.
    assert usage(values(q, -0.5 * v), LIMITS, TAU_MAX)[0] == pytest.approx(0.25)
    assert usage(values(tau=(25.0, -20.0, 0.0)), LIMITS, TAU_MAX) == pytest.approx([0.5, 1.0, 0])
    assert usage(values(q=(1.0, 0.6, 9.0)), LIMITS, TAU_MAX) == pytest.approx([1.0, 1.0, 0.0])
    unknown = values(tau=(math.nan,) * 3)
    assert usage(unknown, LIMITS, TAU_MAX) == pytest.approx(0.0)


@settings(max_examples=30)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    st.lists(st.floats(-9.0, 9.0), min_size=3, max_size=3),
    st.sampled_from([math.nan, 0.0, 100.0]),
)
def test_every_state_gives_a_picture_without_nan(q, v, limits):
    picture = JointPictures(LIMITS.names, LIMITS, TAU_MAX).draw(values(q, v, limits=limits))
    assert "nan" not in picture and "inf" not in picture
    root = ElementTree.fromstring(picture)
    assert len(list(root.iter(f"{SVG}circle"))) == 3
    assert "<wrist>" in {text.text for text in root.iter(f"{SVG}text")}


def test_distances_to_limits_have_the_units_of_the_joints():
    pictures = JointPictures(LIMITS.names, LIMITS, TAU_MAX, ("m", "rad", "rad"))
    assert "to limit 1.000 m<" in pictures.draw(values(q=(0.0, 0.0, 0.0)))


def test_axes_and_the_way_to_the_nearest_limit_are_named():
    pictures = JointPictures(LIMITS.names, LIMITS, TAU_MAX, ("rad", "m", "rad"))
    root = ElementTree.fromstring(pictures.draw(values(q=(0.75, -1.5, 0.0))))
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert texts.count("position") == texts.count("speed") == 3
    rooms = [text for text in texts if "limit" in text]
    assert rooms == ["to limit 0.250 rad", "to limit 0.500 m", "no position limit"]


def test_the_state_on_the_border_is_drawn_on_the_border():
    pictures = JointPictures(LIMITS.names, LIMITS, TAU_MAX)
    root = ElementTree.fromstring(pictures.draw(values(v=(2.0, 0.0, 0.0))))
    dot, kernel = next(root.iter(f"{SVG}circle")), list(root.iter(f"{SVG}polygon"))[1]
    points = np.array([point.split(",") for point in kernel.get("points").split()], dtype=float)
    assert float(dot.get("cy")) == pytest.approx(points[:, 1].min())
    middle = 0.5 * (points[:, 0].min() + points[:, 0].max())
    assert float(dot.get("cx")) == pytest.approx(middle, abs=0.1)


def test_speed_limits_that_depend_on_position_are_drawn():
    c, d = np.array([0.5, 0.0, 0.0]), np.array([4.0, math.inf, math.inf])
    limits = replace(LIMITS, velocity_offset=c, deceleration_limit=d)
    root = ElementTree.fromstring(JointPictures(LIMITS.names, limits, TAU_MAX).draw(values()))
    allowed, kernel, others = list(root.iter(f"{SVG}polygon"))[:3]
    assert allowed.get("points") == kernel.get("points")  # it can brake as fast as that
    assert allowed.get("points") != others.get("points")
    points = np.array([point.split(",") for point in allowed.get("points").split()], dtype=float)
    at_limit = points[points[:, 0] == points[:, 0].max()]
    assert np.ptp(at_limit[:, 1]) < 0.51 * np.ptp(points[:, 1]), "only speeds away from it"
    # c^2 / (2 d) before the limit it is at its end.
    last = 1.0 - 0.25 / 8.0
    assert usage(values((last, 0.0, 0.0)), limits, TAU_MAX).tolist() == [1.0, 0.0, 0.0]
    assert usage(values((last - 0.1, 0.0, 0.0)), limits, TAU_MAX).tolist() == [0.0, 0.0, 0.0]


URDF = """<robot name="two">
  <link name="base"><visual><geometry><box size="0.2 0.4 0.6"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 1" rpy="1.5707963267948966 0 0"/>
    <geometry><cylinder radius="0.1" length="2.0"/></geometry></visual></link>
  <link name="lower"><visual><geometry><sphere radius="0.3"/></geometry></visual></link>
  <joint name="first" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="second" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.5"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""


def test_shapes_are_in_the_axes_of_the_joint_that_moves_them():
    box, cylinder, sphere = visual_shapes(URDF, build_model(URDF, ["first", "second"]), {})
    assert [box.joint, cylinder.joint, sphere.joint] == [0, 1, 2]
    assert np.ptp(box.vertices, axis=0) == pytest.approx([0.2, 0.4, 0.6])
    assert cylinder.vertices.mean(axis=0) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert np.ptp(cylinder.vertices, axis=0) == pytest.approx([0.2, 2.0, 0.2], rel=1e-2)
    assert np.linalg.norm(sphere.vertices, axis=1) == pytest.approx(0.3)


def test_what_hangs_on_a_locked_joint_moves_with_the_one_before():
    locked = {"second": 1.0}
    *_, sphere = visual_shapes(URDF, build_model(URDF, ["first"], locked), locked)
    assert sphere.joint == 1
    assert sphere.vertices.mean(axis=0) == pytest.approx([0.0, 0.0, 0.5], abs=1e-6)


def test_a_missing_mesh_is_refused():
    urdf = URDF.replace('<sphere radius="0.3"/>', '<mesh filename="package://nowhere/link.stl"/>')
    with pytest.raises(RobotDescriptionError, match="nowhere"):
        visual_shapes(urdf, build_model(urdf, ["first", "second"]), {})


def test_passed_limits_of_slides_and_others_are_told_apart():
    robot = {"position_violation_rad": "0.02 0.3 0.01", "velocity_violation_rad_s": "0.0 nan 0.5"}
    told = passed_limits(robot, ["m", "rad", "m"])
    assert told == pytest.approx(
        {"m": 0.02, "rad": 0.3, "m/s": 0.5, "rad/s": math.nan}, nan_ok=True
    )
    assert passed_limits({}, ["m", "rad", "m"]) == {}
