# SPDX-License-Identifier: Apache-2.0
"""The robot node: pushes and obstacles."""

import math
import time

import numpy as np
import pinocchio as pin
import pytest
from geometry_msgs.msg import WrenchStamped
from robot_probe import MODEL, PERIOD, VALUES, Q, RobotProbe
from visualization_msgs.msg import Marker, MarkerArray

from viability_bounds_pkg.robot.description import inertia_beyond
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.ros import refusals
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp


def marker(name, position=(2.0, 0.0, 0.3), size=0.3, stamp=0, **fields):
    made = Marker(ns=name, **{"type": Marker.CUBE} | fields)
    made.pose.position.x, made.pose.position.y, made.pose.position.z = map(float, position)
    made.pose.orientation.w = 1.0
    made.scale.x = made.scale.y = made.scale.z = float(size)
    set_stamp(made.header.stamp, stamp)
    return made


def test_a_push_without_measure_does_not_end_the_robot(ros):
    robot = RobotProbe(ros)
    robot.push("panda_hand_tcp", 1e308)
    robot.step(np.zeros(7), times=5)
    assert not np.isfinite(robot.q).all()
    robot.step(np.zeros(7), times=5)
    robot.reset()
    robot.step(times=5)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_a_push_moves_it_until_it_times_out(ros):
    robot = RobotProbe(ros, external_wrench_timeout=0.02)
    robot.push("panda_link4", 30.0)
    robot.step(times=12)
    speed = np.abs(robot.v).max()
    assert speed > 1e-3
    robot.step(times=5)
    assert abs(np.abs(robot.v).max() - speed) < 0.05 * speed  # nothing pushes any more


def test_a_push_sent_ahead_begins_and_ends_with_its_stamps(ros):
    robot = RobotProbe(ros, external_wrench_timeout=3 * PERIOD * 1e-9)
    begin, end = robot.stamp + 5 * PERIOD, robot.stamp + 15 * PERIOD
    robot.push("panda_link4", 0.0, end)
    robot.push("panda_link4", 30.0, begin)
    robot.step(times=25)
    states = dict(zip(robot.states.stamps, robot.states, strict=True))  # some come twice
    stamps = np.array(list(states))
    v = np.array([message.velocity[0] for message in states.values()])
    assert np.abs(v[stamps <= begin]).max() < 1e-9
    # Longer than the time-out, as its end is there already; then nothing changes any more.
    growing, coasting = np.diff(v[(stamps >= begin) & (stamps <= end)]), v[stamps > end]
    assert (np.abs(growing) > 0.5 * np.abs(growing).max()).all()
    assert np.ptp(coasting) < 0.1 * np.abs(coasting).max()


def test_obstacles_come_and_go_with_their_stamps(ros):
    """Only what is there can be deleted."""
    robot = RobotProbe(ros)
    obstacles = ros.talk(MarkerArray, "obstacles", GOAL_QOS)
    begin, end = (robot.stamp + k * PERIOD for k in (2, 4))
    delete = {"action": Marker.DELETE}
    markers = [
        marker("wall", stamp=begin),
        marker("wall", stamp=begin - PERIOD, **delete),  # refused: too early
        marker("wall", stamp=end, **delete),
        marker("wall", stamp=end + PERIOD, **delete),  # refused: too late
        marker("other"),
    ]
    obstacles.publish(MarkerArray(markers=markers))
    robot.await_reported("world_changes_pending", "5")
    robot.step(times=7)
    assert "obstacles: 2;" in robot.reported_now("commands_refused")
    robot.reset()
    obstacles.publish(MarkerArray(markers=[marker("other", **delete)]))
    robot.await_reported("world_changes_pending", "1")
    robot.step()
    assert "obstacles: 1;" in robot.reported_now("commands_refused")


def test_markers_of_one_namespace_are_obstacles_each(ros):
    robot = RobotProbe(ros)
    markers = [marker("wall", position=(2.0, k, 0.3), id=k) for k in range(3)]
    markers.append(marker("wall", id=2, action=Marker.DELETE))
    ros.talk(MarkerArray, "obstacles", GOAL_QOS).publish(MarkerArray(markers=markers))
    robot.await_reported("world_changes_pending", "4")
    robot.step()
    assert set(robot.node._robot.obstacles.present) == {"wall", "wall/1"}


def test_what_is_stamped_by_another_clock_is_refused_with_the_difference(ros, monkeypatch, capfd):
    """It would wait for ever."""
    robot = RobotProbe(ros)
    push = WrenchStamped()
    push.header.frame_id, push.wrench.force.y = "panda_link4", 30.0
    set_stamp(push.header.stamp, time.time_ns())
    monkeypatch.setattr(refusals, "SAME_PERIOD", math.inf)
    for _ in range(5):
        ros.talk(WrenchStamped, "external_wrench", GOAL_QOS).publish(push)
    ros.wait_until(lambda: "external_wrench: 5;" in robot.reported("commands_refused"))
    wall = MarkerArray(markers=[marker("wall", stamp=time.time_ns())])
    ros.talk(MarkerArray, "obstacles", GOAL_QOS).publish(wall)
    ros.wait_until(lambda: "obstacles: 1;" in robot.reported("commands_refused"))
    assert robot.reported_now("world_changes_pending") == "0"
    err = capfd.readouterr().err
    assert err.count("external_wrench refused: header.stamp is ") == 1
    assert "it is the wall clock's, the robot has another time; allowed: 3600 s, or 0" in err


def test_what_cannot_be_in_the_world_is_dropped_and_counted(ros):
    robot = RobotProbe(ros)
    pushes = ros.talk(WrenchStamped, "external_wrench", GOAL_QOS)
    for link, force in (("no_such_link", 1.0), ("panda_link4", math.nan)):
        push = WrenchStamped()
        push.header.frame_id, push.wrench.force.x = link, force
        pushes.publish(push)
    nowhere, oval, unturned = marker("thing"), marker("thing", type=Marker.SPHERE), marker("thing")
    nowhere.header.frame_id = "nowhere"
    oval.scale.y = 0.6
    unturned.pose.orientation.w = 0.0
    markers = [
        nowhere,
        oval,
        unturned,
        marker(""),
        marker("thing", position=(math.nan, 0.0, 0.0)),
        marker("thing", size=0.0),
        marker("thing", size=math.nan),
        marker("thing", type=Marker.ARROW),
        marker("thing", position=(0.0, 0.0, 0.3)),  # in the robot
    ]
    ros.talk(MarkerArray, "obstacles", GOAL_QOS).publish(MarkerArray(markers=markers))
    ros.wait_until(lambda: "external_wrench: 2;" in robot.reported("commands_refused"))
    ros.wait_until(lambda: "obstacles: 8;" in robot.reported("commands_refused"))
    robot.step(times=3)
    assert "obstacles: 9;" in robot.reported_now("commands_refused")
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_contacts_are_felt_by_motion_sensor_and_diagnostics(ros):
    """The hand presses on the floor below its fingers with 15 N."""
    robot = RobotProbe(ros, obstacle_stiffness=1e5, ft_bias=[], ft_noise=[])
    felt = ros.listen(WrenchStamped, "ft_wrench")
    data, hand = MODEL.createData(), MODEL.getFrameId("panda_hand")
    pin.framesForwardKinematics(MODEL, data, Q)
    finger = data.oMf[MODEL.getFrameId("panda_leftfinger")].translation
    floor = marker("floor", position=finger - [0.0, 0.0, 0.0538 + 0.1 + 0.002], size=0.2)
    floor.header.frame_id = VALUES["base_frame"]
    ros.talk(MarkerArray, "obstacles", GOAL_QOS).publish(MarkerArray(markers=[floor]))
    robot.await_reported("world_changes_pending", "1")
    for _ in range(150):
        J = pin.computeFrameJacobian(MODEL, data, robot.q, hand, pin.LOCAL_WORLD_ALIGNED)
        robot.step(robot.gravity() + J[:3].T @ [0.0, 0.0, -15.0] - 5.0 * robot.v)
    assert float(robot.reported_now("contact_force_n")) == pytest.approx(15.0, rel=0.1)
    assert float(robot.reported("contact_force_max_n")) < 60.0
    tool = inertia_beyond(read_urdf(VALUES["robot_description"]), VALUES["ft_frame"])
    ros.wait_until(lambda: felt.stamps[-1] == robot.stamp)
    assert felt[-1].wrench.force.z == pytest.approx(9.81 * tool.mass - 15.0, abs=1.5)
