# SPDX-License-Identifier: Apache-2.0
import coal
import numpy as np
import pinocchio as pin
import pytest
from collision_arm import panda

from torque_safety_controller.collision.bodies import box, capsule, half_space, sphere
from torque_safety_controller.collision.capsule_fit import capsules_around, fitted_capsule
from torque_safety_controller.collision.geometry import link_shapes
from torque_safety_controller.collision.model import build_collision_model
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import (
    RobotDescriptionError,
    build_model,
    load_geometry,
    read_urdf,
)
from viability_bounds_pkg.testing.ros_harness import read_config

FEW = 300  # samples

SHAPES = """<robot name="shapes"><link name="base"><inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.3 0 0" rpy="0 0.5 0"/><geometry>{}</geometry></collision>
  </link></robot>"""


def inside(points, capsules, slack=1e-9):
    """Whether each point is in one of the capsules."""
    covered = np.zeros(len(points), dtype=bool)
    for start, end, radius in capsules:
        axis = end - start
        square = axis @ axis
        share = ((points - start) @ axis / square).clip(0.0, 1.0) if square > 0.0 else 0.0
        nearest = start + np.multiply.outer(share, axis)
        covered |= np.linalg.norm(points - nearest, axis=1) <= radius + slack
    return covered


def on_triangles(vertices, triangles, rng, count=4000):
    """Random points of a surface, its corners included."""
    chosen = vertices[triangles[rng.integers(len(triangles), size=count)]]
    points = np.einsum("ki,kij->kj", rng.dirichlet(np.ones(3), size=count), chosen)
    return np.vstack([points, vertices[triangles.ravel()]])


@pytest.mark.parametrize("most", [1, 3])
def test_capsules_cover_the_surfaces_of_all_links(most):
    arm, _, _, geometry = panda()
    rng = np.random.default_rng(1)
    for shape in link_shapes(arm.model, geometry):
        capsules = capsules_around(shape.vertices, shape.triangles, most)
        assert 1 <= len(capsules) <= most
        assert inside(on_triangles(shape.vertices, shape.triangles, rng), capsules).all()


def test_a_bent_shape_takes_two_capsules_that_are_smaller_and_cover_it():
    rod = np.array([[x, y, z] for x in (0.0, 0.6) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[f[0], f[k], f[k + 1]] for f in faces for k in (1, 2)])
    vertices = np.vstack([rod, rod[:, [1, 0, 2]]])  # an L
    triangles = np.vstack([faces, faces + 8])
    whole, parts = capsules_around(vertices, triangles, 1), capsules_around(vertices, triangles, 2)
    assert len(parts) == 2
    assert sum(c.volume for c in parts) < 0.5 * whole[0].volume
    points = on_triangles(vertices, triangles, np.random.default_rng(2))
    assert inside(points, parts).all()


@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_few_points_and_points_of_a_capsule_are_held_tightly(count):
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3))
    assert inside(points, [fitted_capsule(points)]).all()
    directions = rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    along = rng.uniform(size=(3000, 1)) * np.array([0.3, 0.2, -0.1])
    fitted = fitted_capsule(along + 0.1 * directions)
    assert fitted.volume < 1.05 * np.pi * 0.01 * (np.sqrt(0.14) + 0.4 / 3.0)


def test_links_are_never_nearer_than_their_capsules():
    """coal's distance between the meshes themselves, in random configurations."""
    arm, _, collision, geometry = panda()
    data, meshes = arm.model.createData(), geometry.createData()
    names = [arm.model.frames[o.parentFrame].name for o in geometry.geometryObjects]
    rng = np.random.default_rng(3)
    gaps = []
    for _ in range(15):
        q = rng.uniform(arm.q_min, arm.q_max)
        pin.updateGeometryPlacements(arm.model, data, geometry, meshes, q)
        for first, second in (("panda_hand", "panda_link2"), ("panda_link5", "panda_link1")):
            i, j = names.index(first), names.index(second)
            result = coal.DistanceResult()
            true = coal.distance(
                geometry.geometryObjects[i].geometry,
                coal.Transform3s(meshes.oMg[i].rotation, meshes.oMg[i].translation),
                geometry.geometryObjects[j].geometry,
                coal.Transform3s(meshes.oMg[j].rotation, meshes.oMg[j].translation),
                coal.DistanceRequest(),
                result,
            )
            nearest = min(
                _distance(data.oMi, collision.capsules, (a, pa), (b, pb))
                for a, pa in _capsules(arm, collision, first)
                for b, pb in _capsules(arm, collision, second)
            )
            assert nearest <= true + 1e-6
            gaps.append(true - nearest)
    assert np.median(gaps) < 0.05  # nor much too careful


def _capsules(arm, collision, link):
    frame = arm.model.frames[arm.model.getFrameId(link)]
    return [(c, frame.parentJoint) for c in collision.capsules[link]]


def _distance(placements, _, first, second):
    """Between two capsules, by brute force over their axes."""
    (a, i), (b, j) = first, second
    share = np.linspace(0.0, 1.0, 200)[:, None]
    x = (a.start + share * (a.end - a.start)) @ placements[i].rotation.T + placements[
        i
    ].translation
    y = (b.start + share * (b.end - b.start)) @ placements[j].rotation.T + placements[
        j
    ].translation
    # The grid misses the minimum by less than a thousandth of the lengths here.
    least = np.linalg.norm(x[:, None] - y[None], axis=2).min()
    return least - a.radius - b.radius - 1e-3


@pytest.mark.parametrize(
    "geometry, volume",
    [
        ('<box size="0.4 0.1 0.1"/>', 0.004),
        ('<cylinder radius="0.05" length="0.3"/>', 0.3 * np.pi * 0.05**2),
        ('<sphere radius="0.1"/>', 4.0 / 3.0 * np.pi * 1e-3),
    ],
)
def test_shapes_of_a_urdf_are_covered(geometry, volume):
    urdf = SHAPES.format(geometry)
    model = build_model(urdf, ["turn"])
    (shape,) = link_shapes(model, load_geometry(urdf, model))
    assert (shape.link, shape.joint) == ("arm", 1)
    capsules = list(shape.capsules)
    if len(shape.triangles):
        capsules += capsules_around(shape.vertices, shape.triangles, 1)
        points = on_triangles(shape.vertices, shape.triangles, np.random.default_rng(4))
        assert inside(points, capsules).all()
    assert volume * 0.999 <= sum(c.volume for c in capsules) < 4.0 * volume
    assert np.allclose(0.5 * (capsules[0].start + capsules[0].end), [0.3, 0.0, 0.0], atol=0.02)


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


def test_locked_joints_take_their_links_along():
    """TALOS' right arm is locked beside the body; its capsules are where its meshes are."""
    config = read_config("talos_left_arm", "controller_node")
    locked = dict(zip(config["locked_joints"], config["locked_positions"], strict=True))
    urdf = read_urdf(config["robot_description"])
    model = build_model(urdf, config["joints"], locked)
    shapes = link_shapes(model, load_geometry(urdf, model, locked))
    elsewhere = link_shapes(model, load_geometry(urdf, model))
    hands = [
        next(s for s in each if s.link == "gripper_right_base_link")
        for each in (shapes, elsewhere)
    ]
    assert hands[0].joint == model.getJointId("torso_2_joint")
    full = pin.buildModelFromXML(urdf)
    q = pin.neutral(full)
    for name, position in locked.items():
        q[full.joints[full.getJointId(name)].idx_q] = position
    data = full.createData()
    pin.framesForwardKinematics(full, data, q)
    hand = data.oMf[full.getFrameId("gripper_right_base_link")].translation
    torso = data.oMi[full.getJointId("torso_2_joint")]
    away = [np.linalg.norm(s.vertices.mean(axis=0) - torso.actInv(hand)) for s in hands]
    assert away[0] < 0.1 < away[1]


def test_neighbours_and_distant_pairs_are_left_out_and_what_is_near_at_the_start():
    _, _, collision, _ = panda()
    assert "panda_hand - panda_link2" in collision.names
    assert "panda_hand - table" in collision.names
    for name in ("panda_link2 - panda_link1", "panda_hand - panda_link7", "panda_link0 - table"):
        assert name not in collision.names
    assert "panda_link2 - panda_link0" in collision.left_out["far"]
    assert collision.left_out["near at start"] == ["panda_link7 - panda_link5"]


def test_pairs_asked_for_are_kept_even_if_they_seem_needless():
    arm, _, _, geometry = panda()
    pairs = [("panda_hand", "panda_link1"), ("panda_link0", "panda_link2")]
    collision = build_collision_model(arm.model, geometry, arm.q_start, pairs=pairs, samples=FEW)
    assert set(collision.names) == {"panda_hand - panda_link1", "panda_link2 - panda_link0"}


def test_obstacles_are_in_the_base_frame():
    arm, _, _, geometry = panda()
    model = arm.model.copy()
    place = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.5, 0.1, 0.2]))
    model.addFrame(pin.Frame("table_frame", 0, 0, place, pin.FrameType.OP_FRAME))
    things = [
        sphere("ball", [0.1, 0.2, 0.3], 0.1),
        box("block", [0.3, 0.0, 0.1], [0.1, 0.2, 0.3]),
        half_space("floor", [0.0, 0.0, -0.1], [0.0, 0.0, 2.0]),
    ]
    collision = build_collision_model(
        model, geometry, arm.q_start, things, base_frame="table_frame", samples=FEW
    )
    bodies = collision.bodies
    np.testing.assert_allclose(bodies.centre[-3], place.act(np.array([0.1, 0.2, 0.3])))
    np.testing.assert_allclose(bodies.centre[-2], place.act(np.array([0.3, 0.0, 0.1])))
    np.testing.assert_allclose(bodies.rotation[-2], place.rotation)
    normal = place.rotation[:, 2]
    np.testing.assert_allclose(bodies.rotation[-1, :, 2], normal)
    on_floor = place.act(np.array([0.0, 0.0, -0.1]))
    surface = bodies.centre[-1] + bodies.half[bodies.first[-2], 2] * normal
    assert normal @ surface == pytest.approx(normal @ on_floor)


def test_what_cannot_be_is_refused():
    arm, _, _, geometry = panda()

    def build(**changes):
        given = {"q_start": arm.q_start, "samples": FEW, **changes}
        build_collision_model(arm.model, geometry, **given)

    ball = sphere("ball", [1.0, 0.0, 0.0], 0.1)
    for changes, word in (
        ({"q_start": arm.q_start[:3]}, "collision_posture"),
        ({"q_start": np.full(7, np.nan)}, "collision_posture"),
        ({"pairs": [("panda_hand", "hand")]}, "collision_pairs' is 'hand'"),
        ({"pairs": [("panda_hand",)]}, "two links"),
        ({"pairs": [("panda_hand", "panda_link7")]}, "move to each other"),
        ({"base_frame": "nowhere"}, "nowhere"),
        ({"base_frame": "panda_link3"}, "not moved"),
        ({"obstacles": [ball, ball]}, "obstacle_names' is 'ball'"),
        ({"obstacles": [sphere("panda_link1", [1, 0, 0], 0.1)]}, "panda_link1"),
    ):
        with pytest.raises(SettingError, match=word):
            build(**changes)


@pytest.mark.parametrize(
    "make, word",
    [
        (lambda: sphere("s", [0.0, 0.0], 0.1), "start of"),
        (lambda: sphere("s", [0.0, 0.0, np.nan], 0.1), "start of"),
        (lambda: sphere("s", [0.0, 0.0, 0.0], 0.0), "sizes of"),
        (lambda: capsule("c", [0.0] * 3, "abc", 0.1), "end of"),
        (lambda: box("b", [0.0] * 3, [0.1, 0.0, 0.1]), "sizes of"),
        (lambda: box("b", [0.0] * 3, [0.1] * 3, [0.0] * 4), "orientation of"),
        (lambda: half_space("h", [0.0] * 3, [0.0] * 3), "normal of"),
        (lambda: box("", [0.0] * 3, [0.1] * 3), "name of an"),
    ],
)
def test_obstacles_that_cannot_be_are_refused(make, word):
    with pytest.raises(SettingError, match=word):
        make()
