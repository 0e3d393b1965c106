# SPDX-License-Identifier: Apache-2.0
"""Arms among obstacles, for tests of the collision avoidance."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
from arms import Arm, load_arm
from controllers import posture_only

from torque_safety_controller.controller import Controller
from torque_safety_controller.new_robot.capsules import link_capsules
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.avoidance import Collision
from torque_safety_controller.parts.collision.model import CollisionModel, build_collision_model
from torque_safety_controller.parts.collision.shapes import Shape, capsule, make_obstacle
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import critical_damping
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.description import build_model, load_geometry
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.viability import BoundsSolver


def box(name, centre, size, orientation=(0.0, 0.0, 0.0, 1.0)) -> Shape:
    return make_obstacle(name, "box", size, centre, orientation)


def sphere(name, centre, radius) -> Shape:
    return make_obstacle(name, "sphere", [2.0 * radius] * 3, centre)


def half_space(name, point, normal) -> Shape:
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(normal))
    return make_obstacle(name, "half_space", [], point, turn.coeffs())


SURROUNDINGS = (
    box("table", [0.7, 0.0, 0.2], [0.4, 1.0, 0.05], [0.1, 0.2, 0.3, 1.0]),
    half_space("floor", [0.0, 0.0, -0.2], [0.0, 0.1, 1.0]),
    sphere("ball", [0.5, 0.3, 0.5], 0.1),
    capsule("pole", [0.4, -0.3, 0.0], [0.5, -0.3, 1.0], 0.04),
)

BALL = '<sphere radius="0.05"/>'
ROD = '<cylinder radius="0.05" length="0.4"/>'
WIDE = 1e6  # rad/s^2; with such bounds no row is implied by them

_TWO_LINKS = """<robot name="two_links">
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"
    ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="100" velocity="5"/></joint>
  <link name="upper"><inertial><origin xyz="0.25 0 0"/><mass value="1"/><inertia ixx="0.01"
    iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="elbow" type="{kind}"><parent link="upper"/><child link="fore"/>
    <origin xyz="0.5 0 0"/><axis xyz="{axis}"/>
    <limit lower="-3" upper="3" effort="100" velocity="5"/></joint>
  <link name="fore"><inertial><origin xyz="0.2 0 0"/><mass value="1"/><inertia ixx="0.01"
    iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="{reach} 0 0" rpy="0 1.5707963267948966 0"/>
      <geometry>{shape}</geometry></collision></link>
</robot>"""


@cache
def panda(obstacles: bool = True) -> tuple[Arm, JointLimits, CollisionModel]:
    """Return Panda with its limits and its collision model."""
    arm = load_arm("panda")
    config, bounds = (read_config("panda", node) for node in ("controller_node", "bounds_node"))
    limits = JointLimits(
        tuple(config["joints"]),
        arm.q_min,
        arm.q_max,
        arm.v_max,
        np.array(bounds["acceleration_min"]),
        np.array(bounds["acceleration_max"]),
    )
    surroundings = SURROUNDINGS if obstacles else ()
    capsules = read(ControllerConfiguration, config).collision.capsules
    collision = build_collision_model(arm.model, capsules, arm.q_start, surroundings)
    return arm, limits, collision


def two_links(
    shape: str, reach: float, obstacles, kind="revolute", axis="0 0 1", dt=1e-3, **constants
) -> tuple[Collision, pin.Model]:
    """Return an arm in the x-y plane whose forearm has one collision shape, 20 rad/s^2 a joint.

    Args:
        shape: of the forearm, as in a URDF.
        reach: where its middle is from the elbow, m.
        obstacles: around it.
        kind: of the second joint.
        axis: of that.
        dt: how long an acceleration is held, s.
        constants: attributes of `Collision` to change.
    """
    urdf = _TWO_LINKS.format(shape=shape, reach=reach, kind=kind, axis=axis)
    model = build_model(urdf, ["shoulder", "elbow"])
    capsules = link_capsules(model, load_geometry(urdf, model))
    links = [capsule("fore", *each) for each in capsules["fore"]]
    collision = build_collision_model(model, links, np.zeros(2), obstacles)
    limit = np.full(2, 20.0)
    return with_constants(Collision(collision, -limit, limit, dt), **constants), model


def with_constants(avoidance: Collision, **constants: float) -> Collision:
    for name, value in constants.items():
        setattr(avoidance, name, value)
    return avoidance


def panda_avoidance(**constants: float) -> Collision:
    """Panda among all obstacles."""
    _, limits, collision = panda()
    return with_constants(Collision(collision, limits.a_min, limits.a_max, 2e-3), **constants)


def everything() -> Collision:
    """Panda among all obstacles, near and far."""
    return panda_avoidance(rows_max=1000, influence=5.0)


def random_states(count, speed=1.0, seed=0):
    arm = panda()[0]
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(arm.q_min, arm.q_max), speed * rng.uniform(-1.0, 1.0, arm.n)


def wide_rows(avoidance, q, v):
    wide = np.full(len(q), WIDE)
    return avoidance.rows(q, v, -wide, wide)


class Journey:
    """An arm on its way to joint goals, kept inside its bounds and away from everything.

    Args:
        avoidance: the part under test.
        robot: model of the arm.
        limits: of the joints.
        move: (q, v, step) -> the next state; None: the accelerations chosen.
        kp: stiffness towards the goals, 1/s^2.
    """

    def __init__(
        self, avoidance: Collision, robot: RobotModel, limits: JointLimits, move=None, kp=30.0
    ) -> None:
        self.avoidance, self._dt = avoidance, robot.dt
        self._bounds = BoundsSolver(limits, 2.0 * robot.dt, period=robot.dt)
        self._move = move or (lambda q, v, step: State(q, v).after(step.a, robot.dt))
        goals = Goals(robot.n, posture_only(kp, critical_damping(kp)))
        parts = [goals, JointBounds(), avoidance]
        self._controller = Controller(robot, parts, np.full(robot.n, 1e4))
        self.distances: list[float] = []
        self.viable: list[bool] = []

    def go(self, q: np.ndarray, goal: np.ndarray, duration: float):
        """Return the state after a while, from rest at q."""
        v = np.zeros(len(q))
        self._controller.reset(q)
        self._controller.goals.set_posture(goal)
        for _ in range(round(duration / self._dt)):
            lower, upper, _ = self._bounds.bounds(q, v)
            step = self._controller.step(State(q, v), AccelerationRange(lower, upper))
            self.distances.append(self.avoidance.closest()[0])
            self.viable.append(self.avoidance.viable)
            q, v = self._move(q, v, step)
        return q, v
