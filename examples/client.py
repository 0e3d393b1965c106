# SPDX-License-Identifier: Apache-2.0
"""A program drives a simulated Panda: by joints, to a pose, pushed, and out of its reach.

Starts `simulated_stack` in lockstep; with a robot that runs already, `ArmClient` is all it takes.
Needs ROS 2 Jazzy and PyBullet.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin

from torque_safety_controller.remote.arm_client import ArmClient, NotReachedError

CONFIG = Path(__file__).resolve().parent.parent / "config" / "panda.yaml"
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
STACK = [sys.executable, "-m", "sim_bridge.node.simulated_stack", "--ros-args"]
STACK += ["--params-file", str(CONFIG), "-p", "clock:=lockstep", "--log-level", "error"]


def main() -> int:
    """Drive the arm; return 1 if it did not do as it was told, or broke a limit."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    stack = subprocess.Popen(STACK)
    try:
        with ArmClient(JOINTS) as arm:
            return drive(arm)
    except NotReachedError as error:
        print(f"it went wrong: {error}")
        return 1
    finally:
        stack.send_signal(signal.SIGINT)
        stack.wait(30)


def drive(arm: ArmClient) -> int:
    """Move, push, read."""
    start = arm.state()
    arm.move_joints(start.q + 0.2, duration=2.0)
    print("joints moved by", np.round(arm.state().q - start.q, 2))
    goal = pin.SE3(start.hand.rotation, start.hand.translation + [0.1, 0.1, -0.1])
    arm.move_to(goal)
    print("hand moved by", np.round(arm.state().hand.translation - start.hand.translation, 2), "m")
    arm.push("panda_link4", [0.0, 30.0, 0.0])
    arm.wait(0.5)
    arm.push("panda_link4", [0.0, 0.0, 0.0])
    try:
        arm.move_to(pin.SE3(goal.rotation, goal.translation + [0.0, 0.0, 1.0]))
        return 1
    except NotReachedError as error:
        print("one metre higher:", error)
    position, speed, torque = (float(each.min()) for each in arm.state().margins)
    print(f"inside the limits by {position:.1e} rad, {speed:.1f} rad/s, {torque:.1f} N m")
    return 0 if min(position, speed, torque) >= 0.0 else 1


if __name__ == "__main__":
    sys.exit(main())
