# SPDX-License-Identifier: Apache-2.0
"""The robot node: pushes and obstacles."""

import math

import numpy as np
import pinocchio as pin
import pytest
from geometry_msgs.msg import WrenchStamped
from robot_probe import MODEL, PERIOD, VALUES, Q, RobotProbe
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.node.topics import EXTERNAL_WRENCH, OBSTACLES
from viability_bounds_pkg.robot.description import inertia_beyond, read_urdf
from viability_bounds_pkg.ros.runtime import (
    CONTROL_QOS,
    GOAL_QOS,
    set_stamp,
)


def test_a_push_without_measure_does_not_end_the_robot(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0)
    world = ros.talk(WrenchStamped, "external_wrench", GOAL_QOS)
    push = WrenchStamped()
    push.header.frame_id = "panda_hand_tcp"
    for part in (push.wrench.force, push.wrench.torque):
        part.x = part.y = part.z = 1e308
    # Commands at first, and none afterwards: it stops itself by a law that needs a state.
    for await_it, what in (
        (lambda: ros.reported("bullet_node", "control") == "torque", "commands that are obeyed"),
        (lambda: not np.isfinite(robot.q).all(), "a state that is none"),
    ):
        ros.wait_until(
            await_it, what, each=lambda: robot.send(robot.stamp, np.zeros(7)), period=0.002
        )
        world.publish(push)
    heard = len(robot.states)
    ros.wait_until(lambda: len(robot.states) > heard + 50, "further states")
    assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
    ros.wait_until(lambda: np.isfinite(robot.q).all(), "a state")


def test_a_push_moves_it_until_it_times_out(ros):
    robot = RobotProbe(ros, external_wrench_timeout=0.05)
    robot.push("panda_link4", 30.0)
    robot.step(times=24)
    assert np.abs(robot.v).max() > 1e-3
    robot.step(times=10)
    assert not robot.node._world.wrench_ends
    speeds = [np.abs(np.array(s.velocity)).max() for s in robot.states[-5:]]
    assert max(speeds) - min(speeds) < 1e-3  # nothing pushes any more


def test_a_new_push_takes_the_place_of_the_old_on_its_link(ros):
    robot = RobotProbe(ros, external_wrench_timeout=5.0)
    robot.push("panda_link4", 30.0)
    robot.push("panda_link6", 1.0)
    robot.step(times=10)
    speed = np.abs(robot.v).max()
    assert speed > 1e-3
    assert set(robot.node._world.wrench_ends) == {"panda_link4", "panda_link6"}
    robot.push("panda_link4", 0.0)
    robot.push("panda_link6", -1.0)  # what the other has done
    robot.step(times=10)
    assert np.abs(robot.v).max() < 1.1 * speed
    robot.push("panda_link6", 0.0)
    robot.step()
    steady = robot.v
    robot.step(times=10)
    np.testing.assert_allclose(robot.v, steady, atol=0.1 * speed)


def test_a_push_sent_ahead_begins_and_ends_with_its_stamps(ros):
    robot = RobotProbe(ros, external_wrench_timeout=3 * PERIOD * 1e-9)
    begin, end = robot.stamp + 5 * PERIOD, robot.stamp + 15 * PERIOD
    robot.push("panda_link4", 0.0, end)
    robot.push("panda_link4", 30.0, begin)
    still = ros.listen(JointState, "joint_states")
    robot.step(times=25)
    stamps = np.array(still.stamps)
    v = np.array([message.velocity[0] for message in still])
    assert np.abs(v[stamps <= begin]).max() < 1e-9
    # Longer than the time-out, as its end is there already; then nothing changes any more.
    growing, coasting = np.diff(v[(stamps >= begin) & (stamps <= end)]), v[stamps > end]
    assert (np.abs(growing) > 0.5 * np.abs(growing).max()).all()
    assert np.ptp(coasting) < 0.1 * np.abs(coasting).max()


def test_obstacles_come_and_go_with_their_stamps(ros):
    robot = RobotProbe(ros)
    obstacles = ros.talk(MarkerArray, "obstacles", GOAL_QOS)

    def marker(name, stamp, action=Marker.ADD, kind=Marker.CUBE, frame="panda_link0"):
        marker = Marker(ns=name, action=action, type=kind)
        marker.header.frame_id = frame
        marker.pose.position.x, marker.pose.orientation.w = 2.0, 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = 0.1
        set_stamp(marker.header.stamp, stamp)
        return marker

    arm = robot.node._robot
    later = robot.stamp + 3 * PERIOD
    markers = [
        marker("first", 0),
        marker("second", later),
        marker("first", later, Marker.DELETE),
        marker("third", 0, kind=Marker.ARROW),
        marker("fourth", 0, frame="nowhere"),
    ]
    obstacles.publish(MarkerArray(markers=markers))
    ros.wait_until(lambda: len(robot.node._world) == 3, "the obstacles")
    robot.step()
    assert set(arm.obstacles.present) == {"first"}
    robot.step(times=2)
    assert set(arm.obstacles.present) == {"first"}
    robot.step()
    assert set(arm.obstacles.present) == {"second"}
    ros.wait_until(lambda: "obstacles: 2;" in robot.reported("commands_refused"))
    ros.call(Trigger, "bullet_node/reset", Trigger.Request())
    assert not arm.obstacles


def test_obstacles_that_cannot_be_are_dropped_and_counted(ros):
    robot = RobotProbe(ros)
    obstacles = ros.talk(MarkerArray, "obstacles", GOAL_QOS)
    markers = []
    for change in (
        lambda m: setattr(m, "ns", ""),
        lambda m: setattr(m.pose.position, "x", math.nan),
        lambda m: setattr(m.pose.orientation, "w", 0.0),
        lambda m: setattr(m.scale, "x", 0.0),
        lambda m: setattr(m.scale, "y", 0.2),  # not round
        lambda m: setattr(m, "action", 7),
        lambda m: setattr(m, "action", Marker.DELETE),  # there is none
        lambda m: setattr(m.pose.position, "x", 0.0),  # in the robot
    ):
        marker = Marker(ns="thing", type=Marker.CYLINDER)
        marker.pose.position.x, marker.pose.position.z = 2.0, 0.3
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = 0.3
        change(marker)
        markers.append(marker)
    obstacles.publish(MarkerArray(markers=markers))
    ros.wait_until(lambda: "obstacles: 6;" in robot.reported("commands_refused"))
    robot.step(times=3)
    ros.wait_until(lambda: "obstacles: 8;" in robot.reported("commands_refused"))
    assert not robot.node._robot.obstacles
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_a_publisher_of_pushes_or_obstacles_that_cannot_be_heard_is_refused(ros):
    robot = RobotProbe(ros)
    for topic in (EXTERNAL_WRENCH, OBSTACLES):
        ros.probe.create_publisher(topic.message, topic.name, CONTROL_QOS)
        refusal = f"{topic.name}: 1;"
        ros.wait_until(lambda text=refusal: text in robot.reported("commands_refused"), refusal)


@pytest.mark.parametrize(("link", "force"), [("no_such_link", 1.0), ("panda_link4", math.nan)])
def test_a_push_that_cannot_be_is_refused(ros, link, force):
    robot = RobotProbe(ros)
    pushes = ros.talk(WrenchStamped, "external_wrench", GOAL_QOS)
    push = WrenchStamped()
    push.header.frame_id = link
    push.wrench.force.x = force
    pushes.publish(push)
    ros.wait_until(lambda: "external_wrench: 1;" in robot.reported("commands_refused"))
    robot.step(times=3)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_contacts_are_felt_by_motion_sensor_and_diagnostics(ros):
    robot = RobotProbe(ros, obstacle_stiffness=1e5, ft_bias=[], ft_noise=[])
    felt = ros.listen(WrenchStamped, "ft_wrench")
    arm = robot.node._robot
    finger = arm.link_pose("panda_leftfinger").translation
    floor = Marker(ns="floor", type=Marker.CUBE)
    floor.header.frame_id = VALUES["base_frame"]
    floor.scale.x = floor.scale.y = floor.scale.z = 0.2
    floor.pose.position.x, floor.pose.position.y = finger[:2]
    floor.pose.position.z = finger[2] - 0.0538 - 0.1 - 0.002
    floor.pose.orientation.w = 1.0
    ros.talk(MarkerArray, "obstacles", GOAL_QOS).publish(MarkerArray(markers=[floor]))
    ros.wait_until(lambda: len(robot.node._world) == 1, "the floor")
    data, frame = MODEL.createData(), MODEL.getFrameId("panda_hand")
    for _ in range(300):
        q, v = robot.q, robot.v
        J = pin.computeFrameJacobian(MODEL, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        robot.step(robot.gravity() + J.T @ [0.0, 0.0, -15.0, 0.0, 0.0, 0.0] - 5.0 * v)
    assert arm.obstacles.contacts()
    ros.wait_until(
        lambda: float(robot.reported("contact_force_n") or 0.0) == pytest.approx(15.0, rel=0.1),
        "the contact's force",
    )
    assert float(robot.reported("contact_force_max_n")) < 60.0
    tool = inertia_beyond(read_urdf(VALUES["robot_description"]), VALUES["ft_frame"])
    ros.wait_until(lambda: felt.stamps[-1] == robot.stamp)
    assert felt[-1].wrench.force.z == pytest.approx(9.81 * tool.mass - 15.0, abs=1.5)
