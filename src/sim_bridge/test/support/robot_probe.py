# SPDX-License-Identifier: Apache-2.0
"""A robot node in lockstep, and what a controller sees and sends."""

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.robot.description import build_model, read_urdf
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
    """The node, and what a controller sees and sends."""

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

    def step(self, tau=None, times=1):
        """Answer states, by default with gravity compensation, and await the next ones."""
        for _ in range(times):
            stamp, torque = self.stamp, self.gravity() if tau is None else tau
            self._answer(stamp, lambda s=stamp, t=torque: self.send(s, t))

    def _answer(self, stamp, send):
        """Send until the next state has come: best effort may lose a command under load."""
        self.ros.wait_until(lambda: self.stamp > stamp, "the next state", each=send, period=0.5)

    def send(self, stamp, tau=None, joints=JOINTS, *, q=None, v=None):
        message = joint_state(joints, stamp, tau=[] if tau is None else tau)
        message.position = [] if q is None else list(map(float, q))
        message.velocity = [] if v is None else list(map(float, v))
        self.commands.publish(message)

    def move(self, q, v=None, times=1):
        """Answer states with positions, and await the next ones."""
        for _ in range(times):
            stamp = self.stamp
            self._answer(stamp, lambda s=stamp: self.send(s, q=q, v=v))

    def push(self, link, force, stamp=0):
        """Push along y and wait until the robot knows."""
        pushes = self.ros.talk(WrenchStamped, "external_wrench", GOAL_QOS)
        message = WrenchStamped()
        message.header.frame_id = link
        message.wrench.force.y = force
        set_stamp(message.header.stamp, stamp)
        before = len(self.node._world)
        pushes.publish(message)
        self.ros.wait_until(lambda: len(self.node._world) > before, "the push")
        self.ros.probe.destroy_publisher(pushes)

    def reported(self, key):
        return self.ros.reported("bullet_node", key)

    def await_reported(self, key, value):
        self.ros.wait_until(lambda: self.reported(key) == value, f"{key} {value}")
