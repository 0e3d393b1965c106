# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pinocchio as pin
import pytest
import yaml
from collision_arm import panda

from torque_safety_controller.node.assembly import make_collision
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config

PANDA = read_config("panda", "controller_node")
THINGS = [
    "{name: table, shape: box, size: [0.4, 1, 5e-2], position: [0.7, 0, 0.2], rpy: [0, 0, 0.8]}",
    "{name: ball, shape: sphere, size: [0.2, 0.2, 0.2], position: [0.5, 0.3, 0.5]}",
    "{name: pole, shape: cylinder, size: [0.06, 0.06, 1.0], position: [0.4, -0.4, 0.5]}",
    "{name: floor, shape: half_space, position: [0.0, 0.0, -0.1]}",
]


def controller_configuration(**changes):
    return read(ControllerConfiguration, PANDA | {"collision_avoidance": True} | changes)


def configuration(**changes):
    return controller_configuration(**changes).collision


def load(**changes):
    arm = panda()[0]
    config = controller_configuration(**changes)
    return make_collision(config, arm.model)


def test_off_by_default_and_then_nothing_is_loaded():
    assert load(collision_avoidance=None) is None
    assert load(collision_avoidance=False) is None
    assert not configuration(collision_avoidance=None).collision_avoidance


def test_obstacles_become_shapes_in_the_base_frame():
    avoidance = load(obstacles=THINGS)
    segments = avoidance.model.segments
    table, ball, pole, floor = range(11, 15)
    np.testing.assert_allclose(segments.radius[[table, ball, pole, floor]], [0.0, 0.1, 0.03, 0.0])
    np.testing.assert_allclose(segments.ends[ball], [[0.5, 0.3, 0.5]] * 2)
    np.testing.assert_allclose(segments.ends[pole], [[0.4, -0.4, 0.0], [0.4, -0.4, 1.0]])
    table, floor = segments.boxes
    np.testing.assert_allclose(table[:2], [[0.7, 0.0, 0.2], [0.2, 0.5, 0.025]])
    np.testing.assert_allclose(table[2:], pin.utils.rotate("z", 0.8).T, atol=1e-12)
    assert floor[0, 2] + floor[1, 2] == pytest.approx(-0.1)
    assert {"panda_hand - table", "panda_hand - ball"} <= set(avoidance.model.names)


def test_pairs_near_in_the_given_posture_are_left_out():
    chosen = load()
    assert "panda_hand - panda_link1" in chosen.model.names
    assert chosen.model.left_out["collision_posture"] == ["panda_link7 - panda_link5"]
    # In the middle of the limits, the default, the hand is bent back to the forearm.
    middle = load(collision_posture=None)
    assert "panda_hand - panda_link5" in middle.model.left_out["collision_posture"]


def test_acceleration_limits_arrive():
    config = configuration()
    np.testing.assert_array_equal(config.acceleration_min, PANDA["acceleration_min"])
    np.testing.assert_array_equal(config.acceleration_max, PANDA["acceleration_max"])


def test_what_an_arm_is_mounted_on_is_left_out_and_said_to_be():
    top = "{name: top, shape: box, size: [1.0, 1.0, 0.1], position: [0.2, 0.0, 0.15]}"
    model = load(obstacles=[top]).model
    assert "panda_link1 - top" in model.left_out["all postures"]
    assert "panda_hand - top" in model.names


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"collision_posture": [0.0] * 6}, "collision_posture"),
        ({"collision_posture": [9.0] * 7}, "collision_posture"),
        ({"acceleration_min": None}, "acceleration_min"),
    ],
)
def test_what_cannot_be_is_refused_by_the_name_of_the_parameter(changes, name):
    with pytest.raises(SettingError) as error:
        configuration(obstacles=THINGS, **changes)
    assert error.value.name == name


BOX = {"name": "box", "shape": "box", "size": [1, 1, 1], "position": [0, 0, 1], "rpy": [0, 0, 0]}


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("name", None, "a string"),
        ("name", "ball", "a name that no other obstacle has"),
        ("name", 7, "a string"),
        ("shape", None, "a string"),
        ("shape", "cone", "one of box, sphere, cylinder, half_space"),
        ("size", None, "3 finite numbers"),
        ("size", [1.0, 1.0], "3 finite numbers"),
        ("size", [0.4, 1.0, 0.0], "3 finite numbers > 0"),
        ("size", 1.0, "3 finite numbers"),
        ("position", None, "3 finite numbers"),
        ("position", [0.0, 0.0, float("nan")], "3 finite numbers"),
        ("position", [0.0, True, 0.0], "3 finite numbers"),
        ("rpy", ["a", "b", "c"], "3 finite numbers"),
    ],
)
def test_what_cannot_be_of_an_obstacle_is_refused_by_entry_and_field(field, value, allowed):
    given = {k: v for k, v in (BOX | {field: value}).items() if v is not None}
    with pytest.raises(SettingError) as error:
        configuration(obstacles=[*THINGS, yaml.safe_dump(given, default_flow_style=True)])
    assert error.value.name == f"obstacles[4].{field}"
    assert str(error.value.value) == str(value)
    assert allowed in error.value.allowed


@pytest.mark.parametrize("text", ["", "box", "[1, 2]", "{name: a", "{name: a, colour: red}"])
def test_what_is_no_obstacle_is_refused(text):
    with pytest.raises(
        SettingError, match="a YAML mapping with the fields name, shape, "
    ) as error:
        configuration(obstacles=[text])
    assert error.value.name == "obstacles[0]"


def test_the_diameters_of_a_round_obstacle_are_the_same():
    for shape, size in (("sphere", [1.0, 2.0, 1.0]), ("cylinder", [1.0, 2.0, 1.0])):
        with pytest.raises(SettingError, match="the same diameter [23] times") as error:
            configuration(obstacles=[str(BOX | {"shape": shape, "size": size})])
        assert error.value.name == "obstacles[0].size"


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"acceleration_max": [-1.0] * 7}, "acceleration_max"),
        ({"obstacles": [THINGS[1].replace("ball", "panda_hand")]}, "obstacles[0].name"),
        ({"collision_capsules": None}, "collision_capsules"),
        ({"collision_capsules": ["{link: hand, radius: 0.1}"]}, "collision_capsules[0].start"),
    ],
)
def test_what_the_robot_does_not_have_is_refused_by_the_name_of_the_parameter(changes, name):
    with pytest.raises(SettingError) as error:
        load(**changes)
    assert error.value.name == name


def test_the_parameters_are_checked_even_while_it_is_off():
    with pytest.raises(SettingError, match="shape"):
        configuration(collision_avoidance=False, obstacles=["{name: table}"])
