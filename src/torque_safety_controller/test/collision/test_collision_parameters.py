import numpy as np
import pinocchio as pin
import pytest
from collision_arm import panda
from ros_harness import read_config

from torque_safety_controller.collision.avoidance import CollisionSettings
from torque_safety_controller.collision.bodies import SHAPES, make_obstacle
from torque_safety_controller.parameters import controller_parameters
from torque_safety_controller.parameters.collision_parameters import TABLE, load_collision
from torque_safety_controller.parameters.controller_parameters import make_configuration
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import read_urdf

PANDA = read_config("panda", "controller_node")
TURNED = [0.0, 0.0, np.sin(0.4), np.cos(0.4)]
THINGS = {
    "obstacle_names": ["table", "ball", "pole", "floor"],
    "obstacle_shapes": ["box", "sphere", "cylinder", "half_space"],
    "obstacle_sizes": [0.4, 1.0, 0.05, 0.2, 0.2, 0.2, 0.06, 0.06, 1.0, 0.0, 0.0, 0.0],
    "obstacle_positions": [0.7, 0.0, 0.2, 0.5, 0.3, 0.5, 0.4, -0.4, 0.5, 0.0, 0.0, -0.1],
    "obstacle_orientations": [*TURNED, *[0.0, 0.0, 0.0, 1.0] * 3],
}


def values(**changes):
    given = PANDA | {"collision_avoidance": True} | changes
    return {row.name: row.coerce(given.get(row.name)) for row in controller_parameters.TABLE}


def configuration(**changes):
    return make_configuration(values(**changes)).collision


def load(**changes):
    arm = panda()[0]
    given = values(**changes)
    config = make_configuration(given).collision
    return load_collision(given, config, read_urdf(PANDA["robot_description"]), arm.model)


def test_off_by_default_and_then_nothing_is_loaded():
    assert configuration(collision_avoidance=None) is None
    assert load(collision_avoidance=False) is None
    assert not values(collision_avoidance=None)["collision_avoidance"]


def test_defaults_are_those_of_the_settings():
    assert configuration().settings == CollisionSettings()


@pytest.mark.parametrize("name", [f.name for f in TABLE if f.kind is float])
def test_each_setting_arrives(name):
    settings = configuration(**{name: 0.7}).settings
    assert getattr(settings, name.removeprefix("collision_")) == 0.7


def test_obstacles_become_shapes_in_the_base_frame():
    avoidance = load(**THINGS)
    bodies = avoidance.model.bodies
    table, ball, pole, floor = bodies.half[bodies.first[-5:-1]]
    np.testing.assert_allclose(table, [0.2, 0.5, 0.025])
    np.testing.assert_allclose(ball, 0.0)
    np.testing.assert_allclose(pole, [0.0, 0.0, 0.5])
    np.testing.assert_allclose(bodies.radius[-4:], [0.0, 0.1, 0.03, 0.0])
    centres = [[0.7, 0.0, 0.2], [0.5, 0.3, 0.5], [0.4, -0.4, 0.5], [0.0, 0.0, -0.1 - floor[2]]]
    np.testing.assert_allclose(bodies.centre[-4:], centres, atol=1e-12)
    expected = pin.Quaternion(np.array(TURNED)).toRotationMatrix()
    np.testing.assert_allclose(bodies.rotation[-4], expected, atol=1e-12)
    np.testing.assert_allclose(bodies.rotation[-3:, :, 2], [[0.0, 0.0, 1.0]] * 3, atol=1e-12)
    assert bodies.plane.tolist()[-4:] == [False, False, False, True]
    assert {"panda_hand - table", "panda_hand - ball"} <= set(avoidance.model.names)


def test_pairs_are_those_listed_or_those_chosen_at_the_posture_given():
    listed = load(collision_pairs=["panda_hand panda_link1"])
    assert set(listed.model.names) == {"panda_hand - panda_link1"}
    chosen = load()
    assert "panda_hand - panda_link1" in chosen.model.names
    assert chosen.model.left_out["near at start"] == ["panda_link7 - panda_link5"]
    # In the middle of the limits, the default, the hand is bent back to the forearm.
    middle = load(collision_posture=None)
    assert "panda_hand - panda_link5" in middle.model.left_out["near at start"]
    # What is asked to be kept further apart is left out sooner.
    wide = load(collision_margin=0.08)
    assert len(wide.model.left_out["near at start"]) > 1


def test_acceleration_limits_arrive():
    config = configuration()
    np.testing.assert_array_equal(config.a_min, PANDA["acceleration_min"])
    np.testing.assert_array_equal(config.a_max, PANDA["acceleration_max"])


def test_what_an_arm_is_mounted_on_is_left_out_and_said_to_be():
    top = {
        "obstacle_names": ["top"],
        "obstacle_shapes": ["box"],
        "obstacle_sizes": [1.0, 1.0, 0.1],
        "obstacle_positions": [0.2, 0.0, 0.15],
    }
    model = load(**top).model
    assert "panda_link1 - top" in model.left_out["near always"]
    assert "panda_hand - top" in model.names


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"collision_margin": -0.1}, "collision_margin"),
        ({"collision_margin": float("nan")}, "collision_margin"),
        ({"collision_braking": 0.0}, "collision_braking"),
        ({"collision_speed_max": float("inf")}, "collision_speed_max"),
        ({"collision_pairs": ["panda_hand"]}, "collision_pairs"),
        ({"collision_posture": [0.0] * 6}, "collision_posture"),
        ({"collision_posture": [9.0] * 7}, "collision_posture"),
        ({"acceleration_min": None}, "acceleration_min"),
        ({"obstacle_names": ["table", "table", "pole", "floor"]}, "obstacle_names"),
        ({"obstacle_shapes": ["box"]}, "obstacle_shapes"),
        ({"obstacle_shapes": ["box", "sphere", "cone", "half_space"]}, "obstacle_shapes"),
        ({"obstacle_sizes": [1.0] * 11}, "obstacle_sizes"),
        ({"obstacle_sizes": [0.4, 1.0, 0.0, *[1.0] * 9]}, "obstacle_sizes"),
        ({"obstacle_sizes": [0.4, 1.0, 0.1, 1.0, 2.0, *[1.0] * 7]}, "obstacle_sizes"),
        ({"obstacle_positions": None}, "obstacle_positions"),
        ({"obstacle_positions": [float("nan")] * 12}, "obstacle_positions"),
        ({"obstacle_orientations": [0.0] * 16}, "obstacle_orientations"),
    ],
)
def test_what_cannot_be_is_refused_by_the_name_of_the_parameter(changes, name):
    with pytest.raises(SettingError) as error:
        configuration(**THINGS | changes)
    assert error.value.name == name


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"collision_pairs": ["panda_hand nowhere"]}, "collision_pairs"),
        ({"collision_pairs": ["panda_hand panda_link7"]}, "collision_pairs"),
        ({"acceleration_max": [-1.0] * 7}, "acceleration_max"),
        (THINGS | {"obstacle_names": ["panda_hand", "ball", "pole", "floor"]}, "obstacle_names"),
    ],
)
def test_what_the_robot_does_not_have_is_refused_by_the_name_of_the_parameter(changes, name):
    with pytest.raises(SettingError) as error:
        load(**changes)
    assert error.value.name == name


def test_the_parameters_are_checked_even_while_it_is_off():
    with pytest.raises(SettingError, match="obstacle_shapes"):
        configuration(collision_avoidance=False, obstacle_names=["table"])


def test_all_shapes_can_be_made():
    for shape in SHAPES:
        made = make_obstacle("thing", shape, [0.1] * 3, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        assert made.name == "thing"
