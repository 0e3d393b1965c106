# SPDX-License-Identifier: Apache-2.0
"""The robot node: its parameters, and those that it refuses."""

import math

import numpy as np
import pinocchio as pin
import pytest
from robot_probe import JOINTS, VALUES
from sensor_msgs.msg import JointState

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.ros_harness import joint_state, read_config


def test_talos_stands_still_by_its_friction_alone(ros):
    """10% of the torque is friction, and the controller's model is 10% light."""
    values = read_config("talos_left_arm", "bullet_node")
    joints, q = values["joints"], np.array(values["start_positions"])
    locked = dict(zip(values["locked_joints"], values["locked_positions"], strict=True))
    model = build_model(read_urdf(values["robot_description"]), joints, locked)
    tau = pin.computeGeneralizedGravity(model, model.createData(), q)
    moved = []
    for changed in ({}, {f"friction_{kind}": [] for kind in ("coulomb", "static")}):
        states = ros.listen(JointState, "joint_states")
        node = ros.start(BulletNode, values | {"clock": "lockstep"} | changed)
        commands = ros.talk(JointState, "joint_commands")
        ros.wait_until(lambda heard=states: heard, "a state")
        for _ in range(15):
            stamp = states.stamps[-1]
            commands.publish(joint_state(joints, stamp, tau=tau))
            ros.wait_until(lambda s=stamp, heard=states: heard.stamps[-1] > s)
        moved.append(np.abs(np.array(states[-1].position[: len(q)]) - q).max())
        ros.stop(node)
    assert moved[0] < 1e-12
    assert moved[1] > 1e-6


@pytest.mark.parametrize(
    ("changed", "name", "shown"),
    [
        ({"friction_coulomb": [1.0] * 3}, "friction_coulomb", "7 numbers"),
        ({"joints": [*JOINTS[:6], "elbow"]}, "joints", "elbow"),
        ({"locked_joints": ["wing"], "locked_positions": [0.1]}, "locked_joints", "wing"),
        ({"locked_joints": [JOINTS[0]], "locked_positions": [0.1]}, "locked_joints", JOINTS[0]),
        ({"robot_description": __file__}, "robot_description", "not well-formed"),
        ({"position_min": VALUES["position_max"]}, "position_max", "above position_min"),
        ({"velocity_max": [math.nan] * 7}, "velocity_max", "nan"),
        ({"acceleration_max": []}, "acceleration_max", "the other limit is given"),
        ({"acceleration_min": []}, "acceleration_min", "the other limit is given"),
        ({"rate_hz": 1.0, "physics_step_max": 1.0}, "acceleration_max", "steps of 1 s"),
        ({"clock": "cuckoo"}, "clock", "real_time, lockstep"),
        (
            {"friction_coulomb": [1.0] * 7, "friction_static": [0.5] * 7},
            "friction_static",
            "at least friction_coulomb",
        ),
        ({"mass_scales": [1.1]}, "mass_scales", "0 numbers"),
        ({"mass_scale_links": ["wing"], "mass_scales": [1.1]}, "mass_scale_links", "wing"),
        (
            {"mass_scale_links": ["panda_link4"] * 2, "mass_scales": [1.1, 1.1]},
            "mass_scale_links",
            "each once",
        ),
        ({"ft_frame": "panda_leftfinger"}, "ft_frame", "carries others"),
        ({"ft_frame": ""}, "ft_bias", "only with"),
        ({"ft_bias": [1.0] * 3}, "ft_bias", "6 finite numbers"),
        ({"velocity_source": "encoders"}, "velocity_source", "did you mean 'encoder'?"),
        ({"velocity_filter_hz": 250.0}, "velocity_filter_hz", "half of rate_hz, 250"),
    ],
)
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name, shown):
    shared_ros.refuses_to_start(BulletNode, VALUES | changed, name, shown)
