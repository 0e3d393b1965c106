# SPDX-License-Identifier: Apache-2.0
"""The controller node of Baxter's arm between a robot, a bounds node and a user, for tests."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from arms import load_arm
from controller_chain import ControllerChain, gains_of, patient_values
from controllers import make
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from torque_safety_controller.controller import Controller
from viability_bounds_pkg.ros import messages
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.state import State

ARM = load_arm("baxter_left_arm")
# The arm of these tests does not move as it is told, which is not to count as a disturbance.
VALUES = patient_values("baxter_left_arm", disturbance_time=0.0, safety_filter=False)
JOINTS = VALUES["joints"]
GAINS = gains_of(VALUES)
Q = ARM.q_start
REST = np.zeros(ARM.n)
V = 0.02 * ARM.v_max
LOWER, UPPER = np.full(ARM.n, -2.0), np.full(ARM.n, 2.0)
GOAL_Q = Q + 0.1
SAME_TORQUE = 1e-6  # N m; two runs of the solver


def expected(pose=None, posture=None) -> Controller:
    """The node's core, set up by hand."""
    controller = make(ARM, gains=GAINS)
    controller.reset(Q)
    if pose is not None:
        controller.goals.set_pose(pose)
    if posture is not None:
        controller.goals.set_posture(posture)
    return controller


def pose_at(q) -> pin.SE3:
    robot = ARM.robot(0.0)
    robot.update(State(q, REST), REST)
    return robot.pose.copy()


GOAL = pose_at(GOAL_Q)


def pose_message(pose: pin.SE3, frame="base", stamp=0) -> PoseStamped:
    return messages.pose_message(pose, frame, stamp)


class NodeChain(ControllerChain):
    """The other side of the controller: robot, bounds node and user."""

    def __init__(self, ros, **changed) -> None:
        super().__init__(ros, VALUES | changed)
        self.poses = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
        self.postures = ros.talk(JointState, "target_posture", GOAL_QOS)

    def state(self, stamp, q=Q, v=V) -> None:
        self.send_state(stamp, q, v)

    def bound(self, stamp, lower=LOWER, upper=UPPER) -> None:
        self.send_limits(stamp, lower, upper)

    def both(self, stamp, q=Q, v=V, lower=LOWER, upper=UPPER) -> None:
        self.bound(stamp, lower, upper)
        self.state(stamp, q, v)

    def answer(self, stamp, q=Q, v=V, lower=LOWER, upper=UPPER) -> np.ndarray:
        """Send a state and its limits until the command comes; return its torques."""
        return np.array(self.ask(stamp, q, v, lower, upper).effort)

    def await_mode(self, mode, reason="", each=None) -> None:
        self.ros.wait_until(
            lambda: self.reported("mode") == mode and reason in self.reported("reason"),
            f"mode {mode} {reason}",
            each=each,
        )


def give_goal(chain, message=None, first=1) -> int:
    """Send a pose goal, step until it is tracked; return the next free stamp, ms."""
    chain.poses.publish(pose_message(GOAL) if message is None else message)
    stamps = iter(range(first, first + 1000))
    current = first

    def step():
        nonlocal current
        current = next(stamps)
        chain.both(current)

    chain.await_mode("TRACKING", each=step)
    return current + 1


def torque_for(q, a):
    """Return the torque for accelerations `a` at velocity V."""
    robot = ARM.robot()
    robot.update(State(q, V), a)
    return robot.torque(a)
