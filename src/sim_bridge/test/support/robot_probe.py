# SPDX-License-Identifier: Apache-2.0
"""A robot node, and what a controller sees and sends."""

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp, stamp_to_ns
from viability_bounds_pkg.testing.ros_harness import joint_state, read_config

VALUES = read_config("panda", "bullet_node")
JOINTS = VALUES["joints"]
MODEL = build_model(read_urdf(VALUES["robot_description"]), JOINTS)
Q = np.array(VALUES["start_positions"])
PERIOD = 2_000_000  # ns, of the configured 500 Hz
BRAKES = {"acceleration_min": [], "acceleration_max": []}
"""Without acceleration limits the robot brakes when commands stop."""


class RobotProbe:
    """A Panda, by default in lockstep."""

    def __init__(self, ros, **changes):
        self.ros = ros
        self.states = ros.listen(JointState, "joint_states")
        self.node = ros.start(BulletNode, VALUES | {"clock": "lockstep"} | changes)
        self.commands = ros.talk(JointState, "joint_commands")
        ros.wait_until(lambda: self.states, "a state")

    @property
    def stamp(self):
        return stamp_to_ns(self.states[-1].header.stamp)

    @property
    def q(self):
        return np.array(self.states[-1].position[:7])

    @property
    def v(self):
        return np.array(self.states[-1].velocity[:7])

    @property
    def tau(self):
        return np.array(self.states[-1].effort[:7])

    def gravity(self):
        return pin.computeGeneralizedGravity(MODEL, MODEL.createData(), self.q)

    def send(self, stamp, tau=(), joints=JOINTS, *, q=(), v=()):
        self.commands.publish(joint_state(joints, stamp, q, v, tau))

    def step(self, tau=None, times=1, **command):
        """Answer states, by default with gravity compensation, and await the next ones.

        Best effort may lose a command under load: it is sent again.
        """
        for _ in range(times):
            stamp, sent = self.stamp, dict(command)
            if tau is not None:
                sent["tau"] = tau
            elif "q" not in command:
                sent["tau"] = self.gravity()
            self.ros.wait_until(
                lambda s=stamp: self.stamp > s,
                "the next state",
                each=lambda s=stamp, c=sent: self.send(s, **c),
                period=0.5,
            )

    def push(self, link, force, stamp=0):
        """Push along y and wait until the robot knows."""
        pushes = self.ros.talk(WrenchStamped, "external_wrench", GOAL_QOS)
        message = WrenchStamped()
        message.header.frame_id = link
        message.wrench.force.y = force
        set_stamp(message.header.stamp, stamp)
        before = int(self.reported_now("world_changes_pending"))
        pushes.publish(message)
        self.await_reported("world_changes_pending", str(before + 1))

    def reset(self):
        """Reset the robot and await its next state."""
        before = self.stamp
        assert self.ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
        self.ros.wait_until(lambda: self.stamp > before, "a state after the reset")

    def pause(self, paused):
        assert self.ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=paused)).success

    def reported(self, key):
        return self.ros.reported("bullet_node", key)

    def reported_now(self, key):
        """Return a value of the diagnostics of the period that the last state begins."""
        self.ros.diagnostics.clear()
        self.await_reported("stamp_ns", str(self.stamp))
        return self.reported(key)

    def await_reported(self, key, value):
        self.ros.wait_until(lambda: self.reported(key) == value, f"{key} {value}")
