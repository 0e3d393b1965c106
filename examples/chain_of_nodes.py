# SPDX-License-Identifier: Apache-2.0
"""The three nodes in one process: a Panda is sent to a pose, and its robot judges the limits.

In lockstep: the simulated robot waits for the command that answers each of its states, so that
the numbers are the same on every machine. Needs ROS 2 Jazzy and PyBullet.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter

from sim_bridge.node.bullet_node import BulletNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS, make_executor

CONFIG = Path(__file__).resolve().parent.parent / "config" / "panda.yaml"
PERIODS = 2000  # 4 s at 500 Hz
LONGEST = 120.0  # s


def main() -> int:
    """Run the chain; print what the robot saw; return 1 if a limit was broken."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(args=["--ros-args", "--log-level", "error"])
    parameters = [Parameter("clock", value="lockstep")]
    for section in yaml.safe_load(CONFIG.read_text()).values():
        parameters += [Parameter(k, value=v) for k, v in section["ros__parameters"].items()]
    kinds = (BoundsNode, ControllerNode, BulletNode)
    nodes = [kind(parameter_overrides=parameters) for kind in kinds]
    user = rclpy.create_node("user")
    robot: dict[str, str] = {}

    def listen(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith("bullet_node"):
                robot.update({pair.key: pair.value for pair in status.values})

    user.create_subscription(DiagnosticArray, "/diagnostics", listen, 10)
    goals = user.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y, goal.pose.position.z = -0.59, 0.51, 0.62
    goal.pose.orientation.z, goal.pose.orientation.w = 0.96, 0.28
    executor = make_executor()
    for node in (*nodes, user):
        executor.add_node(node)
    deadline = time.monotonic() + LONGEST
    while int(robot.get("periods", 0)) < PERIODS and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.1)
        if not robot:
            goals.publish(goal)
    for node in (*nodes, user):
        node.destroy_node()
    rclpy.try_shutdown()
    if not robot:
        print("no diagnostics of the robot were heard")
        return 1
    limits = ("position_violation_rad", "velocity_violation_rad_s", "torque_ratio")
    position, speed, torque = (max(map(float, robot[key].split())) for key in limits)
    print(f"{robot['periods']} control periods: positions at most {position:g} rad beyond their")
    print(f"limits, speeds {speed:g} rad/s, torques up to {torque:.0%} of their limits")
    done = int(robot["periods"]) >= PERIODS
    return 0 if done and position == speed == 0.0 and torque <= 1.0 else 1


if __name__ == "__main__":
    sys.exit(main())
