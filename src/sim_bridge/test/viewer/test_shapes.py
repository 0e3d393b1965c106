# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from sim_bridge.viewer.shapes import visual_shapes
from viability_bounds_pkg.robot.description import RobotDescriptionError, build_model

URDF = """<robot name="two">
  <link name="base"><visual><geometry><box size="0.2 0.4 0.6"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 1" rpy="1.5707963267948966 0 0"/>
    <geometry><cylinder radius="0.1" length="2.0"/></geometry></visual></link>
  <link name="lower"><visual><geometry>{last}</geometry></visual></link>
  <joint name="first" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="second" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.5"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""
SPHERE = '<sphere radius="0.3"/>'


def test_shapes_are_in_the_axes_of_the_joint_that_moves_them():
    urdf = URDF.format(last=SPHERE)
    box, cylinder, sphere = visual_shapes(urdf, build_model(urdf, ["first", "second"]), {})
    assert [box.joint, cylinder.joint, sphere.joint] == [0, 1, 2]
    assert np.ptp(box.vertices, axis=0) == pytest.approx([0.2, 0.4, 0.6])
    assert cylinder.vertices.mean(axis=0) == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert np.ptp(cylinder.vertices, axis=0) == pytest.approx([0.2, 2.0, 0.2], rel=1e-2)
    assert np.linalg.norm(sphere.vertices, axis=1) == pytest.approx(0.3)
    for shape in (box, cylinder, sphere):
        assert shape.triangles.max() < len(shape.vertices)


def test_what_hangs_on_a_locked_joint_moves_with_the_one_before():
    urdf = URDF.format(last=SPHERE)
    *_, sphere = visual_shapes(
        urdf, build_model(urdf, ["first"], {"second": 1.0}), {"second": 1.0}
    )
    assert sphere.joint == 1
    assert sphere.vertices.mean(axis=0) == pytest.approx([0.0, 0.0, 0.5], abs=1e-6)


def test_a_missing_mesh_is_refused():
    urdf = URDF.format(last='<mesh filename="package://nowhere/link.stl"/>')
    with pytest.raises(RobotDescriptionError, match="nowhere"):
        visual_shapes(urdf, build_model(urdf, ["first", "second"]), {})
