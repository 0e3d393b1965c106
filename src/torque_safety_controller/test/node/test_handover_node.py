# SPDX-License-Identifier: Apache-2.0
"""Handover between position and torque control, as its service, states and commands show it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from controller_chain import MS, NODE, ControllerChain, patient_values
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import read_config

SERVICE = f"{NODE}/enable_torque"

VALUES = patient_values("panda", start_control="position")
JOINTS = VALUES["joints"]
N = len(JOINTS)
TAU_MAX = np.array(VALUES["torque_max"])
Q = np.array(read_config("panda", "bullet_node")["start_positions"])
TAU = 0.1 * TAU_MAX  # of the motors, by which the arm is held
SMALL = 0.01 * TAU_MAX
WIDE = np.full(N, 5.0)


class HandoverChain(ControllerChain):
    """The other side of the controller: robot, bounds node and user."""

    def __init__(self, ros, **changed) -> None:
        super().__init__(ros, VALUES | changed)
        self.stamp = 0

    def state(self, stamp, q=Q, tau=TAU) -> None:
        self.send_state(stamp, q, np.zeros(N), tau)

    def bound(self, stamp) -> None:
        self.send_limits(stamp, -WIDE, WIDE)

    def answer(self, q=Q, tau=TAU, bounds=True) -> JointState:
        """Send the next state, and limits, until the command comes; return that."""
        self.stamp += 1
        if bounds:
            return self.ask(self.stamp, q, np.zeros(N), -WIDE, WIDE, tau)
        return self.await_command(self.stamp, lambda: self.state(self.stamp, q, tau))

    def call(self, torque: bool) -> SetBool.Response:
        return self.ros.call(SetBool, SERVICE, SetBool.Request(data=torque))

    def enable(self, torque: bool) -> None:
        response = self.call(torque)
        assert response.success, response.message

    def take_over(self, q=Q, tau=TAU) -> np.ndarray:
        """Enable torque control; return its first torques."""
        self.enable(True)
        return assert_torque(self.until_torque(q, tau))

    def until_torque(self, q=Q, tau=TAU) -> JointState:
        """Return the first command with torques; positions are held until then."""
        while not len((command := self.answer(q, tau)).effort):
            assert_position(command, command.position)
        return command

    def refuses(self, torque: bool) -> str:
        response = self.call(torque)
        assert not response.success
        return response.message

    def await_report(self, each=None, **values) -> None:
        self.ros.wait_until(
            lambda: all(v in self.ros.reported(NODE, k) for k, v in values.items()),
            f"{values}, not {self.ros.diagnostics.get(NODE)}",
            each=each,
        )


def assert_position(command: JointState, q=Q) -> None:
    assert command.name == JOINTS
    assert not len(command.effort)
    np.testing.assert_array_equal(command.position, q)
    np.testing.assert_array_equal(command.velocity, np.zeros(N))


def assert_torque(command: JointState) -> np.ndarray:
    assert not len(command.position)
    assert (np.abs(command.effort) <= TAU_MAX).all()
    return np.array(command.effort)


# From position to torque and back


def test_it_goes_over_to_the_torque_of_the_motors_and_back(ros):
    chain = HandoverChain(ros)
    assert_position(chain.answer(bounds=False))
    chain.await_report(mode="POSITION", reason="as at start", control="position")
    # The goal of the drives does not follow the arm.
    assert_position(chain.answer(Q + 1e-3))
    assert (np.abs(chain.take_over(Q + 1e-3) - TAU) < SMALL).all()
    for _ in range(3):
        assert_torque(chain.answer(Q + 1e-3))
    chain.await_report(mode="TRACKING", control="torque")
    chain.enable(False)
    assert_position(chain.answer(Q + 2e-3), Q + 2e-3)
    chain.await_report(mode="POSITION", reason="enable_torque", control="position")
    # And again, from another torque.
    chain.answer(Q, -TAU)
    assert (np.abs(chain.take_over(Q, -TAU) + TAU) < SMALL).all()


def test_the_drives_hold_a_continuous_joint_in_the_turn_that_they_report(ros):
    most = np.array([10.0] * (N - 1) + [math.inf])
    chain = HandoverChain(ros, position_min=(-most).tolist(), position_max=most.tolist())
    at, turn = np.array([*Q[:-1], math.pi - 1e-3]), np.array([*np.zeros(N - 1), 2.0 * math.pi])
    assert_position(chain.answer(at), at)
    wrapped = at - turn + [*np.zeros(N - 1), 2e-3]
    np.testing.assert_allclose(chain.answer(wrapped).position, at - turn, atol=1e-12)


def test_a_state_asked_for_again_gets_what_it_got(ros):
    chain = HandoverChain(ros)
    chain.answer()

    def assert_again(command):
        ros.wait_until(
            lambda: chain.commands.stamps.count(chain.stamp * MS) > 3,
            each=lambda: chain.state(chain.stamp),
        )
        found = zip(chain.commands.stamps, chain.commands, strict=True)
        assert all(each == command for stamp, each in found if stamp == chain.stamp * MS)

    chain.enable(True)
    assert_again(chain.answer())
    torque = chain.until_torque()
    chain.enable(False)
    assert_again(torque)


def test_a_call_between_a_state_and_its_limits_is_obeyed(ros):
    chain = HandoverChain(ros, start_control="torque")
    assert_torque(chain.answer())
    ros.run_for(0.05, each=lambda: chain.state(10))
    chain.enable(False)
    assert_position(chain.await_command(10, lambda: chain.bound(10)))
    chain.stamp = 10
    assert_position(chain.answer())
    chain.await_report(control="position")


def test_goals_from_before_the_handover_are_dropped(ros):
    chain = HandoverChain(ros)
    chain.answer()
    poses = ros.talk(PoseStamped, "target_pose", GOAL_QOS)
    far = PoseStamped()
    far.pose.position.x, far.pose.orientation.w = 0.3, 1.0
    poses.publish(far)
    chain.await_report(goals_pending="1")
    assert (np.abs(chain.take_over() - TAU) < SMALL).all()
    chain.answer()
    chain.await_report(goals_pending="0", mode="TRACKING")
    ros.diagnostics.clear()
    ros.wait_until(lambda: chain.reported("position_error_m"))
    assert float(chain.reported("position_error_m")) < 1e-9


def test_efforts_for_ros2_control_are_silent_under_position_control(ros):
    topic = "/effort_controller/commands"
    chain = HandoverChain(ros, ros2_control_topic=topic)
    efforts = ros.listen(Float64MultiArray, topic)
    ros.hears(topic)
    chain.answer()
    ros.run_for(0.1, each=lambda: chain.state(chain.stamp))
    assert not efforts
    torque = chain.take_over()
    ros.wait_until(lambda: efforts, "efforts", each=lambda: chain.state(chain.stamp))
    np.testing.assert_array_equal(efforts[0].data, torque)


# Refused


@pytest.mark.parametrize("stamp", [1, 1_000_000])
def test_torque_is_refused_while_limits_are_old_or_of_another_run(ros, stamp):
    chain = HandoverChain(ros, bounds_timeout=5.0)
    chain.stamp = 10_000  # ms
    chain.answer(bounds=False)
    assert "no acceleration limits" in chain.refuses(True)
    ros.run_for(0.05, each=lambda: chain.bound(stamp))
    assert "no acceleration limits" in chain.refuses(True)
    assert_position(chain.answer())
    chain.enable(True)


def test_torque_is_refused_where_it_cannot_begin(ros):
    chain = HandoverChain(ros, bounds_timeout=1.0)
    assert "no joint state" in chain.refuses(True)
    assert "position control is on already" in chain.refuses(False)
    chain.answer(Q, ())
    assert "no motor torque" in chain.refuses(True)
    assert_position(chain.answer())
    ros.run_for(1.1)
    assert "no joint state, or only old ones" in chain.refuses(True)
    chain.answer()
    chain.take_over()
    assert "torque control is on already" in chain.refuses(True)


# States that cannot be used, or are of another place


def test_nothing_is_sent_once_it_is_stopped(ros):
    chain = HandoverChain(ros, state_timeout=1.0, bounds_timeout=0.5)
    chain.answer()
    # States that cannot be used: the drives hold on.
    bad = np.full(N, math.nan)
    assert_position(chain.await_command(50, lambda: chain.state(50, bad)))
    chain.await_report(each=lambda: chain.state(50, bad), mode="STOPPED", reason="refused")
    ros.run_for(0.1, each=lambda: chain.state(60, bad))
    assert max(chain.commands.stamps) == 50 * MS


def test_a_robot_that_is_put_elsewhere_is_held_there_however_near(ros):
    """The drives would jump to where they held it before."""
    chain = HandoverChain(ros)
    chain.answer()
    assert_position(chain.answer(Q + 0.06))  # pushed away
    chain.stamp += 1500
    assert_position(chain.answer(Q + 0.03), Q + 0.03)
    assert_position(chain.answer(Q + 0.031), Q + 0.03)
    for _ in range(4):  # dropped, so that nothing is known of it
        chain.answer(np.full(N, math.nan))
    assert_position(chain.answer(Q + 0.027), Q + 0.027)
