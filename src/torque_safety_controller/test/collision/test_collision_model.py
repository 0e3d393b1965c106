# SPDX-License-Identifier: Apache-2.0
"""Capsules around links, the tool that writes them, and the pairs that are kept apart."""

import numpy as np
import pinocchio as pin
import pytest
import yaml
from collision_arm import box, half_space, panda, sphere

from torque_safety_controller.new_robot.capsules import fitted_capsule, link_capsules
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.model import build_collision_model
from torque_safety_controller.parts.collision.shapes import capsule
from torque_safety_controller.tools.fit_capsules import main, with_capsules
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.parameter_files import ParameterFileError
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    build_model,
    load_geometry,
)
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

PANDA = read_config("panda", "controller_node")

SHAPES = """<robot name="shapes"><link name="base"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.3 0 0" rpy="0 0.5 0"/><geometry>{}</geometry></collision>
  </link></robot>"""


def inside(points, start, end, radius):
    """Whether all points are in a capsule."""
    axis = end - start
    square = axis @ axis
    share = ((points - start) @ axis / square).clip(0.0, 1.0) if square > 0.0 else 0.0
    nearest = start + np.multiply.outer(share, axis)
    return (np.linalg.norm(points - nearest, axis=1) <= radius + 1e-9).all()


@pytest.mark.parametrize("name", ["panda", "talos_left_arm", "baxter_left_arm"])
def test_the_capsules_of_a_robots_file_hold_the_meshes_of_its_links(name):
    config = read(ControllerConfiguration, read_config(name, "controller_node"))
    urdf = config.read_urdf()
    model = load_model(config, urdf)
    around = {shape.name: shape for shape in config.collision.capsules}
    links, held = set(), 0
    for item in load_geometry(urdf, model, config.locked).geometryObjects:
        frame = model.frames[item.parentFrame]
        links.add(frame.name)
        shape, place = around[frame.name], frame.placement.actInv(item.placement)
        if hasattr(item.geometry, "vertices"):
            points = item.geometry.vertices() @ place.rotation.T + place.translation
            assert inside(points, *shape.ends(pin.SE3.Identity()), shape.radius)
            held += 1
    assert links == set(around)
    assert held > 1


def test_the_tool_writes_capsules_into_a_parameter_file(tmp_path):
    shipped = (config_folder() / "panda.yaml").read_text()
    path = tmp_path / "panda.yaml"
    entries = yaml.safe_load(shipped)["/**/controller_node"]["ros__parameters"].pop(
        "collision_capsules"
    )
    lines = "".join(f'      - "{entry}"\n' for entry in entries)
    without = shipped.replace(f"    collision_capsules:\n{lines}", "")
    assert "capsules" not in without
    for text in (without, shipped):
        path.write_text(text)
        assert main([str(path)]) == 0
        assert path.read_text() == shipped
    with pytest.raises(ParameterFileError, match="no section"):
        with_capsules("bounds_node:\n", entries)


@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_few_points_and_points_of_a_capsule_are_held_tightly(count):
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3))
    assert inside(points, *fitted_capsule(points))
    directions = rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    along = rng.uniform(size=(3000, 1)) * np.array([0.3, 0.2, -0.1])
    start, end, radius = fitted_capsule(along + 0.1 * directions)
    volume = np.pi * radius**2 * (np.linalg.norm(end - start) + 4.0 / 3.0 * radius)
    assert volume < 1.05 * np.pi * 0.01 * (np.sqrt(0.14) + 0.4 / 3.0)


@pytest.mark.parametrize(
    "geometry, radius",
    [
        ('<box size="0.4 0.1 0.1"/>', 0.5 * np.sqrt(0.02)),
        ('<cylinder radius="0.05" length="0.3"/>', 0.05),
        ('<sphere radius="0.1"/>', 0.1),
    ],
)
def test_shapes_of_a_urdf_are_held(geometry, radius):
    urdf = SHAPES.format(geometry)
    model = build_model(urdf, ["turn"])
    ((link, (found,)),) = link_capsules(model, load_geometry(urdf, model)).items()
    assert link == "arm"
    assert 0.999 * radius <= found.radius < 1.1 * radius
    np.testing.assert_allclose(0.5 * (found.start + found.end), [0.3, 0.0, 0.0], atol=0.02)


def test_a_shape_that_the_parser_drops_is_an_error():
    urdf = SHAPES.format('<capsule radius="0.05" length="0.3"/>')
    model = build_model(urdf, ["turn"])
    with pytest.raises(RobotDescriptionError, match="'arm': only 0 of 1"):
        load_geometry(urdf, model)


def test_a_mesh_that_is_missing_is_an_error():
    urdf = SHAPES.format('<mesh filename="package://nowhere/arm.stl"/>')
    model = build_model(urdf, ["turn"])
    with pytest.raises(RobotDescriptionError, match="package://nowhere/arm.stl: no package"):
        load_geometry(urdf, model)


def test_links_of_locked_joints_are_where_these_are_locked():
    """TALOS' right arm is locked beside the body."""
    config = read(ControllerConfiguration, read_config("talos_left_arm", "controller_node"))
    urdf = config.read_urdf()
    model = load_model(config, urdf)
    frame = model.frames[model.getFrameId("gripper_right_base_link")]
    assert frame.parentJoint == model.getJointId("torso_2_joint")
    full = pin.buildModelFromXML(urdf)
    q = pin.neutral(full)
    for name, position in config.locked.items():
        q[full.joints[full.getJointId(name)].idx_q] = position
    data = full.createData()
    pin.framesForwardKinematics(full, data, q)
    hand = data.oMf[full.getFrameId("gripper_right_base_link")]
    torso = data.oMi[full.getJointId("torso_2_joint")]
    np.testing.assert_allclose(frame.placement, torso.actInv(hand), atol=1e-9)


def test_neighbours_are_left_out_and_what_is_always_near():
    _, _, collision = panda()
    assert "panda_hand - panda_link2" in collision.names
    assert "panda_hand - table" in collision.names
    for name in ("panda_link2 - panda_link1", "panda_hand - panda_link7", "panda_link0 - table"):
        assert name not in collision.names
    assert collision.left_out["collision_posture"] == ["panda_link7 - panda_link5"]


def build(**changes):
    arm, capsules = panda()[0], read(ControllerConfiguration, PANDA).collision.capsules
    given = {"capsules": capsules, "q_start": arm.q_start, **changes}
    return build_collision_model(given.pop("model", arm.model), **given)


def test_obstacles_are_in_the_base_frame():
    model = panda()[0].model.copy()
    place = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.5, 0.1, 0.2]))
    model.addFrame(pin.Frame("table_frame", 0, 0, place, pin.FrameType.OP_FRAME))
    things = [
        sphere("ball", [0.1, 0.2, 0.3], 0.1),
        box("block", [0.3, 0.0, 0.1], [0.1, 0.2, 0.3]),
        half_space("floor", [0.0, 0.0, -0.1], [0.0, 0.0, 2.0]),
    ]
    segments = build(model=model, obstacles=things, base_frame="table_frame").segments
    ball = segments.ends[10 + 1]
    np.testing.assert_allclose(ball, [place.act(np.array([0.1, 0.2, 0.3]))] * 2)
    block, floor = segments.boxes
    np.testing.assert_allclose(block[0], place.act(np.array([0.3, 0.0, 0.1])))
    np.testing.assert_allclose(block[1], [0.05, 0.1, 0.15])
    np.testing.assert_allclose(block[2:], place.rotation.T, atol=1e-12)
    normal = place.rotation[:, 2]
    np.testing.assert_allclose(floor[4], normal, atol=1e-12)
    surface = floor[0] + floor[1, 2] * normal
    assert normal @ surface == pytest.approx(normal @ place.act(np.array([0.0, 0.0, -0.1])))


def test_capsules_of_an_unknown_link_are_refused():
    with pytest.raises(SettingError, match="did you mean"):
        build(capsules=[capsule("panda_hnd", [0.0] * 3, [0.1] * 3, 0.1)])
