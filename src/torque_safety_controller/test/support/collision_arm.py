# SPDX-License-Identifier: Apache-2.0
"""Arms among obstacles, and a small QP that moves them, for tests of the collision avoidance."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
from arms import Arm, load_arm
from proxsuite import proxqp

from torque_safety_controller.new_robot.capsules import link_capsules
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.avoidance import Collision, CollisionRows
from torque_safety_controller.parts.collision.model import CollisionModel, build_collision_model
from torque_safety_controller.parts.collision.shapes import Shape, capsule, make_obstacle
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.description import build_model, load_geometry
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


def two_links(
    shape: str, reach: float, obstacles, kind="revolute", axis="0 0 1", dt=1e-3, **constants
) -> tuple[Collision, pin.Model]:
    """Return an arm in the x-y plane whose forearm has one collision shape, 20 rad/s^2 a joint."""
    urdf = _TWO_LINKS.format(shape=shape, reach=reach, kind=kind, axis=axis)
    model = build_model(urdf, ["shoulder", "elbow"])
    capsules = link_capsules(model, load_geometry(urdf, model))
    collision = build_collision_model(
        model,
        [capsule("fore", *each) for each in capsules["fore"]],
        np.zeros(2),
        obstacles,
    )
    limit = np.full(2, 20.0)
    return with_constants(Collision(collision, -limit, limit, dt), **constants), model


def with_constants(avoidance: Collision, **constants: float) -> Collision:
    """Change what no setting reaches, to see more in a test."""
    for name, value in constants.items():
        setattr(avoidance, name, value)
    return avoidance


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


def everything() -> Collision:
    """Panda among all obstacles, near and far."""
    return with_constants(panda_avoidance(1000), influence=5.0)


def panda_avoidance(rows_max: int) -> Collision:
    _, limits, collision = panda()
    avoidance = Collision(collision, limits.a_min, limits.a_max, 2e-3)
    return with_constants(avoidance, rows_max=rows_max)


def random_states(count, speed=1.0, seed=0):
    arm = panda()[0]
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(arm.q_min, arm.q_max), speed * rng.uniform(-1.0, 1.0, arm.n)


def wide_rows(avoidance, q, v):
    wide = np.full(len(q), WIDE)
    return avoidance.rows(q, v, -wide, wide)


def least_relaxed(
    a_des: np.ndarray, a_lower: np.ndarray, a_upper: np.ndarray, rows: CollisionRows
) -> np.ndarray:
    """Return the accelerations nearest to those wanted; rows give way only to the bounds."""
    n, k = len(a_des), len(rows.lower)
    nearest = np.clip(a_des, a_lower, a_upper)
    if not k or (rows.G @ nearest >= rows.lower).all():
        return nearest
    H = np.diag(np.r_[np.ones(n), np.full(k, 1e-6)])
    C = np.hstack([rows.G, np.eye(k)])
    qp = proxqp.dense.QP(n + k, 0, k, True)
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-8, 0.0
    free = np.full(k, np.inf)
    qp.init(
        H,
        np.r_[-a_des, np.full(k, 1e4)],
        None,
        None,
        C,
        rows.lower.copy(),
        free,
        np.r_[a_lower, np.zeros(k)],
        np.r_[a_upper, free],
    )
    qp.solve()
    return np.clip(qp.results.x[:n], a_lower, a_upper)


class Journey:
    """An arm on its way to joint goals, kept inside its bounds and away from everything.

    Args:
        avoidance: rows; None to do without.
        limits: of the joints.
        dt: control period, s; the bounds look two of them ahead.
        move: (q, v, a) -> the next state; None: constant acceleration.
    """

    def __init__(self, avoidance, limits: JointLimits, dt: float, move=None) -> None:
        self.avoidance, self.dt = avoidance, dt
        self._bounds = BoundsSolver(limits, 2.0 * dt, period=dt)
        self._move = move or (lambda q, v, a: (q + v * dt + 0.5 * a * dt * dt, v + a * dt))
        self.distances: list[float] = []
        self.viable: list[bool] = []

    def go(self, q: np.ndarray, goal: np.ndarray, duration: float, kp: float = 30.0):
        """Return the state after a while, from rest at q."""
        v = np.zeros(len(q))
        for _ in range(round(duration / self.dt)):
            lower, upper, _ = self._bounds.bounds(q, v)
            rows = self.avoidance.rows(q, v, lower, upper)
            self.distances.append(self.avoidance.closest()[0])
            self.viable.append(bool(rows.viable.all()))
            a = least_relaxed(kp * (goal - q) - 2.0 * np.sqrt(kp) * v, lower, upper, rows)
            q, v = self._move(q, v, a)
        return q, v
