# SPDX-License-Identifier: Apache-2.0
"""Panda and TALOS under torque control among obstacles: their own meshes tell the distances."""

import coal
import numpy as np
import pinocchio as pin
import yaml
from direct import DirectLoop, column

from sim_bridge.scenario.events import AddObstacle, PoseGoal
from sim_bridge.scenario.scenario import load_scenario
from torque_safety_controller.parts.collision.avoidance import Collision
from viability_bounds_pkg.robot.description import load_geometry
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import config_folder

MARGIN = 0.02  # m
RESERVE = 0.002  # m; not to be used up by much
URDF = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"


class Meshes:
    """Distances by coal between the links' meshes themselves, and to obstacles."""

    def __init__(self, model, urdf, obstacles):
        self.model, self.data = model, model.createData()
        self.geometry = load_geometry(urdf, model)
        self.places = self.geometry.createData()
        self.by_link = {}
        for i, item in enumerate(self.geometry.geometryObjects):
            self.by_link.setdefault(model.frames[item.parentFrame].name, []).append(i)
        self.obstacles = {
            o.name: (
                coal.Box(*o.size) if o.shape == "box" else coal.Cylinder(o.size[0] / 2, o.size[2]),
                coal.Transform3s(np.eye(3), np.array(o.position)),
            )
            for o in obstacles
        }

    def _shapes(self, name):
        if name in self.obstacles:
            return [self.obstacles[name]]
        return [
            (
                self.geometry.geometryObjects[i].geometry,
                coal.Transform3s(self.places.oMg[i].rotation, self.places.oMg[i].translation),
            )
            for i in self.by_link[name]
        ]

    def least(self, q, pairs):
        """The least distance of pairs ``first - second``, m."""
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.places, q)
        return min(
            coal.distance(*a, *b, coal.DistanceRequest(), coal.DistanceResult())
            for first, second in (pair.split(" - ") for pair in pairs)
            for a in self._shapes(first)
            for b in self._shapes(second)
        )


def play(loop, duration, events=()):
    """Play on; return the distances that the controller kept, and the most contacts."""
    distances, contacts, end = [], 0, loop.t + duration
    pending = list(events)
    while loop.t < end - 0.5 * loop.dt:
        while pending and pending[0].time <= loop.t + 1e-9:
            event = pending.pop(0)
            if isinstance(event, AddObstacle):
                loop.robot.obstacles.add(event.obstacle)
            elif isinstance(event, PoseGoal):
                rotation = pin.Quaternion(np.array(event.orientation)).toRotationMatrix()
                goal = pin.SE3(rotation, np.array(event.position))
                loop.controller.goals.set_pose(goal)
        loop.step()
        if loop.controller.find(Collision):
            distances.append(loop.controller.find(Collision).closest()[0])
        contacts = max(contacts, len(loop.robot.obstacles.contacts()))
    return np.array(distances), contacts


def assert_no_limit_broken(loop):
    monitor = loop.robot.monitor
    assert monitor.max_position_violation.max() == 0.0
    assert monitor.max_velocity_violation.max() <= 1e-9
    assert monitor.max_torque_ratio.max() <= 1.0 + 1e-9


def around_the_wall():
    scenario = load_scenario(config_folder() / "scenarios" / "panda_behind_obstacle.yaml")
    document = yaml.safe_load((config_folder() / "obstacles" / "panda_wall.yaml").read_text())
    return scenario, document["/**/controller_node"]["ros__parameters"]


def test_goals_behind_obstacles_and_inside_the_arm_end_at_rest_at_the_margin():
    scenario, known = around_the_wall()
    loop = DirectLoop("panda", known)
    distances, contacts = play(loop, scenario.duration, scenario.events)
    assert contacts == 0
    assert distances.min() > MARGIN + RESERVE - 1e-5
    obstacles = [e.obstacle for e in scenario.events if isinstance(e, AddObstacle)]
    meshes = Meshes(loop.model, read_urdf(URDF), obstacles)
    pairs = set(loop.controller.find(Collision).model.names)
    q, v = column(loop.samples, "q"), column(loop.samples, "v")
    nearest = np.argsort(distances)[:: len(distances) // 40]
    assert min(meshes.least(q[k], pairs) for k in nearest) > MARGIN
    for t in (4.0, 9.0, scenario.duration):
        k = round(t / loop.dt) - 1
        assert distances[k] < MARGIN + RESERVE + 1e-3, "nothing was in the way"
        assert np.abs(v[k - 50 : k]).max() < 0.02  # rad/s
    assert np.linalg.norm(loop.samples[-1].error[:3]) > 0.1
    assert_no_limit_broken(loop)


def test_without_collision_avoidance_the_same_goal_runs_the_arm_into_the_wall():
    scenario, _ = around_the_wall()
    loop = DirectLoop("panda")
    _, contacts = play(loop, 1.5, scenario.events)
    assert contacts > 0


def test_an_arm_that_overlaps_an_obstacle_at_start_moves_out():
    floor = "{name: floor, shape: half_space, position: [0.0, 0.0, 0.52]}"
    loop = DirectLoop("panda", {"collision_avoidance": True, "obstacles": [floor]})
    distances, _ = play(loop, 2.0)
    assert distances[0] < -0.049
    out = int(np.argmax(distances > MARGIN - 1e-4))
    assert 0.2 < out * loop.dt < 1.0  # s
    assert distances[out:].min() > MARGIN - 2e-4
    assert np.abs(loop.samples[-1].v).max() < 0.02
    assert_no_limit_broken(loop)


def test_talos_reaches_the_goal_of_its_demo_and_keeps_itself_apart():
    events = load_scenario(config_folder() / "scenarios" / "talos_left_arm_demo.yaml").events
    loop = DirectLoop("talos_left_arm", {"collision_avoidance": True})
    distances, _ = play(loop, 2.0, events[:1])
    assert distances.min() > MARGIN
    assert distances.min() < MARGIN + 2.0 * RESERVE, "nothing was in the way"
    assert np.linalg.norm(loop.samples[-1].error[:3]) < 5e-3
    assert_no_limit_broken(loop)


def test_a_push_into_the_wall_is_countered():
    scenario, known = around_the_wall()
    loop = DirectLoop("panda", known)
    play(loop, 1.5, [e for e in scenario.events if e.time == 0.0])
    loop.robot.apply_wrench("panda_link6", [12.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    distances, contacts = play(loop, 0.5)
    assert contacts == 0
    assert distances.min() > MARGIN
    assert distances.max() < MARGIN + 2.0 * RESERVE


def test_distances_that_contradict_each_other_give_way_before_the_joints_bounds():
    """Between a floor and a ceiling that both overlap the hand."""
    known = {
        "collision_avoidance": True,
        "obstacles": [
            "{name: floor, shape: half_space, position: [0, 0, 0.54]}",
            f"{{name: ceiling, shape: half_space, position: [0, 0, 0.64], rpy: [{np.pi}, 0, 0]}}",
        ],
    }
    loop = DirectLoop("panda", known)
    relaxed = 0
    for _ in range(200):
        step = loop.step()
        if step.solution.constraint_relaxation is not None:
            relaxed += step.solution.constraint_relaxation.max() > 0.0
            assert step.relaxation.max() < 1e-3  # rad/s^2
    assert relaxed > 50
    assert_no_limit_broken(loop)
