# SPDX-License-Identifier: Apache-2.0
"""State -> limits -> command in one process: the real nodes against nodes that only relay.

All chains live in one process on one executor, and are driven in turns by the same probe, so that
what differs is the work of the nodes, and the way of messages: from node to node as in
`safety_stack` ("one process"), or by the middleware. Each chain has its own simulated arm, moved
outside the measured time: the real chain's by its commands, through the demo's goals and into the
limits; the relays' by gravity compensation. The first cycles of a turn take two to five times as
long, because the caches hold another chain; turns are so long that these are less than a percent.
With ``--imperfect`` a further chain has what ``config/imperfect/`` declares, and the estimator
node, with messages by the middleware.
"""

from __future__ import annotations

import argparse
import os
import time
from array import array
from pathlib import Path

import numpy as np
import pinocchio as pin
import rclpy
import yaml
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from relays import RelayCommand, RelayLimits
from sensor_msgs.msg import JointState

from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.scenario.events import PoseGoal
from sim_bridge.scenario.scenario import load_scenario
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.ros.arm_node import ArmNode, connect
from viability_bounds_pkg.ros.runtime import GOAL_QOS, make_executor, set_stamp
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES

ROOT = Path(__file__).resolve().parent.parent
DT_NS = 1_000_000
WAYS = ("middleware", "one process")
KINDS = ("real", "relay")


class Probe(ArmNode):
    """Plays the robot: publishes states, notes when the command comes."""

    NAME = "probe"

    def __init__(self, joints: list[str], robot: BulletRobot, **arguments) -> None:
        super().__init__(**arguments)
        self._state = JointState(name=joints, effort=array("d", [0.0] * len(joints)))
        self.robot = robot
        self._stamp = 0
        self.command: array | None = None
        self._publisher = self.stream(JOINT_STATES)
        self._goal = self.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
        self.listen(JOINT_COMMANDS, self._on_command)

    def set_goal(self, goal: PoseGoal) -> None:
        """Give the controller something to track."""
        message = PoseStamped()
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = goal.position
        o.x, o.y, o.z, o.w = goal.orientation
        self._goal.publish(message)

    def cycle(self, executor, timeout: float = 1.0) -> float:
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


def parameters(robot: str) -> dict:
    """Return the parameters of all nodes in a robot's file, by name."""
    content = yaml.safe_load((ROOT / "config" / f"{robot}.yaml").read_text())
    return {
        name: value for part in content.values() for name, value in part["ros__parameters"].items()
    }


def remedies(robot: str, node: str) -> dict:
    """Return the parameters of a node with what is declared for the imperfect robot.

    Without rotors, which the probes' robots do not have.
    """
    values: dict = {}
    for name in (robot, f"imperfect/{robot}"):
        content = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text())
        for section in ("/**", f"/**/{node}"):
            values |= content.get(section, {}).get("ros__parameters", {})
    return values | {"rotor_inertia": parameters(robot).get("rotor_inertia", [])}


def overridden(values: dict) -> list[Parameter]:
    """Return parameters for a node of a chain."""
    values = values | {"bounds_timeout": 1.0, "rate_hz": 1e9 / DT_NS}
    return [Parameter(name, value=value) for name, value in values.items() if value != []]


def drive(executor, probe: Probe, model, cycles: int) -> list[float]:
    """Return the times of some cycles, s, moving the probe's arm in between."""
    data = model.createData()
    times = []
    for _ in range(cycles):
        times.append(probe.cycle(executor))
        gravity = pin.computeGeneralizedGravity(model, data, probe.robot.state().q)
        commanded = probe.command is not None and any(probe.command)
        probe.robot.step(np.array(probe.command) if commanded else gravity)
    return times


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
    values = parameters(options.robot)
    joints = values["joints"]
    urdf = read_urdf(values["robot_description"])
    model = build_model(urdf, joints)
    scenario = load_scenario(ROOT / "config" / "scenarios" / f"{options.robot}_demo.yaml")
    goals = [event for event in scenario.events if isinstance(event, PoseGoal)]

    def make_robot() -> BulletRobot:
        robot = BulletRobot(urdf, joints, physics_dt=DT_NS * 1e-9)
        robot.reset(values["start_positions"], np.zeros(len(joints)))
        return robot

    nodes: list[Node] = []
    probes: dict[str, Probe] = {}
    for way in WAYS:
        real, relay = ({"namespace": f"{kind}_{way.replace(' ', '_')}"} for kind in KINDS)
        given = real | {"parameter_overrides": overridden(values)}
        for name, chain in (
            (f"real, {way}", [BoundsNode(**given), ControllerNode(**given)]),
            (f"relay, {way}", [RelayLimits(joints, **relay), RelayCommand(joints, **relay)]),
        ):
            namespace = real if name.startswith("real") else relay
            probes[name] = Probe(joints, make_robot(), **namespace)
            if way == "one process":
                connect([probes[name], *chain])
            nodes += chain
    if options.imperfect:
        for kind in (EstimatorNode, BoundsNode, ControllerNode):
            own = overridden(remedies(options.robot, kind.NAME))
            nodes.append(kind(namespace="remedies", parameter_overrides=own))
        probes["remedies"] = Probe(joints, make_robot(), namespace="remedies")
    executor = make_executor()
    running: list[Node] = [*nodes, *probes.values()]
    for node in running:
        executor.add_node(node)
    for name, probe in probes.items():
        deadline = time.monotonic() + 20.0
        while np.isnan(probe.cycle(executor)):
            if time.monotonic() > deadline:
                raise SystemExit(f"the {name} chain does not answer")
    times: dict[str, list[float]] = {name: [] for name in probes}
    blocks = options.cycles // options.block
    for block in range(blocks):
        for name, probe in probes.items():
            if not name.startswith("relay"):
                probe.set_goal(goals[block * len(goals) // blocks])
            times[name] += drive(executor, probe, model, options.block)
    found = {name: 1e6 * np.nanpercentile(each, (50, 99)) for name, each in times.items()}
    for name, (median, slow) in found.items():
        lost = int(np.isnan(times[name]).sum())
        print(f"{name:>18}: median {median:7.1f} us, 99% {slow:7.1f} us, lost {lost}")
    for real, relay in (("one process", "middleware"), *zip(WAYS, WAYS, strict=True)):
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
