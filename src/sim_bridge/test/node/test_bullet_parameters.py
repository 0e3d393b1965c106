# SPDX-License-Identifier: Apache-2.0
"""The robot node: its parameters, and those that it refuses."""

import math

import numpy as np
import pinocchio as pin
import pytest
from robot_probe import JOINTS, VALUES, Q, RobotProbe
from sensor_msgs.msg import JointState

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.robot.description import build_model, read_urdf
from viability_bounds_pkg.ros.runtime import (
    stamp_to_ns,
)
from viability_bounds_pkg.testing.ros_harness import joint_state, names_parameter, read_config


def test_joint_friction_and_masses_reach_the_robot(ros):
    friction = [1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
    robot = RobotProbe(
        ros,
        friction_coulomb=friction,
        friction_static=[2.0 * f for f in friction],
        friction_viscous=[0.1] * 7,
        stribeck_velocity=[0.02] * 7,
        rotor_inertia=[0.1] * 7,
        mass_scale_links=["panda_link4"],
        mass_scales=[1.2],
    )
    simulated = robot.node._config.joint_friction
    np.testing.assert_array_equal(simulated.friction_coulomb, friction)
    np.testing.assert_array_equal(simulated.friction_static, 2.0 * np.array(friction))
    np.testing.assert_array_equal(simulated.friction_viscous, 0.1)
    np.testing.assert_array_equal(simulated.stribeck_velocity, 0.02)
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
        ({"rate_hz": -1.0}, "rate_hz", ">= 1"),
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
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name, shown):
    shared_ros.refuses_to_start(BulletNode, VALUES | changed, name, shown)


def test_a_bad_time_to_pause_is_refused_while_it_runs(ros):
    robot = RobotProbe(ros)
    assert names_parameter(ros.refuses("bullet_node", pause_after=-1.0), "pause_after")
    assert "read-only" in ros.refuses("bullet_node", rate_hz=100.0)
    robot.step(times=3)
