# SPDX-License-Identifier: Apache-2.0
"""A load is a body of the model, and what cannot be one is refused."""

import math

import numpy as np
import pinocchio as pin
import pytest

from viability_bounds_pkg.robot.description import build_model, frame_id
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.robot.payload import Payload, PayloadError
from viability_bounds_pkg.testing.ros_harness import read_config

CONFIG = read_config("panda", "controller_node")
HAND, CENTRE, MOMENTS = "panda_hand", np.array([0.01, -0.02, 0.1]), np.diag([3e-3, 4e-3, 5e-3])
EXACT = 1e-9  # N m; rounding


def panda():
    return build_model(read_urdf(CONFIG["robot_description"]), CONFIG["joints"])


def with_body(link, mass, centre=CENTRE, moments=MOMENTS):
    """Return Panda's model with a body appended by Pinocchio."""
    model = panda()
    frame = model.frames[frame_id(model, link)]
    body = pin.Inertia(mass, centre, moments)
    model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    return model


def assert_same_dynamics(model, expected):
    rng = np.random.default_rng(0)
    for _ in range(5):
        q, v, a = rng.uniform(-1.0, 1.0, (3, model.nv))
        found, wanted = (pin.rnea(each, each.createData(), q, v, a) for each in (model, expected))
        np.testing.assert_allclose(found, wanted, atol=EXACT)


def test_a_load_is_a_body_of_the_model_until_the_next_one():
    model = panda()
    load = Payload(model)
    assert str(load) == "none"
    assert load.carry(HAND, 2.0, CENTRE, MOMENTS)
    assert not load.carry(HAND, 2.0, CENTRE, MOMENTS)
    assert str(load) == "2.00 kg at panda_hand"
    assert_same_dynamics(model, with_body(HAND, 2.0))
    assert load.carry("panda_link4", 1.0, CENTRE, np.zeros((3, 3)))
    assert_same_dynamics(model, with_body("panda_link4", 1.0, moments=np.zeros((3, 3))))
    assert load.carry("", 0.0, np.zeros(3), np.zeros((3, 3)))
    assert_same_dynamics(model, panda())


def test_what_hangs_on_a_link():
    """As a sensor there feels it: Panda's hand hangs on its eighth link, turned."""
    model = panda()
    load = Payload(model)
    assert load.beyond("panda_link8").mass == 0.0
    load.carry(HAND, 2.0, CENTRE, MOMENTS)
    frames = model.frames
    at_hand = frames[frame_id(model, "panda_link8")].placement.actInv(
        frames[frame_id(model, HAND)].placement
    )
    np.testing.assert_allclose(load.beyond("panda_link8").lever, at_hand.act(CENTRE))
    load.carry("panda_link7", 2.0, CENTRE, MOMENTS)
    assert load.beyond("panda_link8").mass == 0.0
    load.carry("panda_link6", 2.0, CENTRE, MOMENTS)
    assert load.beyond("panda_link8").mass == 0.0


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"mass": math.nan}, "numbers are not all finite"),
        ({"centre": [0.0, math.inf, 0.0]}, "numbers are not all finite"),
        ({"mass": -1.0}, "mass is -1 kg; allowed: 0 to 1"),
        ({"mass": 2000.0}, "mass is 2000 kg; allowed: 0 to 1"),  # g
        ({"centre": [0.0, 0.0, 100.0]}, "centre of mass is 100 m from the link"),  # mm
        ({"moments": np.diag([0.01, 0.01, -0.01])}, "moments of inertia are of no body"),
        ({"moments": np.diag([0.01, 0.01, 0.03])}, "moments of inertia are of no body"),
        ({"moments": 3000.0 * np.eye(3)}, "moments of inertia are of no body"),  # kg mm^2
        ({"link": "panda_hnad"}, "allowed: a link that moves; did you mean 'panda_hand'"),
        ({"link": "panda_link0"}, "allowed: a link that moves"),
        ({"link": "panda_joint7"}, "allowed: a link that moves"),
        ({"link": ""}, "allowed: a link that moves: panda_link1, "),
    ],
)
def test_what_no_arm_carries_is_refused_and_changes_nothing(changed, words):
    model = panda()
    load = Payload(model)
    load.carry(HAND, 2.0, CENTRE, MOMENTS)
    given = {"link": HAND, "mass": 1.0, "centre": CENTRE, "moments": MOMENTS} | changed
    with pytest.raises(PayloadError, match=words):
        load.carry(**given)
    assert_same_dynamics(model, with_body(HAND, 2.0))
