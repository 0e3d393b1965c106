# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: what a physics step costs, and how exactly two solvers solve it."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pinocchio as pin
import yaml

from sim_bridge.bullet.client import pybullet, silenced
from sim_bridge.bullet.joint_friction import JointFriction
from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.obstacles import Obstacle
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.hardware.imperfections import Imperfections
from sim_bridge.hardware.motors import Motors
from viability_bounds_pkg.robot_description import build_model, read_urdf

ROOT = Path(__file__).resolve().parent.parent
H = 1e-3  # s
FRICTION = ("friction_coulomb", "friction_static", "friction_viscous", "stribeck_velocity")
STEPS, ROUNDS = 1000, 9
SOLVERS = {
    "sequential impulses": pybullet.CONSTRAINT_SOLVER_LCP_SI,
    "Dantzig": pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG,
}


class Configured:
    """A robot of ``config/`` and its joint friction; arrays of shape (n,)."""

    def __init__(self, name: str) -> None:
        content = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text())
        values = {k: v for part in content.values() for k, v in part["ros__parameters"].items()}
        self.name, self.joints = name, values["joints"]
        self.urdf = read_urdf(values["robot_description"])
        self.locked = dict(
            zip(values.get("locked_joints", []), values.get("locked_positions", []), strict=True)
        )
        self.q = np.array(values["start_positions"])
        self.tau_max = np.array(values["torque_max"])
        self.friction = {k: v for k, v in values.items() if k in FRICTION}
        self.hand, self.sensor = values["end_effector_frame"], values.get("ft_frame", "")
        self.rotors = values.get("rotor_inertia", 0.0)
        self.masses = dict(
            zip(values.get("mass_scale_links", []), values.get("mass_scales", []), strict=True)
        )

    @property
    def motors(self) -> Motors:
        """Motors with all imperfections."""
        n = np.zeros(len(self.joints))
        imperfections = Imperfections(
            motor_bandwidth=n + 100.0,
            torque_constant_error=n + 0.02,
            torque_ripple=n + 0.01,
            current_noise=n + 0.005,
        )
        return Motors(imperfections, self.tau_max, H)

    def robot(
        self, body: dict[str, object] | None = None, *, masses: bool = False, **friction: object
    ) -> BulletRobot:
        """Return a simulated robot with such joint friction; `body` is what `BulletBody` takes."""
        robot = BulletRobot(
            self.urdf,
            self.joints,
            locked_positions=self.locked,
            physics_dt=H,
            joint_friction=JointFriction(len(self.joints), **friction),
            mass_scales=self.masses if masses else None,
            **(body or {}),
        )
        infinite = np.full(len(self.joints), np.inf)
        robot.monitor = LimitMonitor(-infinite, infinite, infinite, self.tau_max)
        return robot


def cost(arm: Configured, robot: BulletRobot, *, drives: bool = False) -> float:
    """Return microseconds a physics step of a gentle motion, undisturbed."""
    zero, rng = np.zeros(len(arm.joints)), np.random.default_rng(0)
    model = build_model(arm.urdf, arm.joints, arm.locked)
    gravity = pin.computeGeneralizedGravity(model, model.createData(), arm.q)
    best = np.inf
    for _ in range(ROUNDS):
        robot.reset(arm.q, zero)
        tau = gravity + rng.uniform(-0.15, 0.15, zero.size) * arm.tau_max
        goal = arm.q + rng.uniform(-0.2, 0.2, zero.size)
        start = time.perf_counter()
        for _ in range(STEPS):
            if drives:
                robot.move(goal, zero, arm.tau_max, zero + 1.0)
            else:
                robot.step(tau)
        best = min(best, (time.perf_counter() - start) / STEPS)
    return 1e6 * best


def cost_of_pressing(arm: Configured, robot: BulletRobot) -> tuple[float, int, float]:
    """Return microseconds a physics step at rest with the hand on a table.

    Returns:
        That, in how many points it touches, and the force, N.
    """
    zero = np.zeros(len(arm.joints))
    model = build_model(arm.urdf, arm.joints, arm.locked)
    data, frame = model.createData(), model.getFrameId(arm.hand)
    robot.reset(arm.q, zero)
    hand = robot.link_pose(arm.hand).translation
    low = hand - [0.0, 0.0, 0.3]
    robot.obstacles.add(Obstacle("table", "box", [0.4, 0.4, 0.1], low))
    for _ in range(4000):
        q, v, _ = robot.state()
        J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        tau = pin.computeGeneralizedGravity(model, data, q) - 120.0 * J[2] - 5.0 * v
        robot.step(tau)
    best = np.inf
    for _ in range(ROUNDS):
        start = time.perf_counter()
        robot.step(tau, STEPS // 4)
        best = min(best, 4.0 * (time.perf_counter() - start) / STEPS)
    return 1e6 * best, len(robot.obstacles.contacts()), robot.obstacles.force


def surroundings(arm: Configured, friction: dict[str, object]) -> None:
    """Measure and print what shapes, a sensor and obstacles cost."""
    print(f"\nmicroseconds a physics step of {arm.name}")
    cases = {"without shapes": {"collisions": False}, "with shapes": {}}
    if arm.sensor:
        cases["with a sensor, in each step"] = {"sensor_frame": arm.sensor}
    for case, body in cases.items():
        with closing(arm.robot(body, **friction)) as robot:
            print(f"  {case:30s} {cost(arm, robot):6.1f}")
    with closing(arm.robot(**friction)) as robot:
        robot.reset(arm.q, np.zeros(len(arm.joints)))
        for count in (1, 10):
            for i in range(count):
                robot.obstacles.add(Obstacle(f"{i}", "box", [0.1] * 3, [5.0, i, 0.0]))
            print(f"  {f'{count} obstacles, out of reach':30s} {cost(arm, robot):6.1f}")
        robot.obstacles.clear()
        took, points, force = cost_of_pressing(arm, robot)
        print(f"  {'hand on a table':30s} {took:6.1f} ({points} points, {force:.0f} N)")


def choose(robot: BulletRobot, solver: int) -> None:
    """Let PyBullet solve for constraint impulses in that way."""
    with silenced(1):
        pybullet.setPhysicsEngineParameter(
            constraintSolverType=solver, physicsClientId=robot.client_id
        )


def residuals(arm: Configured, solver: int) -> tuple[float, float]:
    """Return how far steps are from solving the equations of motion with rotors and friction.

    Returns:
        The largest error in the torque of friction, over its limit; 0 if the joint that should
        stick does, and the one that slides meets its limit. And what a held joint creeps, rad/s.
    """
    n = len(arm.joints)
    model = build_model(arm.urdf, arm.joints, arm.locked, arm.rotors)
    data, rng = model.createData(), np.random.default_rng(1)
    worst = 0.0
    limit = np.array(arm.friction["friction_coulomb"])
    with closing(arm.robot(rotor_inertia=arm.rotors, friction_coulomb=limit)) as robot:
        choose(robot, solver)
        for _ in range(200):
            q, v = rng.uniform(-1.0, 1.0, n), rng.uniform(-0.2, 0.2, n) * (rng.random(n) < 0.5)
            h = pin.nonLinearEffects(model, data, q, v)
            tau = h + rng.uniform(-0.2, 0.2, n) * arm.tau_max
            robot.reset(q - 0.5 * H * v, v)
            robot.step(tau)
            end = robot.state().v
            friction = pin.crba(model, data, q) @ (end - v) / H + h - tau
            # The natural map of the complementarity problem: zero at its solution only.
            error = friction - np.clip(friction - 1e3 * end, -limit, limit)
            worst = max(worst, float(np.abs(error / limit).max()))
        robot.reset(arm.q, np.zeros(n))
        hold = pin.computeGeneralizedGravity(model, data, arm.q)
        robot.step(hold + 0.5 * limit, 1000)
        return worst, float(np.abs(robot.state().v).max())


def main() -> None:
    """Measure and print."""
    print("microseconds a physics step, monitor included")
    bare = {}
    for name in ("panda", "baxter_left_arm", "talos_left_arm"):
        arm = Configured(name)
        with closing(arm.robot()) as robot:
            bare[name] = cost(arm, robot)
            print(f"  {name:16s} as the URDF has it            {bare[name]:6.1f}")
        with closing(arm.robot({"motors": arm.motors})) as robot:
            print(f"  {'':16s} with imperfect motors         {cost(arm, robot):6.1f}")
        with closing(arm.robot()) as robot:
            print(f"  {'':16s} under its drives              {cost(arm, robot, drives=True):6.1f}")
    cases = {
        "rotors": {"rotor_inertia": arm.rotors},
        "friction": arm.friction,
        "rotors and friction": {"rotor_inertia": arm.rotors, **arm.friction},
    }
    for case, friction in cases.items():
        with closing(arm.robot(**friction)) as robot:
            print(f"  {'':16s} with {case:24s} {cost(arm, robot):6.1f}")
    everything = {"rotor_inertia": arm.rotors, "torque_bias": 0.1, **arm.friction}
    with closing(arm.robot(masses=True, **everything)) as robot:
        took = cost(arm, robot)
        print(
            f"  {'':16s} with everything               {took:6.1f}"
            f" ({took / bare[arm.name]:.1f} times the bare robot)"
        )
        took = cost(arm, robot, drives=True)
        print(f"  {'':16s} with everything, under drives {took:6.1f}")

    print(f"\nrotors and Coulomb friction of {arm.name} by PyBullet's solvers")
    for name, solver in SOLVERS.items():
        with closing(arm.robot(**cases["rotors and friction"])) as robot:
            choose(robot, solver)
            took = cost(arm, robot)
        error, creep = residuals(arm, solver)
        print(
            f"  {name:20s} {took:6.1f} us, error {error:.1e} of the friction,"
            f" a held joint creeps at {creep:.1e} rad/s"
        )
    for name, friction in (("panda", {}), (arm.name, everything)):
        surroundings(Configured(name), friction)


if __name__ == "__main__":
    main()
