# SPDX-License-Identifier: Apache-2.0
"""Collision avoidance: what a pair and a step cost, and what the capsules add to the links.

For Panda and for TALOS' torso and arm, pairs chosen automatically, among a table, a floor, a pole
and a ball. States are random ones around the start posture, at up to 1 rad/s. With cold caches
means that other data has been read since the last call, as in a control loop. Beside it coal,
called through Pinocchio, for the same capsules and for the convex hulls of the links' meshes.

Whole controller steps with and without collision avoidance are timed in turns, in the states of
one motion to random poses, as its parameter file sets the controller up.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import yaml

from torque_safety_controller.additional_torque import AdditionalTorque
from torque_safety_controller.collision.avoidance import CollisionAvoidance
from torque_safety_controller.collision.bodies import box, capsule, half_space, sphere
from torque_safety_controller.collision.distances import Pairs
from torque_safety_controller.collision.geometry import link_shapes
from torque_safety_controller.collision.model import CollisionModel, build_collision_model
from torque_safety_controller.controller import Controller
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot_description import build_model, load_geometry, read_urdf
from viability_bounds_pkg.state import State

ROOT = Path(__file__).resolve().parent.parent
STATES = 1000
CACHE = 8_000_000  # numbers; more than the last-level cache holds
KINDS = ("two capsules", "capsule and box", "capsule and half space")
SURROUNDINGS = {
    "panda": (
        box("table", [0.6, 0.0, 0.1], [0.4, 1.0, 0.05]),
        half_space("floor", [0.0, 0.0, -0.1], [0.0, 0.0, 1.0]),
        capsule("pole", [0.4, -0.4, 0.0], [0.4, -0.4, 1.0], 0.03),
        sphere("ball", [0.5, 0.4, 0.6], 0.1),
    ),
    "talos_left_arm": (
        box("table", [0.7, 0.3, -0.1], [0.4, 1.0, 0.05]),
        half_space("floor", [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]),
        capsule("pole", [0.4, 0.6, -1.0], [0.4, 0.6, 1.0], 0.03),
        sphere("ball", [0.6, 0.0, 0.3], 0.1),
    ),
}


class CollisionRobot:
    """One robot of ``config/`` with its collision model."""

    def __init__(self, name: str) -> None:
        content = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text())
        values = {k: v for part in content.values() for k, v in part["ros__parameters"].items()}
        locked = dict(
            zip(values.get("locked_joints", []), values.get("locked_positions", []), strict=True)
        )
        urdf = read_urdf(values["robot_description"])
        self.name, self.dt = name, 2.0 / values["rate_hz"]
        self.values = values
        self.model = build_model(urdf, values["joints"], locked, values.get("rotor_inertia"))
        self.geometry = load_geometry(urdf, self.model, locked)
        self.q = np.array(values["start_positions"])
        self.a_min = np.array(values["acceleration_min"])
        self.a_max = np.array(values["acceleration_max"])
        build_collision_model(self.model, self.geometry, self.q)  # compiles
        start = time.perf_counter()
        load_geometry(urdf, self.model, locked)
        self.collision = build_collision_model(
            self.model, self.geometry, self.q, SURROUNDINGS[name]
        )
        self.seconds = time.perf_counter() - start

    def controller(self, collision: CollisionAvoidance | None) -> Controller:
        """Return the controller that its parameter file describes."""
        config = read(ControllerConfiguration, self.values)
        controller = Controller(
            RobotModel(self.model, config.end_effector_frame, config.dt),
            config.torque_max,
            config.gains,
            config.torque_rate_max,
            AdditionalTorque(config.additional),
            config.qp_solver,
            [] if collision is None else [collision],
        )
        controller.warm_up()
        return controller

    def bounds(self):
        """Return the function from a state to bounds that its parameter file describes."""
        return make_bounds(read(BoundsConfiguration, self.values))

    def states(self, speed: float = 1.0) -> list[tuple[np.ndarray, ...]]:
        """Return arguments of `CollisionAvoidance.rows`."""
        rng = np.random.default_rng(0)
        n = len(self.q)
        return [
            (
                self.q + rng.uniform(-0.3, 0.3, n),
                speed * rng.uniform(-1.0, 1.0, n),
                self.a_min,
                self.a_max,
            )
            for _ in range(STATES)
        ]

    def avoidance(self, model: CollisionModel | None = None) -> CollisionAvoidance:
        """Return the rows' source, with the default settings."""
        return CollisionAvoidance(model or self.collision, self.a_min, self.a_max, self.dt)


def kinds(model: CollisionModel) -> np.ndarray:
    """Return the kind of each pair, an index of `KINDS`."""
    bodies, second = model.bodies, model.pairs.second
    solid = bodies.half[bodies.first[second]].all(axis=1)
    return np.where(bodies.plane[second], 2, np.where(solid, 1, 0))


def only(model: CollisionModel, kind: int) -> CollisionModel:
    """Return the model with the pairs of one kind, or with none."""
    mask = kinds(model) == kind
    pairs = Pairs(*(a[mask] for a in model.pairs))
    names = tuple(n for n, kept in zip(model.names, mask, strict=True) if kept)
    return dataclasses.replace(model, pairs=pairs, names=names)


def median_time(function, arguments) -> float:
    """Return the median time of a call, us."""
    times = []
    for each in arguments:
        start = time.perf_counter()
        function(*each)
        times.append(time.perf_counter() - start)
    return 1e6 * statistics.median(times)


def steps(robot: CollisionRobot) -> None:
    """Measure whole steps."""
    flush = np.zeros(CACHE)
    avoidance = robot.avoidance()
    for speed in (0.0, 0.3, 1.0):
        states = robot.states(speed)
        near, rows = [], []
        for state in states:
            rows.append(len(avoidance.rows(*state).lower))
            near.append(np.count_nonzero(np.isfinite(avoidance.distances)))
        cold = []
        for state in states[:40]:
            flush += 1.0
            cold.append(median_time(avoidance.rows, [state]))
        print(
            f"  step at up to {speed:.1f} rad/s: {median_time(avoidance.rows, states):6.1f} us, "
            f"{statistics.median(cold):6.1f} us with cold caches; pairs near {np.mean(near):.1f}, "
            f"rows {np.mean(rows):.2f}, {max(rows)} at most"
        )


def pairs(robot: CollisionRobot) -> None:
    """Measure pairs of each kind: far ones, and near ones with all their features."""
    states = robot.states()
    model = robot.collision
    bare = median_time(robot.avoidance(only(model, -1)).rows, states)
    print(f"  without pairs: {bare:.1f} us (kinematics, and what Python takes)")
    for kind, name in enumerate(KINDS):
        part = only(model, kind)
        count = len(part.names)
        if not count:
            continue
        costs = {}
        for label, influence in (("far", 1e-1), ("near", 50.0)):
            avoidance = robot.avoidance(part)
            avoidance._use(avoidance._work._replace(influence=influence))
            still = [(q, 0.0 * v, low, high) for q, v, low, high in states]
            time_ = median_time(avoidance.rows, still)
            costs[label] = (time_ - bare) / count
        print(
            f"  {name:<22} {count:4d} pairs: {costs['near']:5.2f} us each with all its features, "
            f"{costs['far']:5.2f} us with most of them far"
        )


def controllers(robot: CollisionRobot, goals: int = 5, duration: float = 1.0) -> None:
    """Measure controller steps with and without collision avoidance, in turns."""
    avoidance = robot.avoidance()
    pair = {"with": robot.controller(avoidance), "without": robot.controller(None)}
    bounds, dt = robot.bounds(), pair["with"].robot.dt
    rng = np.random.default_rng(0)
    q, v = robot.q.copy(), np.zeros(len(robot.q))
    low, high = robot.values["position_min"], robot.values["position_max"]
    data = robot.model.createData()
    frame = robot.model.getFrameId(robot.values["end_effector_frame"])
    times: dict[str, list[float]] = {"with": [], "without": []}
    rows = []
    for step in range(round(goals * duration / dt)):
        if step % round(duration / dt) == 0:
            pin.framesForwardKinematics(robot.model, data, rng.uniform(low, high))
            for controller in pair.values():
                controller.set_pose_goal(data.oMf[frame].copy())
        lower, upper, _ = bounds(q, v)
        for name in pair if step % 2 else reversed(pair):
            start = time.perf_counter()
            answer = pair[name].step(State(q, v), AccelerationRange(lower, upper))
            times[name].append(time.perf_counter() - start)
            if name == "with":
                a = answer.a
        rows.append(avoidance.count)
        q, v = q + v * dt + 0.5 * a * dt * dt, v + a * dt
    medians = {name: 1e6 * statistics.median(each) for name, each in times.items()}
    slow = {name: 1e6 * float(np.percentile(each, 99)) for name, each in times.items()}
    ratio = statistics.median(a / b for a, b in zip(times["with"], times["without"], strict=True))
    print(
        f"  controller step: {medians['with']:.0f} us with, {medians['without']:.0f} us without "
        f"(99%: {slow['with']:.0f} and {slow['without']:.0f} us), {ratio:.2f} times as long in "
        f"the median; rows {np.mean(rows):.1f}, {max(rows)} at most"
    )


def coal_pairs(robot: CollisionRobot) -> None:
    """Measure coal on the same pairs of capsules, and on hulls of the same links."""
    model, bodies = robot.collision, robot.collision.bodies
    for label in ("capsules", "convex hulls"):
        geometry = pin.GeometryModel()
        if label == "capsules":
            for i, (j, R, p, r) in enumerate(
                zip(bodies.joint, bodies.rotation, bodies.centre, bodies.radius, strict=True)
            ):
                shape = coal.Capsule(float(r), 2.0 * bodies.half[bodies.first[i], 2])
                geometry.addGeometryObject(
                    pin.GeometryObject(str(i), int(j), 0, pin.SE3(R, p), shape)
                )
            chosen = kinds(model) == 0
            for i, j in zip(model.pairs.first[chosen], model.pairs.second[chosen], strict=True):
                geometry.addCollisionPair(pin.CollisionPair(int(i), int(j)))
        else:
            index = {}
            for item in robot.geometry.geometryObjects:
                if isinstance(item.geometry, coal.BVHModelBase):
                    item.geometry.buildConvexRepresentation(False)
                    hull = item.geometry.convex
                    link = robot.model.frames[item.parentFrame].name
                    index[link] = geometry.addGeometryObject(
                        pin.GeometryObject(link, item.parentJoint, 0, item.placement, hull)
                    )
            for name in dict.fromkeys(model.names):
                first, second = name.split(" - ")
                if first in index and second in index:
                    geometry.addCollisionPair(pin.CollisionPair(index[first], index[second]))
        count = len(geometry.collisionPairs)
        data, meshes = robot.model.createData(), geometry.createData()
        states = [state[:1] for state in robot.states()]

        def every(q, data=data, geometry=geometry, meshes=meshes):
            pin.updateGeometryPlacements(robot.model, data, geometry, meshes, q)
            pin.computeDistances(geometry, meshes)

        def single(q, count=count, geometry=geometry, meshes=meshes):
            for k in range(count):
                pin.computeDistance(geometry, meshes, k).getNearestPoint1()

        print(
            f"  coal, {label:<13} {count:4d} pairs: {median_time(every, states) / count:5.2f} us "
            f"each by computeDistances, {median_time(single, states[:200]) / count:5.2f} us one "
            "by one with a witness point"
        )


def excess(robot: CollisionRobot) -> None:
    """Print how far capsules stand out of their links."""
    ball = coal.Sphere(1e-6)
    rng = np.random.default_rng(0)
    worst, means = ("", 0.0), []
    for shape in link_shapes(robot.model, robot.geometry):
        if not len(shape.triangles):
            continue
        mesh = coal.BVHModelOBBRSS()
        mesh.beginModel(len(shape.triangles), len(shape.vertices))
        mesh.addVertices(shape.vertices)
        for triangle in shape.triangles:
            mesh.addTriangle(*shape.vertices[triangle])
        mesh.endModel()
        gaps = []
        for start, end, radius in robot.collision.capsules[shape.link]:
            directions = rng.normal(size=(60, 3))
            directions /= np.linalg.norm(directions, axis=1)[:, None]
            points = start + rng.uniform(size=(60, 1)) * (end - start) + radius * directions
            for point in points:
                result = coal.DistanceResult()
                place = coal.Transform3s(np.eye(3), point)
                request = coal.DistanceRequest()
                gaps.append(coal.distance(mesh, coal.Transform3s(), ball, place, request, result))
        means.append(np.mean(gaps))
        if max(gaps) > worst[1]:
            worst = (shape.link, max(gaps))
    print(
        f"  capsules stand out of the meshes by {1e3 * np.mean(means):.0f} mm on average over the "
        f"links, {1e3 * worst[1]:.0f} mm at most ({worst[0]})"
    )


def main() -> None:
    """Measure and print."""
    for name in SURROUNDINGS:
        robot = CollisionRobot(name)
        model = robot.collision
        capsules = sum(len(c) for c in model.capsules.values())
        out = ", ".join(f"{len(names)} {reason}" for reason, names in model.left_out.items())
        print(
            f"{name}: {len(model.capsules)} links, {capsules} capsules, {len(model.names)} pairs; "
            f"left out: {out}; built in {robot.seconds:.1f} s"
        )
        print("  not guarded:", ", ".join(model.left_out.get("near at start", [])) or "none")
        excess(robot)
        steps(robot)
        controllers(robot)
        pairs(robot)
        coal_pairs(robot)


if __name__ == "__main__":
    main()
