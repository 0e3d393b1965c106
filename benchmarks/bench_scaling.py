# SPDX-License-Identifier: Apache-2.0
"""How the cost of bounds, controller step and chain grows: joints, tasks, contacts, rows.

Arms and upper bodies move to goals at random, by turns, each in closed loop with its model: nodes
of one process, from the state to the command. All have their default task, pose and posture, in
limits of position, speed, acceleration and torque. Then the QP alone, of Panda and of two arms,
with more tasks, contacts and rows of constraints. Times are of the processor for the parts, and by
the wall clock for the chain; exponents are of a power law fitted to medians.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import rclpy
from bench_step import microseconds
from live_robot import load
from rclpy.node import Node
from sensor_msgs.msg import JointState

from torque_safety_controller.contact.contacts import Contacts, FrictionContact
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.qp import (
    AccelerationRange,
    InverseDynamicsQP,
    LinearConstraints,
    TaskTerm,
)
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.robot_description import build_model, read_urdf
from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.runtime import make_executor
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.testing.ros_harness import joint_state, overrides

RATE = 500.0
THIRD = 1e6 / RATE / 3.0
"""What a step of two arms may take, us."""
SIDES = ("left", "right")
BAXTER = [f"{{}}_{joint}" for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]
TALOS = [f"arm_{{}}_{j}_joint" for j in range(1, 8)]
G1_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
G1_ARM += ("wrist_roll", "wrist_pitch", "wrist_yaw")
G1_HAND = [f"hand_{finger}" for finger in ("index_0", "index_1", "middle_0", "middle_1")]
G1_HAND += [f"hand_thumb_{j}" for j in range(3)]


def both(*names: str) -> list[str]:
    """Return names of both sides."""
    return [name.format(side) for side in SIDES for name in names]


ROBOTS = {
    "UR5": (
        "ur_description/urdf/ur5_robot.urdf",
        "tool0",
        [f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow")]
        + [f"wrist_{j}_joint" for j in (1, 2, 3)],
    ),
    "Panda": (
        "panda_description/urdf/panda.urdf",
        "panda_hand",
        [f"panda_joint{j}" for j in range(1, 8)],
    ),
    "TALOS, torso and arm": (
        "talos_data/robots/talos_reduced.urdf",
        "gripper_left_base_link",
        ["torso_1_joint", "torso_2_joint", *(name.format("left") for name in TALOS)],
    ),
    "Baxter, both arms": ("baxter_description/urdf/baxter.urdf", "left_gripper", both(*BAXTER)),
    "TALOS, upper body": (
        "talos_data/robots/talos_reduced.urdf",
        "gripper_left_base_link",
        ["torso_1_joint", "torso_2_joint", *both(*TALOS, "gripper_{}_joint")]
        + ["head_1_joint", "head_2_joint"],
    ),
    "G1, waist, arms, hands": (
        "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
        "left_hand_palm_link",
        ["waist_roll_joint", "waist_pitch_joint"]
        + both(*(f"{{}}_{joint}_joint" for joint in (*G1_ARM, *G1_HAND))),
    ),
}
"""URDF, end effector and joints; all others are locked."""


class Arm(Node):
    """One arm in closed loop: plays the robot, and notes what everything took.

    Args:
        name: of the robot.
        number: makes it the only one of its namespace.

    Attributes:
        n: number of joints.
        model: of the arm.
        times: us, by part.
        tracked: how many commands served the goals, with all limits as they are.
    """

    def __init__(self, name: str, number: int) -> None:
        path, frame, joints = ROBOTS[name]
        urdf = f"package://example-robot-data/robots/{path}"
        self.model = build_model(read_urdf(urdf), joints)
        self.n = n = self.model.nv
        self._names = joints
        self._data = self.model.createData()
        self._rng = np.random.default_rng(number)
        low, high = self.model.lowerPositionLimit, self.model.upperPositionLimit
        self._goals = 0.9 * np.clip(low, -np.pi, np.pi), 0.9 * np.clip(high, -np.pi, np.pi)
        self._q, self._v = 0.5 * sum(self._goals), np.zeros(n)
        frames = self.model.frames
        # Strong enough to hold the arm and to accelerate as declared: what is measured is the
        # cost of a controller that tracks.
        values = {
            "robot_description": urdf,
            "joints": joints,
            "base_frame": next(f.name for f in frames if f.type is pin.FrameType.BODY),
            "end_effector_frame": frame,
            "rate_hz": RATE,
            "position_min": low.tolist(),
            "position_max": high.tolist(),
            "velocity_max": [1.5] * n,
            "torque_max": self._needed().tolist(),
            "acceleration_min": [-10.0] * n,
            "acceleration_max": [10.0] * n,
            "pose_kp": 30.0,
            "pose_kd": -1.0,
            "posture_kp": 10.0,
            "posture_kd": -1.0,
        }
        delivery, namespace = DirectDelivery(), f"arm_{number}"
        super().__init__("robot", namespace=namespace)
        self.direct_delivery = delivery
        self.nodes: list[Any] = [self]
        for kind in (BoundsNode, ControllerNode):
            self.nodes.append(
                kind(
                    namespace=namespace,
                    parameter_overrides=overrides(values),
                    direct_delivery=delivery,
                )
            )
        self.controller = self.nodes[2]._controller
        self.times: dict[str, list[float]] = {"bounds": [], "step": [], "chain": []}
        self.tracked = 0
        bounds = self.nodes[1]._bounds
        self.nodes[1]._bounds = bounds._replace(solve=self._timed(bounds.solve, "bounds"))
        self.controller.step = self._timed(self.controller.step, "step")
        self._publisher = JOINT_STATES.publisher(self)
        self._command: JointState | None = None
        JOINT_COMMANDS.subscription(self, self._on_command)
        self._stamp = 0

    def _needed(self) -> np.ndarray:
        """Return torques for accelerations of 10 rad/s^2 of all joints, in any posture."""
        most = np.ones(self.n)
        for _ in range(200):
            q = self._rng.uniform(*self._goals)
            a = 10.0 * self._rng.choice([-1.0, 1.0], self.n)
            most = np.maximum(most, np.abs(pin.rnea(self.model, self._data, q, 0.0 * a, a)))
        return 1.5 * most

    def _timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            begin = time.thread_time()
            result = function(*arguments)
            self.times[part].append(1e6 * (time.thread_time() - begin))
            if part == "step":
                self.tracked += result.tracking and result.relaxation is None
            return result

        return timed

    def _on_command(self, message: JointState) -> None:
        self._command = message

    def set_goal(self) -> None:
        """Give the controller a pose that it can reach, and a posture."""
        q = self._rng.uniform(*self._goals)
        pin.framesForwardKinematics(self.model, self._data, q)
        frame = self.model.getFrameId(self.controller.robot.frame)
        self.controller.set_pose_goal(self._data.oMf[frame].copy())
        self.controller.set_posture_goal(q)

    def cycle(self, executor: Any) -> None:
        """Play a control period: state, limits, command, motion."""
        self._stamp += round(1e9 / RATE)
        message = joint_state(self._names, self._stamp, self._q, self._v)
        self._command, begin = None, time.perf_counter()
        self._publisher.publish(message)
        while self._command is None:
            executor.spin_once(timeout_sec=0.01)
            if time.perf_counter() - begin > 10.0:
                raise SystemExit(f"error: {self.get_namespace()} does not answer")
        self.times["chain"].append(1e6 * (time.perf_counter() - begin))
        a = pin.aba(self.model, self._data, self._q, self._v, np.array(self._command.effort))
        dt = 1.0 / RATE
        self._q = self._q + dt * self._v + 0.5 * dt * dt * a
        self._v = self._v + dt * a

    def forget(self) -> None:
        """Begin to measure."""
        for times in self.times.values():
            times.clear()
        self.tracked = 0


def joints(cycles: int, block: int) -> dict[str, Arm]:
    """Measure and print how cost grows with the number of joints; return the arms."""
    executor = make_executor()
    arms = {name: Arm(name, number) for number, name in enumerate(ROBOTS)}
    for arm in arms.values():
        for node in arm.nodes:
            executor.add_node(node)
    for turn in range(1 + cycles // block):
        for arm in arms.values():
            if turn == 1:
                arm.forget()
            arm.set_goal()
            for _ in range(block):
                arm.cycle(executor)
    parts = ("bounds", "step", "chain")
    print(
        f"{'us, median and 99%':24}joints" + "".join(f"{part:>15}" for part in parts) + "  served"
    )
    for name, arm in arms.items():
        values = "".join(
            "{:8.0f}{:7.0f}".format(*np.percentile(arm.times[p], (50, 99))) for p in parts
        )
        print(f"{name:24}{arm.n:6}{values}{arm.tracked / len(arm.times['step']):8.0%}")
    sizes = [arm.n for arm in arms.values()]
    medians = {p: [np.median(arm.times[p]) for arm in arms.values()] for p in parts}
    print(f"{'exponent':30}" + "".join(f"{exponent(sizes, medians[p]):8.2f}{'':7}" for p in parts))
    two = float(np.median(arms["Baxter, both arms"].times["step"]))
    print(f"a step of two arms takes {two / THIRD:.2f} of a third of the period at {RATE:g} Hz")
    return arms


def exponent(sizes: list[int], times: list[float]) -> float:
    """Return k of a power law c x^k fitted to times."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def qp_alone(name: str, arm: Arm, rounds: int) -> None:
    """Measure and print how the QP's cost grows with tasks, contacts and rows.

    Tasks have six random rows, constraints are like distances: limited below. In each second
    call other bounds are active.
    """
    rng, n, robot = np.random.default_rng(0), arm.n, arm.controller.robot
    data = robot.model.createData()
    pin.computeJointJacobians(robot.model, data, robot.q)
    pin.forwardKinematics(robot.model, data, robot.q, robot.v, np.zeros(n))
    tau_max = arm.controller.tau_max
    limits = robot.M.copy(), -tau_max - robot.h, tau_max - robot.h
    sides = [
        AccelerationRange(s * 0.5 - np.full(n, 0.1), s * 0.5 + np.full(n, 0.1)) for s in (1, -1)
    ]

    def solve(tasks: int = 2, contacts: int = 0, rows: int = 0) -> Callable[[], None]:
        terms = [TaskTerm(rng.normal(size=(6, n)), rng.normal(size=6), 1.0) for _ in range(tasks)]
        terms.append(TaskTerm(None, np.zeros(n), 1e-3))
        G = rng.normal(size=(rows, n))
        lower = np.minimum(*(G @ (s * np.full(n, 0.5)) for s in (1.0, -1.0))) - 0.2
        held = LinearConstraints(G, lower, np.full(rows, np.inf)) if rows else None
        points = 0.1 * rng.normal(size=(contacts, 3))
        push = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
        touching = None
        if contacts:
            down = [0.0, 0.0, -1.0]
            touching = Contacts(
                robot.model,
                [FrictionContact(robot.frame, point, down, 0.5, 4) for point in points],
            )
            wrenches = [touching.wrench_task(i, push, 1e-3) for i in range(contacts)]
        qp, bounds = InverseDynamicsQP(n), sides.copy()

        def once() -> None:
            bounds.reverse()
            forces = None
            if touching is not None:
                touching.update(data)
                forces = touching.forces(wrenches)
            qp.solve(qp.build(terms, bounds[0], *limits, held, forces))

        return once

    for what, counts in {
        "tasks": (1, 2, 4, 8),
        "contacts": (1, 2, 4),
        "rows": (10, 20, 40, 80),
    }.items():
        took = microseconds({str(c): solve(**{what: c}) for c in counts}, rounds, 50)
        values = "  ".join(f"{count}: {time_us:.0f} us" for count, time_us in took.items())
        print(f"{name:20}{what:10}{exponent(list(counts), list(took.values())):6.2f}   {values}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cycles", type=int, default=3000, help="of each arm")
    parser.add_argument("--block", type=int, default=100, help="cycles before the next one's turn")
    parser.add_argument("--rounds", type=int, default=10, help="for the QP; the best counts")
    options = parser.parse_args()
    rclpy.init(args=["bench_scaling", "--ros-args", "--log-level", "error"])
    print(load())
    arms = joints(options.cycles, options.block)
    print(f"\n{'QP, with pose and posture':30}exponent")
    for name in ("Panda", "Baxter, both arms"):
        qp_alone(name, arms[name], options.rounds)
    for arm in arms.values():
        for node in reversed(arm.nodes):
            node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
