# SPDX-License-Identifier: Apache-2.0
import math
import re

import numpy as np
import pinocchio as pin
import pytest
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from robot_probe import BRAKES, JOINTS, MODEL, PERIOD, VALUES, Q, RobotProbe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.nodes.bullet_node import BulletNode
from sim_bridge.nodes.topics import EXTERNAL_WRENCH, OBSTACLES
from sim_bridge.urdf.payload import payload_inertia
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import build_model, inertia_beyond, read_urdf
from viability_bounds_pkg.ros.runtime import (
    CONTROL_QOS,
    GOAL_QOS,
    LATCHED_QOS,
    set_stamp,
    stamp_to_ns,
)
from viability_bounds_pkg.testing.ros_harness import joint_state, names_parameter, read_config


def test_each_command_with_the_right_stamp_moves_time_by_one_period(ros):
    robot = RobotProbe(ros)
    first = robot.stamp
    assert first == PERIOD
    robot.step(times=5)
    assert robot.stamp == first + 5 * PERIOD
    assert robot.states[-1].name[:7] == JOINTS
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_an_unanswered_state_is_sent_again_and_nothing_moves(ros):
    robot = RobotProbe(ros)
    ros.wait_until(lambda: len(robot.states) >= 3, "repeats")
    assert set(robot.states.stamps) == {PERIOD}


@pytest.mark.parametrize(
    ("reason", "send"),
    [
        ("not finite", lambda r: r.send(r.stamp, [math.nan] * 7)),
        ("not finite", lambda r: r.send(r.stamp, [math.inf] + [0.0] * 6)),
        ("wrong size", lambda r: r.send(r.stamp, [1.0] * 3)),
        ("missing joint", lambda r: r.send(r.stamp, [1.0] * 6, JOINTS[1:])),
        ("wrong size", lambda r: r.send(r.stamp)),
        ("wrong size", lambda r: r.send(r.stamp, q=Q[:3])),
        ("wrong size", lambda r: r.send(r.stamp, q=Q, v=[0.0])),
        ("wrong size", lambda r: r.send(r.stamp, [1.0] * 3, q=Q)),
        ("not finite", lambda r: r.send(r.stamp, q=[math.nan] * 7)),
        ("not finite", lambda r: r.send(r.stamp, q=Q, v=[0.0] * 6 + [math.inf])),
        ("not finite", lambda r: r.send(r.stamp, [math.nan] * 7, q=Q)),
        ("missing joint", lambda r: r.send(r.stamp, q=Q[1:], joints=JOINTS[1:])),
        ("not for this period", lambda r: r.send(r.stamp - PERIOD, q=Q)),
        ("not for this period", lambda r: r.send(r.stamp - PERIOD, [1.0] * 7)),
        ("not for this period", lambda r: r.send(r.stamp + PERIOD, [1.0] * 7)),
    ],
)
def test_commands_that_cannot_be_obeyed_are_dropped_and_counted(ros, reason, send):
    robot = RobotProbe(ros)
    robot.step(times=3)
    stamp = robot.stamp
    send(robot)
    ros.wait_until(lambda: f"{reason}: 1;" in robot.reported("commands_refused"))
    assert robot.stamp == stamp
    robot.step()  # and it goes on


def test_names_may_come_in_any_order(ros):
    robot = RobotProbe(ros)
    order = [3, 1, 6, 0, 2, 5, 4]
    for _ in range(20):
        stamp, tau = robot.stamp, robot.gravity()
        robot.send(stamp, tau[order], [JOINTS[i] for i in order])
        ros.wait_until(lambda s=stamp: robot.stamp > s)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)


def test_torque_beyond_the_limits_is_clipped_and_reported(ros):
    robot = RobotProbe(ros)
    robot.step(3.0 * np.array(VALUES["torque_max"]))
    robot.step()
    ros.wait_until(lambda: float(robot.reported("commanded_torque_ratio_max") or 0.0) > 2.9)
    applied = np.array([float(x) for x in robot.reported("torque_ratio").split()])
    assert applied.max() <= 1.0 + 1e-9


def test_effort_is_the_torque_that_the_motors_gave(ros):
    robot = RobotProbe(ros)
    tau = robot.gravity() + 0.5
    robot.step(tau)
    np.testing.assert_allclose(robot.tau, tau, rtol=1e-12)


def test_other_joints_in_a_command_are_ignored(ros):
    robot = RobotProbe(ros)
    stamp, tau = robot.stamp, robot.gravity()
    robot.send(stamp, [math.nan, *tau], ["other", *JOINTS])
    ros.wait_until(lambda: robot.stamp > stamp, "the next state")
    np.testing.assert_allclose(robot.tau, tau, rtol=1e-12)


def test_positions_are_held_by_the_drives(ros):
    robot = RobotProbe(ros)
    robot.move(Q, times=30)
    np.testing.assert_allclose(robot.q, Q, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(robot.tau, robot.gravity(), atol=0.05)
    robot.await_reported("control", "position")
    goal = Q + np.linspace(-0.1, 0.1, 7)
    robot.move(goal, times=400)
    np.testing.assert_allclose(robot.q, goal, rtol=0.0, atol=1e-3)
    assert robot.reported("commands_refused") == "none"
    assert max(float(x) for x in robot.reported("torque_ratio").split()) <= 1.0


def test_positions_may_come_in_any_order_and_with_velocities(ros):
    robot = RobotProbe(ros)
    order = [3, 1, 6, 0, 2, 5, 4]
    speed = np.linspace(0.05, 0.1, 7)
    for k in range(100):
        stamp, path = robot.stamp, Q + speed * (k + 1) * PERIOD * 1e-9
        names = [*(JOINTS[i] for i in order), "other"]
        robot.send(stamp, joints=names, q=[*path[order], 9.0], v=[*speed[order], 9.0])
        ros.wait_until(lambda s=stamp: robot.stamp > s)
    np.testing.assert_allclose(robot.q, path, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(robot.v, speed, atol=0.01)


def test_control_changes_at_any_time_without_a_jump(ros):
    robot = RobotProbe(ros)
    robot.step(times=5)
    tau = robot.tau
    q, v = robot.q, robot.v
    robot.move(q + v * PERIOD * 1e-9, v)
    assert (np.abs(robot.tau - tau) < 1e-3 * np.abs(tau).max()).all()
    robot.move(q, times=20)
    robot.send(robot.stamp, robot.gravity(), q=Q + 1.0)  # efforts win
    robot.await_reported("control", "torque")
    robot.step(times=20)
    np.testing.assert_allclose(robot.q, Q, atol=1e-3)


def test_positions_are_held_for_the_time_out_and_then_braked(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=3, **BRAKES)
    ros.wait_until(
        lambda: robot.reported("control") == "position",
        each=lambda: robot.send(robot.stamp, q=Q),
        period=0.001,
    )
    robot.await_reported("control", "brakes")
    assert int(robot.reported("deadline_misses")) >= 3
    np.testing.assert_allclose(robot.q, Q, rtol=0.0, atol=1e-3)


def test_joint_friction_and_masses_reach_the_robot(ros):
    friction = [1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
    robot = RobotProbe(
        ros,
        friction_coulomb=friction,
        friction_static=[2.0 * f for f in friction],
        friction_viscous=[0.1] * 7,
        stribeck_velocity=[0.02] * 7,
        torque_bias=[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1],
        rotor_inertia=[0.1] * 7,
        mass_scale_links=["panda_link4"],
        mass_scales=[1.2],
    )
    simulated = robot.node._config.joint_friction
    np.testing.assert_array_equal(simulated.friction_coulomb, friction)
    np.testing.assert_array_equal(simulated.friction_static, 2.0 * np.array(friction))
    np.testing.assert_array_equal(simulated.friction_viscous, 0.1)
    np.testing.assert_array_equal(simulated.stribeck_velocity, 0.02)
    np.testing.assert_array_equal(simulated.torque_bias, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1])
    np.testing.assert_array_equal(simulated.rotor_inertia, 0.1)
    assert robot.node._config.scaled_links == {"panda_link4": 1.2}
    # Less than the stiction, though wrong by the mass error and more: it stays where it is.
    robot.step(times=50)
    np.testing.assert_allclose(robot.q, Q, rtol=0.0, atol=1e-12)
    robot.step(robot.gravity() + 5.0, times=20)
    assert np.abs(robot.v).max() > 0.1


def test_talos_stands_still_by_its_friction_alone(ros):
    """Of its own file: 10% of the torque is friction, and the controller's model is 10% light."""
    values = read_config("talos_left_arm", "bullet_node")
    states = ros.listen(JointState, "joint_states")
    node = ros.start(BulletNode, values | {"clock": "lockstep"})
    commands = ros.talk(JointState, "joint_commands")
    ros.wait_until(lambda: states, "a state")
    locked = dict(zip(values["locked_joints"], values["locked_positions"], strict=True))
    model = build_model(
        read_urdf(values["robot_description"]), values["joints"], locked, values["rotor_inertia"]
    )
    q, tau_max = np.array(values["start_positions"]), np.array(values["torque_max"])
    simulated, masses = node._config.joint_friction, node._config.scaled_links
    np.testing.assert_allclose(simulated.friction_coulomb, 0.1 * tau_max)
    np.testing.assert_array_less(simulated.friction_coulomb, simulated.friction_static)
    np.testing.assert_array_equal(simulated.rotor_inertia, model.armature)
    assert set(masses.values()) == {1.1}
    room = np.minimum(q - values["position_min"], np.array(values["position_max"]) - q)
    assert room.min() > 0.3
    tau = pin.computeGeneralizedGravity(model, model.createData(), q)
    for _ in range(100):
        stamp = stamp_to_ns(states[-1].header.stamp)
        commands.publish(joint_state(values["joints"], stamp, tau=tau))
        ros.wait_until(lambda s=stamp: stamp_to_ns(states[-1].header.stamp) > s)
    np.testing.assert_allclose(states[-1].position[: len(q)], q, rtol=0.0, atol=1e-12)


def test_without_stiction_of_its_own_a_joint_has_that_of_coulomb(ros):
    robot = RobotProbe(ros, friction_coulomb=[1.0] * 7)
    np.testing.assert_array_equal(robot.node._config.joint_friction.friction_static, 1.0)


def test_reset_brings_it_back_to_the_start_at_rest(ros):
    robot = RobotProbe(ros)
    robot.push("panda_link4", 50.0)
    robot.step(robot.gravity() + 1.0, times=30)
    assert np.abs(robot.q - Q).max() > 1e-4
    robot.send(0, [1.0] * 7)
    ros.wait_until(lambda: "not for this period" in robot.reported("commands_refused"))
    before = robot.stamp
    assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
    ros.wait_until(lambda: robot.stamp > before)
    np.testing.assert_array_equal(robot.q, Q)
    np.testing.assert_array_equal(robot.v, np.zeros(7))
    # The push is gone, and all counts are at zero.
    robot.step(times=5)
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)
    ros.wait_until(lambda: robot.reported("periods") == "5")
    assert robot.reported("commands_refused") == "none"


def test_pause_stops_time_and_resuming_asks_anew(ros):
    robot = RobotProbe(ros)
    robot.step(times=2)
    ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=True))
    robot.await_reported("paused", "True")
    stamp = robot.stamp
    robot.send(stamp, robot.gravity())
    ros.run_for(0.1)
    assert robot.stamp == stamp
    ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))
    ros.wait_until(lambda: robot.stamp == stamp + PERIOD, "a state with a new stamp")
    robot.step()


def test_it_pauses_itself_after_the_time_asked_for(ros):
    robot = RobotProbe(ros, start_paused=True)
    ros.accepts("bullet_node", pause_after=0.02)
    ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))
    for _ in range(10):
        stamp = robot.stamp
        ros.wait_until(
            lambda s=stamp: robot.stamp > s or robot.reported("paused") == "True",
            each=lambda: robot.send(robot.stamp, robot.gravity()),
        )
    robot.await_reported("paused", "True")
    assert robot.reported("periods") == "10"


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


def test_the_sensor_is_published_for_each_state_with_bias_and_seeded_noise(ros):
    robot = RobotProbe(ros, ft_seed=3)
    felt = ros.listen(WrenchStamped, "ft_wrench")
    ros.hears("ft_wrench")

    def course():
        """Let 40 periods pass after a reset; return what was felt, shape (40, 6)."""
        begin = robot.stamp
        assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
        ros.wait_until(lambda: robot.stamp > begin)
        robot.step(times=40)
        ros.wait_until(lambda: felt and felt.stamps[-1] == robot.stamp)
        of = {stamp_to_ns(message.header.stamp): message.wrench for message in felt}
        wrenches = [of[stamp] for stamp in sorted(of) if stamp > begin + PERIOD]
        assert felt[-1].header.frame_id == VALUES["ft_frame"]
        return np.array(
            [
                [w.force.x, w.force.y, w.force.z, w.torque.x, w.torque.y, w.torque.z]
                for w in wrenches
            ]
        )

    one, other = course(), course()
    assert one.shape == (40, 6)
    np.testing.assert_array_equal(one, other)
    noise, bias = np.array(VALUES["ft_noise"]), np.array(VALUES["ft_bias"])
    assert (0.5 * noise < one.std(axis=0)).all() and (one.std(axis=0) < 2.0 * noise).all()
    tool = inertia_beyond(read_urdf(VALUES["robot_description"]), VALUES["ft_frame"])
    weight = one.mean(axis=0)[:3] - bias[:3]  # the hand points down
    np.testing.assert_allclose(weight, [0.0, 0.0, 9.81 * tool.mass], atol=0.08)


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


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_robot_state_publisher_can_place_every_link(ros, robot):
    """It reads the description, and the joints by name: those that are locked, too."""
    node = ros.start(BulletNode, read_config(robot, "bullet_node") | {"clock": "lockstep"})
    states = ros.listen(JointState, "joint_states", qos_profile_sensor_data)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    descriptions = ros.listen(String, "robot_description", latched)
    ros.wait_until(lambda: states and descriptions)
    state, model = states[-1], pin.buildModelFromXML(descriptions[0].data)
    assert set(state.name) == set(model.names) - {"universe"}
    q, data = pin.neutral(model), model.createData()
    for name, position in zip(state.name, state.position, strict=True):
        joint = model.joints[model.getJointId(name)]
        angle = [math.cos(position), math.sin(position)]  # of a continuous joint
        q[joint.idx_q : joint.idx_q + joint.nq] = [position] if joint.nq == 1 else angle
    pin.framesForwardKinematics(model, data, q)
    links = [f.name for f in model.frames if f.type == pin.FrameType.BODY and f.name != "universe"]
    for link in links:
        placed = data.oMf[model.getFrameId(link, pin.FrameType.BODY)]
        simulated = node._robot.link_pose(link)
        np.testing.assert_allclose(placed.homogeneous, simulated.homogeneous, atol=1e-6)
    others = slice(len(node._config.joints), None)
    assert not any(state.velocity[others]) and not any(state.effort[others])
    assert len(state.velocity) == len(state.effort) == len(state.name)


def test_robot_description_and_clock_are_published(ros):
    clocks = ros.listen(Clock, "/clock")
    robot = RobotProbe(ros, publish_clock=True)
    late = ros.listen(String, "robot_description", LATCHED_QOS)
    ros.wait_until(lambda: late)
    assert "<robot" in late[0].data
    robot.step()
    ros.wait_until(lambda: clocks and stamp_to_ns(clocks[-1].clock) == robot.stamp)


def test_in_real_time_it_keeps_its_rate_and_brakes_without_commands(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=3, **BRAKES)
    # Not one command yet: the brakes hold it, and no deadline has been missed.
    ros.wait_until(lambda: int(robot.reported("braked_periods") or 0) > 10)
    assert robot.reported("deadline_misses") == "0"
    np.testing.assert_allclose(robot.q, Q, atol=1e-6)
    assert 50.0 < float(robot.reported("rate_hz")) < 120.0

    def answer():
        robot.send(robot.stamp, robot.gravity() + 0.3)

    ros.wait_until(
        lambda: np.abs(robot.v).max() > 1e-3, "motion under commands", each=answer, period=0.001
    )
    braked = int(robot.reported("braked_periods"))
    # Silence: held for three periods, then braked to rest.
    ros.wait_until(lambda: np.abs(robot.v).max() < 1e-6, "rest under the brakes")
    ros.wait_until(lambda: int(robot.reported("braked_periods")) > braked)
    ros.wait_until(lambda: int(robot.reported("deadline_misses")) >= 3)
    assert "braking" in robot.reported("message")


def test_when_commands_fail_it_stops_within_its_limits_and_goes_on_when_they_return(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=2)
    robot.await_reported("control", "brakes")  # there was no command yet
    assert robot.node._robot._brakes.all()
    push = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def answer():
        robot.send(robot.stamp, robot.gravity() + push)

    ros.wait_until(lambda: robot.v[0] > 0.3, "motion under commands", each=answer, period=0.001)
    robot.await_reported("control", "stopped")
    ros.wait_until(lambda: np.abs(robot.v).max() < 1e-6, "rest")
    assert robot.reported("message") == "stopped: no commands"
    assert int(robot.reported("braked_periods")) > 2
    assert max(map(float, robot.reported("velocity_violation_rad_s").split())) == 0.0
    held, q = robot.tau, robot.q
    np.testing.assert_allclose(held, robot.gravity(), atol=0.05)  # of the motors: no brakes
    # Back at rest: the torque that holds it goes on.
    ros.wait_until(
        lambda: robot.reported("control") == "torque",
        "commands",
        each=lambda: robot.send(robot.stamp, held),
        period=0.001,
    )
    np.testing.assert_allclose(robot.q, q, atol=1e-3)


@pytest.mark.parametrize(("declared", "warns"), [(0, False), (3, True), (4, False)])
def test_it_says_that_it_goes_on_for_longer_than_the_bounds_cover(ros, capfd, declared, warns):
    RobotProbe(ros, command_timeout=4, missed_deadlines=declared)
    said = (
        "'command_timeout' is 4, but the bounds cover 3 missed periods" in capfd.readouterr().err
    )
    assert said == warns


def test_the_brakes_hold_it_again_after_a_reset(ros):
    robot = RobotProbe(ros, clock="real_time", rate_hz=100.0, command_timeout=1)
    ros.wait_until(
        lambda: robot.reported("control") == "torque",
        each=lambda: robot.send(robot.stamp, robot.gravity()),
        period=0.001,
    )
    robot.await_reported("control", "stopped")
    ros.call(Trigger, "bullet_node/reset", Trigger.Request())
    robot.await_reported("control", "brakes")


def test_the_first_period_after_a_pause_is_a_whole_one(ros):
    """Resumed anywhere between two ticks, a robot leaves time to answer before the next."""
    robot = RobotProbe(ros, clock="real_time", rate_hz=5.0)
    known = {"stamp": 0}

    def answer():
        if robot.stamp != known["stamp"]:
            known["stamp"] = robot.stamp
            robot.send(robot.stamp, robot.gravity())

    def misses():
        ros.diagnostics.clear()
        ros.wait_until(lambda: robot.reported("deadline_misses"), each=answer, period=0.0)
        return int(robot.reported("deadline_misses"))

    ros.wait_until(lambda: robot.reported("message") == "running", each=answer, period=0.0)
    for _ in range(5):  # a busy machine may stall for longer than a period
        before = misses()
        for wait in (0.05, 0.1, 0.15):
            ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=True))
            ros.run_for(wait)
            paused_at = robot.stamp
            ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))
            ros.wait_until(
                lambda s=paused_at: robot.stamp > s + 200_000_000, each=answer, period=0.0
            )
        if misses() == before:
            return
    pytest.fail("a deadline is missed after each pause")


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"joints": [*JOINTS[:6], "elbow"]}, "joints", "elbow"),
        ({"joints": [*JOINTS[:6], JOINTS[0]]}, "joints", "each once"),
        ({"joints": None}, "joints", "not set"),
        ({"locked_joints": ["wing"], "locked_positions": [0.1]}, "locked_joints", "wing"),
        (
            {"locked_joints": [JOINTS[0]], "locked_positions": [0.1]},
            "locked_joints",
            JOINTS[0],
        ),
        ({"locked_joints": ["panda_finger_joint1"]}, "locked_positions", "1 numbers"),
        ({"robot_description": "/no/such.urdf"}, "robot_description", "no such file"),
        ({"robot_description": __file__}, "robot_description", "not well-formed"),
        ({"robot_description": "topic"}, "robot_description", "topic"),
        ({"position_min": VALUES["position_max"]}, "position_max", "above position_min"),
        ({"position_max": [1.0]}, "position_max", "7 numbers"),
        ({"velocity_max": [0.0] * 7}, "velocity_max", "> 0"),
        ({"acceleration_min": [1.0] * 7}, "acceleration_min", "< 0"),
        ({"acceleration_max": [15.0] * 3}, "acceleration_max", "7 numbers"),
        ({"acceleration_max": []}, "acceleration_max", "the other limit is given"),
        ({"velocity_max": [math.nan] * 7}, "velocity_max", "nan"),
        ({"torque_max": [-1.0] * 7}, "torque_max", "> 0"),
        ({"start_positions": [0.0] * 6}, "start_positions", "7 numbers"),
        ({"start_positions": [math.inf] * 7}, "start_positions", "inf"),
        ({"start_positions": None}, "start_positions", "not set"),
        ({"rate_hz": -1.0}, "rate_hz", "> 0"),
        ({"physics_step_max": math.nan}, "physics_step_max", "nan"),
        ({"clock": "cuckoo"}, "clock", "real_time, lockstep"),
        ({"command_timeout": 0}, "command_timeout", ">= 1"),
        ({"command_timeout": 1.5}, "command_timeout", "a whole number"),
        ({"pause_after": -1.0}, "pause_after", ">= 0"),
        ({"external_wrench_timeout": 0.0}, "external_wrench_timeout", "> 0"),
        ({"start_paused": "yes"}, "start_paused", "true or false"),
        ({"friction_coulomb": [1.0] * 6}, "friction_coulomb", "7 numbers"),
        ({"friction_coulomb": [-1.0] * 7}, "friction_coulomb", ">= 0"),
        ({"friction_static": [math.inf] * 7}, "friction_static", "inf"),
        (
            {"friction_coulomb": [1.0] * 7, "friction_static": [0.5] * 7},
            "friction_static",
            "at least friction_coulomb",
        ),
        ({"friction_viscous": [math.nan] * 7}, "friction_viscous", "nan"),
        ({"stribeck_velocity": [0.0] * 7}, "stribeck_velocity", "> 0"),
        ({"torque_bias": [math.inf] * 7}, "torque_bias", "finite"),
        ({"torque_bias": [1.0]}, "torque_bias", "7 numbers"),
        ({"rotor_inertia": [-0.1] * 7}, "rotor_inertia", ">= 0"),
        ({"rotor_inertia": [0.1] * 3}, "rotor_inertia", "7 numbers"),
        ({"mass_scale_links": ["panda_link4"]}, "mass_scales", "1 numbers"),
        ({"mass_scales": [1.1]}, "mass_scales", "0 numbers"),
        (
            {"mass_scale_links": ["panda_link4"], "mass_scales": [0.0]},
            "mass_scales",
            "> 0",
        ),
        ({"mass_scale_links": ["wing"], "mass_scales": [1.1]}, "mass_scale_links", "wing"),
        (
            {"mass_scale_links": ["panda_link4"] * 2, "mass_scales": [1.1, 1.1]},
            "mass_scale_links",
            "each once",
        ),
        ({"obstacle_friction": -0.1}, "obstacle_friction", ">= 0"),
        ({"obstacle_stiffness": 0.0}, "obstacle_stiffness", "> 0"),
        ({"obstacle_damping": math.nan}, "obstacle_damping", "nan"),
        ({"ft_frame": "wing"}, "ft_frame", "carries others"),
        ({"ft_frame": "panda_leftfinger"}, "ft_frame", "carries others"),
        ({"ft_frame": ""}, "ft_bias", "only with"),
        ({"ft_bias": [1.0] * 3}, "ft_bias", "6 finite numbers"),
        ({"ft_noise": [math.inf] * 6}, "ft_noise", "6 finite numbers"),
        ({"ft_noise": [-0.1] * 6}, "ft_noise", ">= 0"),
        ({"ft_seed": -1}, "ft_seed", ">= 0"),
        ({"encoder_resolution": [1e-4]}, "encoder_resolution", "7 numbers"),
        ({"encoder_resolution": [-1e-4] * 7}, "encoder_resolution", ">= 0"),
        ({"position_noise": [math.nan] * 7}, "position_noise", "nan"),
        ({"velocity_source": "encoders"}, "velocity_source", "did you mean 'encoder'?"),
        ({"velocity_filter_hz": 250.0}, "velocity_filter_hz", "half of rate_hz, 250"),
        ({"velocity_filter_hz": -1.0}, "velocity_filter_hz", ">= 0"),
        ({"velocity_noise": [0.1] * 6}, "velocity_noise", "7 numbers"),
        ({"state_delay": -1}, "state_delay", ">= 0"),
        ({"state_delay": 1.5}, "state_delay", "a whole number"),
        ({"command_delay": 101}, "command_delay", "<= 100"),
        ({"motor_bandwidth": [-1.0] * 7}, "motor_bandwidth", ">= 0"),
        ({"torque_constant_error": [1.0] * 7}, "torque_constant_error", "<= 0.5"),
        ({"torque_ripple": [1.0] * 7}, "torque_ripple", "<= 0.5"),
        ({"current_noise": [1.0] * 7}, "current_noise", "<= 0.2"),
        ({"missed_probability": 1.0}, "missed_probability", "< 1"),
        ({"missed_in_row": 0}, "missed_in_row", ">= 1"),
        ({"imperfection_seed": -1}, "imperfection_seed", ">= 0"),
    ],
)
def test_it_does_not_start_with_bad_parameters(ros, changed, name, shown):
    with pytest.raises(SettingError) as refusal:
        ros.start(BulletNode, VALUES | changed)
    text = str(refusal.value)
    assert refusal.value.name == name
    assert re.fullmatch(rf"parameter '{name}' is (.+); allowed: (.+)", text), text
    assert shown in text


def test_a_bad_time_to_pause_is_refused_while_it_runs(ros):
    robot = RobotProbe(ros)
    assert names_parameter(ros.refuses("bullet_node", pause_after=-1.0), "pause_after")
    assert "read-only" in ros.refuses("bullet_node", rate_hz=100.0)
    robot.step(times=3)


def test_a_broken_limit_is_an_error_in_diagnostics(ros):
    robot = RobotProbe(ros)
    for _ in range(400):
        robot.step(robot.gravity() + np.array([0.0] * 6 + [6.0]))
        if np.abs(robot.v[6]) > VALUES["velocity_max"][6] + 0.1:
            break
    ros.wait_until(lambda: robot.reported("message") == "a limit was broken")
    violation = [float(x) for x in robot.reported("velocity_violation_rad_s").split()]
    assert violation[6] > 0.1
    assert max(violation[:5]) < 0.1


def test_payloads_come_and_go_with_their_stamps(ros):
    """Gravity is compensated without them, so that they accelerate the arm."""
    robot = RobotProbe(ros)
    payloads = ros.talk(InertiaStamped, "payload", GOAL_QOS)

    def send(link, mass, stamp=0, inertia=0.0):
        message = InertiaStamped()
        message.header.frame_id = link
        message.inertia.m, message.inertia.com.z, message.inertia.izz = mass, 0.1, inertia
        set_stamp(message.header.stamp, stamp)
        payloads.publish(message)

    start = robot.stamp
    send("panda_hand", 2.0, start + 3 * PERIOD)
    send("panda_hand", 0.0, start + 6 * PERIOD)
    send("panda_hand", -2.0)
    send("panda_hand", 1.0, inertia=0.5)
    send("panda_lnik5", 1.0)
    send("panda_link0", 1.0)
    send("panda_hand", math.nan)
    ros.wait_until(lambda: len(robot.node._world) == 2, "the payloads")
    robot.await_reported("world_changes_pending", "2")
    assert "payload: 5;" in robot.reported("commands_refused")
    robot.step(times=20)
    velocities = {}
    for stamp, state in zip(robot.states.stamps, robot.states, strict=True):
        velocities[stamp] = np.array(state.velocity[:7])
    v = np.array([velocities[start + k * PERIOD] for k in range(21)])
    changes = np.abs(np.diff(v, axis=0)).max(axis=1)
    payload = payload_inertia("panda_hand", 2.0, [0.0, 0.0, 0.1], [0.0] * 6)
    model = build_model(read_urdf(VALUES["robot_description"]), JOINTS)
    frame = model.frames[model.getFrameId("panda_hand", pin.FrameType.BODY)]
    hold = pin.computeGeneralizedGravity(model, model.createData(), Q)
    model.appendBodyToJoint(frame.parentJoint, payload, frame.placement)
    a = pin.aba(model, model.createData(), Q, np.zeros(7), hold)
    assert max(changes[:3]) < 1e-9
    np.testing.assert_allclose(changes[3], np.abs(a).max() * PERIOD * 1e-9, rtol=0.02)
    assert min(changes[3:6]) > 0.9 * changes[3]
    assert max(changes[6:]) < 0.1 * changes[3]
    send("panda_hand", 2.0)
    ros.wait_until(lambda: len(robot.node._world) == 1, "the payload")
    robot.step()
    assert robot.node._robot._payloads
    assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
    assert not robot.node._robot._payloads
