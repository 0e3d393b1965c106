# SPDX-License-Identifier: Apache-2.0
"""The simulated FR3 and its parameter file, where libfranka and franky-sim are installed."""

import os
import subprocess
import sys
from contextlib import closing
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")

import mujoco

from franka_bridge.node.franka_parameters import SimulationConfiguration
from franka_bridge.simulated_arm import SimulatedArm, SimulationError
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import read_config

PID = os.getpid()
ADDRESS = f"127.46.{PID // 250 % 250}.{1 + PID % 250}"
CLIENT = """
import sys, pylibfranka
robot = pylibfranka.Robot(sys.argv[1], pylibfranka.RealtimeConfig.kIgnore)
control = robot.start_torque_control()
for torque in [0.0] * 50 + [1.0] * 50 + [2.5] * 50:
    control.readOnce()
    control.writeOnce(pylibfranka.Torques([torque] + [0.0] * 6))
end = pylibfranka.Torques([0.0] * 7)
end.motion_finished = True
control.readOnce()
control.writeOnce(end)
"""


class Record:
    """In place of the judge: all that it is told."""

    def __init__(self):
        self.states, self.torques = [], []

    def update(self, q, v, tau):
        self.states.append((q, v, tau))

    def sent(self, tau, before):
        self.torques.append((tau, before))


def config():
    return read(
        SimulationConfiguration, read_config("fr3", "simulated_fr3") | {"robot_ip": ADDRESS}
    )


def test_each_torque_of_a_client_is_judged_and_time_waits_for_it():
    start, record = config().start_positions, Record()
    with closing(SimulatedArm(ADDRESS, start, record, waits=True)) as arm:
        for _ in range(20):
            arm.step()
        held = record.states[-1][0]
        assert np.abs(held - start).max() < 1e-3  # rad
        with pytest.raises(SimulationError, match=f"no robot can listen at {ADDRESS}"):
            SimulatedArm(ADDRESS, start, record, waits=True)
        words = [sys.executable, "-c", CLIENT, ADDRESS]
        with subprocess.Popen(words, preexec_fn=as_child) as client:
            while client.poll() is None:
                arm.step()
        assert client.returncode == 0
        assert arm.missed == 0
        sent = np.array([tau[0] for tau, _ in record.torques])
        steps = sent - [before[0] for _, before in record.torques]
        np.testing.assert_array_equal(sent, [0.0] * 50 + [1.0] * 50 + [2.5] * 50 + [0.0])
        assert sorted(steps)[-2:] == [1.0, 1.5]
        arm.push("fr3_hand", np.array([0.0, 0.0, 20.0]), np.zeros(3))
        before = record.states[-1][0]
        for _ in range(100):
            arm.step()
        assert np.abs(record.states[-1][0] - before).max() > 1e-3  # rad
        with pytest.raises(SimulationError, match="no link 'no_such_link'"):
            arm.push("no_such_link", np.zeros(3), np.zeros(3))


def test_limits_of_the_parameter_file_are_those_of_the_urdf_or_narrower():
    given, urdf = config(), read_urdf(config().robot_description)
    joints = {each.get("name"): each for each in ElementTree.fromstring(urdf).iter("joint")}
    for j, name in enumerate(given.joints):
        limit, curve = (
            joints[name].find("limit"),
            joints[name].find("position_based_velocity_limits"),
        )
        assert given.position_min[j] >= float(limit.get("lower"))
        assert given.position_max[j] <= float(limit.get("upper"))
        assert given.velocity_max[j] <= float(limit.get("velocity"))
        assert given.torque_max[j] == float(limit.get("effort"))
        assert given.velocity_offset[j] == float(curve.get("velocity_offset"))
        assert given.deceleration_limit[j] == float(curve.get("deceleration_limit"))


def test_torque_limits_leave_room_for_the_gravity_that_the_robot_adds():
    """It is not the model's: the simulated hand weighs less."""
    given, rng = config(), np.random.default_rng(0)
    model = load_model(given, read_urdf(given.robot_description))
    data, differences = model.createData(), []
    with closing(SimulatedArm(ADDRESS, given.start_positions, Record(), waits=True)) as arm:
        simulator = arm._simulator
        for q in rng.uniform(given.position_min, given.position_max, (500, 7)):
            simulator.data.qpos[:7] = q
            mujoco.mj_forward(simulator.model, simulator.data)
            added = simulator.data.qfrc_bias[:7]
            differences.append(added - pin.computeGeneralizedGravity(model, data, q))
    worst = np.abs(differences).max(axis=0)
    assert worst[1] > 0.3  # N m
    assert (worst <= given.torque_max - read_config("fr3", "controller_node")["torque_max"]).all()
