# SPDX-License-Identifier: Apache-2.0
"""A model follows the joints that it has locked, where they carry the arm."""

import math

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.robot.configuration import RobotConfiguration
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.locked_joints import LockedJoints
from viability_bounds_pkg.robot.payload import Payload

S = 1_000_000_000  # ns
EXACT = 1e-9  # m, N m; rounding
TIAGO = RobotConfiguration(
    robot_description="package://example-robot-data/robots/tiago_description/robots/tiago.urdf",
    joints=tuple(f"arm_{k}_joint" for k in range(1, 8)),
)
TALOS = RobotConfiguration(
    robot_description="package://example-robot-data/robots/talos_data/robots/talos_full_v2.urdf",
    joints=tuple(f"arm_left_{k}_joint" for k in range(1, 8)),
    locked_joints=("torso_2_joint",),
    locked_positions=np.array([0.1]),
)
HANDS = {TIAGO: "arm_tool_link", TALOS: "wrist_left_ft_tool_link"}
MOVED = {TIAGO: {"torso_lift_joint": 0.3}, TALOS: {"torso_1_joint": -0.3, "torso_2_joint": 0.4}}
OTHERS = {"wheel_left_joint": 5.0, "head_1_joint": 0.4, "arm_right_4_joint": -1.0}
"""They do not carry the arm."""
LIFT = "torso_lift_joint"


def locked(config=TIAGO):
    """Return what keeps a model of the arm, the model, and its load."""
    urdf = config.read_urdf()
    model = build_model(urdf, config.joints, config.locked)
    payload = Payload(model)
    return LockedJoints(config, urdf, model, payload, [HANDS[config]]), model, payload


@pytest.mark.parametrize("config", [TIAGO, TALOS], ids=["lift", "waist"])
def test_the_model_is_one_that_is_locked_where_the_joints_are(config):
    joints, model, payload = locked(config)
    load = HANDS[config], 1.0, np.array([0.0, 0.0, 0.1]), np.zeros((3, 3))
    payload.carry(*load)
    states = MOVED[config] | OTHERS
    assert joints.look(list(states), list(states.values()), S)
    expected = build_model(config.read_urdf(), config.joints, config.locked | MOVED[config])
    Payload(expected).carry(*load)
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v, a = rng.uniform(-1.0, 1.0, (3, 7))
        torques, places = [], []
        for each in (model, expected):
            data = each.createData()
            torques.append(pin.rnea(each, data, q, v, a))
            pin.framesForwardKinematics(each, data, q)
            places.append([place.homogeneous for place in data.oMf])
        np.testing.assert_allclose(*torques, atol=EXACT)
        np.testing.assert_allclose(*places, atol=EXACT)
    assert len(joints.news()) == len(MOVED[config])


def test_who_moves_and_where_it_stands_are_told_once():
    joints, _, _ = locked()
    assert joints.due(S)
    assert joints.look([LIFT], [0.1], S)  # where it is at first
    assert not joints.moving
    assert joints.news() == ["torso_lift_joint at 0.100 m: used in the model"]
    assert joints.news() == []
    assert not joints.due(S + S // 20) and joints.due(S + S // 10) and joints.due(S // 2)
    for k in range(1, 11):  # it is shaken
        assert not joints.look([LIFT], [0.1 + 5e-4 * (-1) ** k], S + k * S // 10)
    assert not joints.moving
    for k in range(1, 6):
        assert joints.look([LIFT], [0.1 + 0.01 * k], 2 * S + k * S // 10)
        assert joints.moving == LIFT
        assert joints.news() == []
    for k in range(6, 10):
        assert not joints.look([LIFT], [0.15], 2 * S + k * S // 10)
        assert joints.moving == LIFT
    assert not joints.look([LIFT], [0.15], 3 * S)
    assert not joints.moving
    assert joints.news() == ["torso_lift_joint at 0.150 m: used in the model"]


def test_a_position_of_one_message_alone_does_not_count():
    joints, model, _ = locked()
    joints.look([LIFT], [0.1], S)
    before = model.copy()
    assert not joints.look([LIFT], [0.65], S + S // 10)
    assert joints.moving == LIFT
    assert not joints.look([LIFT], [0.1], S + 2 * S // 10)
    assert model == before
    assert not joints.look([LIFT], [0.65], S + 3 * S // 10)
    assert joints.look([LIFT], [0.65], S + 4 * S // 10)


@pytest.mark.parametrize(
    ("names", "positions"),
    [(["arm_1_joint"], [0.5]), ([LIFT], [math.nan]), ([LIFT], [300.0]), ([LIFT], []), ([], [])],
)
def test_states_without_the_joints_change_nothing(names, positions):
    joints, model, _ = locked()
    before = model.copy()
    assert not joints.look(names, positions, S)
    assert model == before
    refused = [name for name, _ in zip(names, positions, strict=False) if name == LIFT]
    (line,) = joints.refused() or [""]
    assert all(f"the position of {name} is no number, or beyond" in line for name in refused)
    assert bool(line) == bool(refused)
    assert not joints.refused()
