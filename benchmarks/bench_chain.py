# SPDX-License-Identifier: Apache-2.0
"""State -> limits -> command: the real nodes against nodes that only relay.

The chains are driven in turns by probes, so that what differs is the work of the nodes, and the
way of messages: from node to node as in `safety_stack` ("one process"), by the middleware between
nodes of this process ("middleware"), or between nodes that have a process each ("processes").
Each chain has its own simulated arm, moved outside the measured time: the real chain's by its
commands, through the demo's goals and into the limits; the relays' by gravity compensation. With
``--imperfect`` a further chain has what ``config/imperfect/`` declares, and the estimator node,
by the middleware.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from array import array
from typing import Any

import numpy as np
import pinocchio as pin
import rclpy
from chain import load_node_values, load_values
from geometry_msgs.msg import PoseStamped
from live_robot import goals
from rclpy.signals import SignalHandlerOptions
from relays import RelayCommand, RelayLimits
from sensor_msgs.msg import JointState

from sim_bridge.bullet.robot import BulletRobot
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.arm_node import ArmNode, connect
from viability_bounds_pkg.ros.program import leave, prepared_executor, spin
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import overrides

DT_NS = 1_000_000
WAYS = ("processes", "middleware", "one process")
KINDS = {"real": (BoundsNode, ControllerNode), "relay": (RelayLimits, RelayCommand)}
PROCESSES = multiprocessing.get_context("spawn")
PATIENCE = 10.0  # s
START = 30.0
"""After so long at the latest a chain must answer, s."""


class Probe(ArmNode):
    """Plays the robot: publishes states, notes when the command comes."""

    NAME = "probe"

    def __init__(self, joints: list[str], robot: BulletRobot, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._state = JointState(name=joints, effort=array("d", [0.0] * len(joints)))
        self.robot = robot
        self._stamp = 0
        self.command: array | None = None
        self._publisher = self.stream(JOINT_STATES)
        self.goal = self.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
        self.listen(JOINT_COMMANDS, self._on_command)

    def cycle(self, executor: Any, timeout: float = 1.0) -> float:
        """Send a state, wait for its command, return how long it took, s; NaN if it is lost."""
        self._stamp += DT_NS
        q, v, _ = self.robot.state()
        self.command = None
        start = time.perf_counter()
        self._state.position = array("d", q.tobytes())
        self._state.velocity = array("d", v.tobytes())
        set_stamp(self._state.header.stamp, self._stamp)
        self._publisher.publish(self._state)
        while self.command is None:
            executor.spin_once(timeout_sec=0.01)
            if time.perf_counter() - start > timeout:
                return float("nan")
        return time.perf_counter() - start

    def _on_command(self, message: JointState) -> None:
        self.command = message.effort


def drive(executor: Any, probe: Probe, model: pin.Model, cycles: int) -> list[float]:
    """Return the times of some cycles, s, moving the probe's arm in between."""
    data = model.createData()
    times = []
    for _ in range(cycles):
        times.append(probe.cycle(executor))
        gravity = pin.computeGeneralizedGravity(model, data, probe.robot.state().q)
        commanded = probe.command is not None and any(probe.command)
        probe.robot.step(np.array(probe.command) if commanded else gravity)
    return times


def make_node(kind: Any, namespace: str, values: dict[str, Any]) -> ArmNode:
    """Return a node of a chain, for an arm with the parameters `values`."""
    if kind in KINDS["relay"]:
        relay: ArmNode = kind(values["joints"], namespace=namespace)
        return relay
    patient = {"bounds_timeout": PATIENCE, "state_timeout": PATIENCE}  # while others have a turn
    own = values | patient | {"rate_hz": 1e9 / DT_NS}
    given = overrides({name: value for name, value in own.items() if value != []})
    node: ArmNode = kind(namespace=namespace, parameter_overrides=given)
    return node


def serve(kind: Any, namespace: str, values: dict[str, Any]) -> None:
    """Run a node in a process of its own until that is told to end."""
    as_child()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = make_node(kind, namespace, values)
    spin(prepared_executor([node]), node)
    leave(node)


def make_chains(robot: str, imperfect: bool) -> tuple[dict[str, Probe], list[ArmNode], pin.Model]:
    """Return the probes by the names of their chains, the nodes here, and the arm's model."""
    values = load_values(robot)
    joints, urdf = values["joints"], read_urdf(values["robot_description"])
    nodes: list[ArmNode] = []
    probes: dict[str, Probe] = {}

    def add(name: str, namespace: str) -> Probe:
        arm = BulletRobot(urdf, joints, physics_dt=DT_NS * 1e-9)
        arm.reset(values["start_positions"], np.zeros(len(joints)))
        probes[name] = Probe(joints, arm, namespace=namespace)
        return probes[name]

    for way in WAYS:
        for what, kinds in KINDS.items():
            namespace = f"{what}_{way.replace(' ', '_')}"
            probe = add(f"{what}, {way}", namespace)
            if way == "processes":
                for kind in kinds:
                    arguments = kind, namespace, values
                    PROCESSES.Process(target=serve, args=arguments, daemon=True).start()
                continue
            chain = [make_node(kind, namespace, values) for kind in kinds]
            nodes += chain
            if way == "one process":
                connect([probe, *chain])
    if imperfect:
        own = load_node_values(robot, f"imperfect/{robot}")
        rotors = {"rotor_inertia": values.get("rotor_inertia", [])}  # the probes' robots have none
        add("remedies", "remedies")
        for kind in (EstimatorNode, BoundsNode, ControllerNode):
            nodes.append(make_node(kind, "remedies", own[kind.NAME] | rotors))
    return probes, nodes, build_model(urdf, joints)


def main() -> None:
    """Run the benchmark and print medians, 99th percentiles and ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="panda", help="default: panda, as its step is plain")
    parser.add_argument("--cycles", type=int, default=8000, help="of each chain")
    parser.add_argument("--block", type=int, default=500, help="cycles before the other's turn")
    parser.add_argument("--imperfect", action="store_true", help="also with all remedies")
    options = parser.parse_args()
    options.block = min(options.block, options.cycles)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    probes, nodes, model = make_chains(options.robot, options.imperfect)
    running = [*nodes, *probes.values()]
    executor = prepared_executor(running)
    for name, probe in probes.items():
        deadline = time.monotonic() + START
        while np.isnan(probe.cycle(executor)):
            if time.monotonic() > deadline:
                raise SystemExit(f"the {name} chain does not answer")
    times: dict[str, list[float]] = {name: [] for name in probes}
    messages, blocks = goals(options.robot), options.cycles // options.block
    for block in range(blocks):
        for name, probe in probes.items():
            if not name.startswith("relay"):
                probe.goal.publish(messages[block * len(messages) // blocks])
            times[name] += drive(executor, probe, model, options.block)
    found = {name: 1e6 * np.nanpercentile(each, (50, 99)) for name, each in times.items()}
    for name, (median, slow) in found.items():
        lost = int(np.isnan(times[name]).sum())
        print(f"{name:>18}: median {median:7.1f} us, 99% {slow:7.1f} us, lost {lost}")
    for real, relay in (("one process", "middleware"), *((way, way) for way in WAYS)):
        median, slow = found[f"real, {real}"] / found[f"relay, {relay}"]
        print(f"real, {real} / relay, {relay}: {median:.2f}, 99% {slow:.2f}")
    if options.imperfect:
        ratio = found["remedies"][0] / found["real, middleware"][0]
        print(f"remedies / real, middleware: {ratio:.2f}")
    for node in running:
        node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
