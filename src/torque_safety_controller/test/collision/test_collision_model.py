# SPDX-License-Identifier: Apache-2.0
"""Capsules around links, the tool that writes them, and the pairs that are kept apart."""

import numpy as np
import pinocchio as pin
import pytest
import yaml

from torque_safety_controller.new_robot.capsules import fitted_capsule, link_capsules
from torque_safety_controller.node.assembly import make_collision
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tools.fit_capsules import main
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.description import build_model, load_geometry
from viability_bounds_pkg.robot.locked_joints import LockedJoints
from viability_bounds_pkg.robot.payload import Payload
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


def test_the_tool_writes_capsules_into_a_parameter_file(tmp_path, capsys):
    shipped = (config_folder() / "panda.yaml").read_text()
    path = tmp_path / "panda.yaml"
    entries = yaml.safe_load(shipped)["/**/controller_node"]["ros__parameters"]
    lines = "".join(f'      - "{entry}"\n' for entry in entries["collision_capsules"])
    without = shipped.replace(f"    collision_capsules:\n{lines}", "")
    assert "capsules" not in without
    path.write_text(without)
    assert main([str(path)]) == 0
    assert path.read_text() == shipped
    path.write_text(without.replace("/**/controller_node:", "/**/controller_node:  # its own"))
    assert main([str(path)]) == 1
    assert "no section '/**/controller_node:'" in capsys.readouterr().err


def test_points_of_a_capsule_are_held_tightly():
    rng = np.random.default_rng(0)
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


# Parameters


def configuration(**changes) -> ControllerConfiguration:
    return read(ControllerConfiguration, PANDA | {"collision_avoidance": True} | changes)


def load(**changes):
    config = configuration(**changes)
    return make_collision(config, load_model(config, config.read_urdf()))


THINGS = [
    "{name: table, shape: box, size: [0.4, 1, 5e-2], position: [0.7, 0, 0.2], rpy: [0, 0, 0.8]}",
    "{name: ball, shape: sphere, size: [0.2, 0.2, 0.2], position: [0.5, 0.3, 0.5]}",
    "{name: pole, shape: cylinder, size: [0.06, 0.06, 1.0], position: [0.4, -0.4, 0.5]}",
    "{name: floor, shape: half_space, position: [0.0, 0.0, -0.1]}",
]


def test_obstacles_become_shapes_in_the_base_frame():
    segments = load(obstacles=THINGS).model.segments
    table, ball, pole, floor = range(11, 15)
    np.testing.assert_allclose(segments.radius[[table, ball, pole, floor]], [0.0, 0.1, 0.03, 0.0])
    np.testing.assert_allclose(segments.ends[ball], [[0.5, 0.3, 0.5]] * 2)
    np.testing.assert_allclose(segments.ends[pole], [[0.4, -0.4, 0.0], [0.4, -0.4, 1.0]])
    table, floor = segments.boxes
    np.testing.assert_allclose(table[:2], [[0.7, 0.0, 0.2], [0.2, 0.5, 0.025]])
    np.testing.assert_allclose(table[2:], pin.utils.rotate("z", 0.8).T, atol=1e-12)
    assert floor[0, 2] + floor[1, 2] == pytest.approx(-0.1)


def test_neighbours_are_left_out_and_what_is_near_in_the_given_posture_or_always():
    top = "{name: top, shape: box, size: [1.0, 1.0, 0.1], position: [0.2, 0.0, 0.15]}"
    model = load(obstacles=[top]).model
    assert {"panda_hand - panda_link2", "panda_hand - top"} <= set(model.names)
    for name in ("panda_link2 - panda_link1", "panda_hand - panda_link7", "panda_link0 - top"):
        assert name not in model.names
    assert model.left_out["collision_posture"] == ["panda_link7 - panda_link5"]
    assert "panda_link1 - top" in model.left_out["all postures"]
    # In the middle of the limits, the default, the hand is bent back to the forearm.
    middle = load(collision_posture=None).model
    assert "panda_hand - panda_link5" in middle.left_out["collision_posture"]


BOX = {"name": "box", "shape": "box", "size": [1, 1, 1], "position": [0, 0, 1], "rpy": [0, 0, 0]}


def obstacle(**changes):
    given = {key: value for key, value in (BOX | changes).items() if value is not None}
    return {"obstacles": [*THINGS, yaml.safe_dump(given, default_flow_style=True)]}


@pytest.mark.parametrize(
    ("changes", "name", "allowed"),
    [
        (obstacle(name="ball"), "obstacles[4].name", "a name that no other obstacle has"),
        (obstacle(name="panda_hand"), "obstacles[4].name", ""),
        (obstacle(shape=None), "obstacles[4].shape", "a string"),
        (obstacle(size=[0.4, 1.0, 0.0]), "obstacles[4].size", "3 finite numbers > 0"),
        (obstacle(shape="sphere", size=[1.0, 2.0, 1.0]), "obstacles[4].size", "the same diameter"),
        (obstacle(position=[0.0, True, 0.0]), "obstacles[4].position", "3 finite numbers"),
        (obstacle(position=[400.0, 0.0, 0.0]), "obstacles[4].position", ">= -100 and <= 100"),
        (
            {"collision_capsules": ["{link: a, start: [0, 0, 0], end: [0, 0, 60], radius: 1}"]},
            "collision_capsules[0].end",
            ">= -10 and <= 10",
        ),
        ({"obstacles": ["{name: a"]}, "obstacles[0]", "a YAML mapping with the fields name, "),
        (
            {"obstacles": ["{colour: red}"]},
            "obstacles[0]",
            "a YAML mapping with the fields name, ",
        ),
        ({"collision_posture": [9.0] * 7}, "collision_posture", "within the position limits"),
        ({"acceleration_min": None}, "acceleration_min", ""),
        ({"collision_capsules": ["{link: hand, radius: 0.1}"]}, "collision_capsules[0].start", ""),
    ],
)
def test_what_cannot_be_is_refused_by_the_name_of_the_parameter(changes, name, allowed):
    with pytest.raises(SettingError) as error:
        load(**changes)
    assert error.value.name == name
    assert allowed in error.value.allowed


def test_shapes_follow_a_torso_that_the_model_has_locked():
    """Those of the arm, and those of links that it does not move."""
    values = read_config("talos_left_arm", "controller_node")
    n = len(values["joints"])
    values = {k: v[2:] if isinstance(v, list) and len(v) == n else v for k, v in values.items()}
    values |= {"collision_avoidance": True, "obstacles": THINGS}
    config, torso = read(ControllerConfiguration, values), ["torso_1_joint", "torso_2_joint"]
    model, urdf = load_model(config, config.read_urdf()), config.read_urdf()
    found = make_collision(config, model)
    locked = LockedJoints(config, urdf, model, Payload(model), config.end_effectors)
    assert locked.look(torso, [0.3, 0.4], 1)
    found.remodel(RobotModel(model, config.end_effectors[0], 1e-3))
    values["locked_joints"] += torso
    values["locked_positions"] += [0.3, 0.4]
    config = read(ControllerConfiguration, values)
    expected = make_collision(config, load_model(config, urdf))
    links = len(config.collision.capsules)
    for name in ("joint", "radius", "ends", "boxes"):
        one, other = (getattr(each.model.segments, name) for each in (found, expected))
        np.testing.assert_allclose(one, other, atol=1e-9)
    still = found.model.segments.joint[:links] == 0
    assert still.any() and not still.all()
