# SPDX-License-Identifier: Apache-2.0
"""The page of the viewer: what it shows and sends, alone and in a real browser."""

import time

import numpy as np
import pinocchio as pin
import pytest
from browser import Browser, find_browser
from geometry_msgs.msg import PoseStamped, WrenchStamped

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.viewer_node import PERIOD, ViewerNode
from sim_bridge.viewer.page import DrivingAsked, GoalAsked, PushAsked
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.testing.ros_harness import read_config

KINDS = "bounds_node", "controller_node", "bullet_node", "viewer_node"
PATIENT = {"clock": "lockstep", "bounds_timeout": 5.0, "state_timeout": 10.0}
AXIS = np.array([0.0, 0.0, 1.0])
VALUES = read_config("panda", *KINDS) | PATIENT | {"viewer_port": 18080}


class Viewed:
    """A Panda in lockstep, and a viewer that shows it whenever the nodes have run."""

    def __init__(self, ros):
        self.ros = ros
        self.goals = ros.listen(PoseStamped, "target_pose")
        self.pushes = ros.listen(WrenchStamped, "external_wrench")
        ros.start(ControllerNode, VALUES)
        ros.start(BoundsNode, VALUES)
        self.viewer = ros.start(ViewerNode, VALUES)
        self.page = self.viewer.page
        ros.start(BulletNode, VALUES)
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

    def ask(self, *requests):
        """Do as the user of the page would."""
        for request in requests:
            self.page._requests.put(request)
        self.viewer.update_page()

    def drivers(self):
        """How many nodes publish goals."""
        return self.ros.probe.count_publishers("target_pose")

    def hand(self):
        return self.page._data.oMf[self.page._hand].copy()


@pytest.fixture
def arm(ros):
    return Viewed(ros)


def test_nothing_is_sent_before_the_user_drives(arm):
    goal = pin.SE3(np.eye(3), np.array([0.4, 0.1, 0.5]))
    arm.ask(GoalAsked(goal), PushAsked("panda_link4", np.ones(3)))
    assert arm.drivers() == 0
    arm.ask(DrivingAsked(True))
    arm.wait(lambda: arm.drivers() == 1)
    arm.ask(GoalAsked(goal), PushAsked("panda_link4", np.array([0.0, 20.0, 0.0])))
    arm.wait(lambda: arm.goals and arm.pushes)
    position = arm.goals[-1].pose.position
    assert (position.x, position.y, position.z) == pytest.approx((0.4, 0.1, 0.5))
    assert arm.pushes[-1].header.frame_id == "panda_link4"
    assert arm.pushes[-1].wrench.force.y == 20.0
    arm.ask(DrivingAsked(False))
    arm.wait(lambda: arm.pushes[-1].wrench.force.y == 0.0)
    arm.wait(lambda: arm.drivers() == 0)


@pytest.mark.long
@pytest.mark.skipif(find_browser() is None, reason="no browser: apt install chromium")
def test_a_drag_in_a_browser_moves_the_arm(arm, tmp_path):
    with Browser((1000, 640)) as browser:
        browser.open(arm.page.address)
        arm.wait(lambda: arm.page._server.get_clients())
        arm.wait(lambda: browser.value("document.querySelector('svg.joints') !== null"))
        assert browser.value("document.querySelectorAll('svg.joints circle').length") == 7
        browser.value("[...document.querySelectorAll('input[type=checkbox]')].pop().click()")
        arm.wait(lambda: arm.page._driving and arm.page._goal.visible)
        arm.wait(lambda: arm.drivers() == 1)
        start = arm.hand()
        # The arrow of the goal's handle that points down is pulled up, when the page shows it.
        for pause in 0.7, 1.0, 1.5, 2.0, 3.0, 5.0:  # a browser on a busy machine is slow
            tip, target = (np.array(pixel(arm, start.act(z * AXIS))) for z in (0.22, 0.02))
            browser.drag(tip, target, lambda pause=pause: arm.run(pause), steps=3)
            arm.run(1.0)
            if arm.goals:
                break
        arm.wait(lambda: arm.hand().translation[2] > start.translation[2] + 0.1)
        picture = browser.screenshot(tmp_path / "page.png")
        raised = arm.hand().translation - start.translation
        assert np.abs(raised[:2]).max() < 0.02
        assert len(picture) > 20_000  # an empty page has less
    arm.wait(lambda: not arm.page._server.get_clients())


def pixel(arm, point):
    """Return where a point in the world is seen on the page."""
    (client,) = arm.page._server.get_clients().values()
    camera = client.camera
    seen = pin.Quaternion(*camera.wxyz).toRotationMatrix().T @ (point - camera.position)
    height = camera.image_height
    focal = 0.5 * height / np.tan(0.5 * camera.fov)
    return (
        0.5 * camera.image_width + focal * seen[0] / seen[2],
        0.5 * height + focal * seen[1] / seen[2],
    )
