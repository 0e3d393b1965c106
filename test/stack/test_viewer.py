# SPDX-License-Identifier: Apache-2.0
"""The page of the viewer: what it sends for its user, and a drag in a real browser."""

import math
import time
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from browser import Browser, find_browser
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from sim_bridge.node import viewer_node
from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.page_commands import PageCommands
from sim_bridge.node.viewer_node import PERIOD, ViewerNode
from sim_bridge.viewer.page import DrivingAsked, GoalAsked, PushAsked
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros.messages import pose_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS, NEWEST_QOS, STATUS_QOS
from viability_bounds_pkg.testing.ros_harness import joint_state, read_config

KINDS = (ControllerNode, BoundsNode, ViewerNode, BulletNode)
PATIENT = {"clock": "lockstep", "bounds_timeout": 5.0, "state_timeout": 10.0}
VALUES = read_config("panda", *(kind.NAME for kind in KINDS)) | PATIENT | {"viewer_port": 18080}


def test_nothing_is_sent_but_while_the_user_drives(ros):
    user = PageCommands(ros.add(Node("viewer", context=ros.context)), "panda_link0")
    goals = ros.listen(PoseStamped, "target_pose")
    pushes = ros.listen(WrenchStamped, "external_wrench")
    goal = GoalAsked(pin.SE3(np.eye(3), np.array([0.4, 0.1, 0.5])))
    push = PushAsked("panda_link4", np.array([0.0, 20.0, 0.0]))

    def publishers():
        return ros.probe.count_publishers("target_pose")

    user.send(goal)
    user.send(push)
    assert publishers() == 0
    user.send(DrivingAsked(True))
    ros.wait_until(lambda: publishers() == 1)

    def ask():
        user.send(goal)
        user.send(push)

    ros.wait_until(lambda: goals and pushes, each=ask)
    position = goals[-1].pose.position
    assert (position.x, position.y, position.z) == pytest.approx((0.4, 0.1, 0.5))
    assert (pushes[-1].header.frame_id, pushes[-1].wrench.force.y) == ("panda_link4", 20.0)
    user.send(DrivingAsked(False))
    ros.wait_until(lambda: pushes[-1].wrench.force.y == 0.0, "the end of the push")
    ros.wait_until(lambda: publishers() == 0)


def test_the_page_tells_of_its_own_robot_and_of_what_is_heard(ros, monkeypatch):
    viewer = ros.start(ViewerNode, VALUES)
    told = ros.talk(DiagnosticArray, "/diagnostics", STATUS_QOS)

    def say(name, **values):
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        status = DiagnosticStatus(name=name, message=f"{name} here", values=pairs)
        told.publish(DiagnosticArray(status=[status]))

    def shown(text):
        return text in viewer._status_text()

    say("left/bullet_node", paused="True")
    say("left/controller_node")
    say("controller_node")
    ros.wait_until(lambda: shown("**The controller** controller_node here"))
    viewer.update_page()
    assert not viewer._commands.robot_paused
    monkeypatch.setattr(viewer_node, "_STATUS_OLD", -1.0)
    assert shown("**The controller** is not heard")
    # Joint states of another robot, and goals that the controller refuses.
    states = ros.talk(JointState, "slow/joint_states", NEWEST_QOS)
    each = partial(states.publish, joint_state(["left_s0"], 1, [0.0], [0.0]))
    ros.wait_until(lambda: shown("**joint states are refused: missing joint**"), each=each)
    goals = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
    for x, frame in ((0.4, "panda_link0"), (0.5, "world"), (math.nan, "")):
        goals.publish(pose_message(pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])), frame))
    ros.wait_until(lambda: viewer._goal is not None)
    ros.run_for(0.1)
    assert viewer._goal.translation[0] == 0.4


def test_driving_ends_with_the_last_page(ros):
    viewer = ros.start(ViewerNode, VALUES)
    viewer.page._drive.value = True
    ros.wait_until(lambda: ros.probe.count_publishers("target_pose"), each=viewer.update_page)
    viewer.page._on_leave(None)
    ros.wait_until(lambda: not ros.probe.count_publishers("target_pose"), each=viewer.update_page)


class Viewed:
    """A Panda in lockstep, and a viewer that shows it whenever the nodes have run."""

    def __init__(self, ros):
        self.ros = ros
        self.goals = ros.listen(PoseStamped, "target_pose")
        self.states = ros.listen(JointState, "joint_states")
        _, _, self.viewer, _ = (ros.start(kind, VALUES) for kind in KINDS)
        self.page = self.viewer.page
        self.model = build_model(read_urdf(VALUES["robot_description"]), VALUES["joints"])
        self.data = self.model.createData()
        self.wait(lambda: ros.reported("bullet_node", "control") == "torque")

    def wait(self, condition, timeout=300.0):
        """Let nodes and page run until a condition holds."""
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, "it has not come true"
            shown = time.monotonic() + PERIOD
            while time.monotonic() < shown:
                self.ros.spin(0.01)
            self.viewer.update_page()

    def run(self, duration):
        """Let time pass, s."""
        end = time.monotonic() + duration
        self.wait(lambda: time.monotonic() > end)

    def hand(self):
        """Return the pose of the hand."""
        q = np.array(self.states[-1].position[: self.model.nq])
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.data.oMf[self.model.getFrameId(VALUES["end_effector_frame"])].copy()

    def pixel(self, point):
        """Return where a point in the world is seen on the page."""
        (client,) = self.page._server.get_clients().values()
        camera = client.camera
        seen = pin.Quaternion(*camera.wxyz).toRotationMatrix().T @ (point - camera.position)
        focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
        middle = 0.5 * np.array([camera.image_width, camera.image_height])
        return middle + focal * seen[:2] / seen[2]


@pytest.mark.long
@pytest.mark.skipif(find_browser() is None, reason="no browser: apt install chromium")
def test_a_drag_in_a_browser_moves_the_arm(ros):
    arm = Viewed(ros)
    with Browser((1000, 640)) as browser:
        browser.open(arm.page.address)
        arm.wait(lambda: arm.page._server.get_clients())
        arm.wait(lambda: browser.value("document.querySelectorAll('svg.joints circle').length"))
        browser.value("[...document.querySelectorAll('input[type=checkbox]')].pop().click()")
        arm.wait(lambda: ros.probe.count_publishers("target_pose") == 1)
        start = arm.hand()
        # The arrow of the goal's handle that points down is pulled up, when the page shows it.
        for pause in 0.7, 1.0, 1.5, 2.0, 3.0, 5.0:  # a browser on a busy machine is slow
            tip, target = (arm.pixel(start.act(np.array([0.0, 0.0, z]))) for z in (0.22, 0.02))
            browser.drag(tip, target, lambda pause=pause: arm.run(pause), steps=3)
            arm.run(1.0)
            if arm.goals:
                break
        arm.wait(lambda: arm.hand().translation[2] > start.translation[2] + 0.1)
        raised = arm.hand().translation - start.translation
        assert np.abs(raised[:2]).max() < 0.02
    arm.wait(lambda: not arm.page._server.get_clients())
