# SPDX-License-Identifier: Apache-2.0
"""The driver to copy, before real nodes: they move its arm to a goal; without them it stops."""

import runpy
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.executables import run_to_end
from viability_bounds_pkg.testing.ros_harness import TIMEOUT, joint_state, read_config

ROOT = Path(__file__).resolve().parents[2]
TEMPLATE = ROOT / "examples" / "driver_template.py"
PATIENCE = 10.0  # s; in which every command comes
PERIODS_TO_REST = 400
PANDA = read_config("panda", "bounds_node", "controller_node")
PANDA |= {"posture_kp": 100.0, "posture_weight": 1.0, "pose_weight": 0.0}
LOW, HIGH, FASTEST, STRONGEST, START = (
    np.array(PANDA[name])
    for name in ("position_min", "position_max", "velocity_max", "torque_max", "start_positions")
)
GOAL = np.where(START < 0.5 * (LOW + HIGH), HIGH, LOW) * 0.8 + START * 0.2


def run_until(ros, driver, condition):
    """Make the driver's periods until a condition holds; no limit is passed in any of them."""
    end, arm = time.monotonic() + TIMEOUT, driver.arm
    while not condition():
        assert time.monotonic() < end
        driver.run_once(ros.executor)
        assert (arm.q >= LOW).all() and (arm.q <= HIGH).all(), arm.q
        assert (np.abs(arm.v) <= FASTEST).all(), arm.v
        assert (np.abs(arm.tau) <= STRONGEST).all(), arm.tau


@pytest.mark.parametrize("gravity", [True, False])
def test_the_arm_goes_to_its_goal_and_stops_within_limits_when_commands_fail(ros, gravity):
    values = PANDA | {"command_includes_gravity": gravity, "effort_includes_gravity": gravity}
    driver = ros.start(runpy.run_path(str(TEMPLATE))["Driver"], values)
    arm, commands = driver.arm, ros.listen(JointState, "joint_commands")
    for kind in (BoundsNode, ControllerNode):
        ros.start(kind, values)
    run_until(ros, driver, lambda: commands)
    np.testing.assert_allclose(arm.q, START, atol=1e-3)  # rad; held before the first command
    goals = ros.talk(JointState, "target_posture", GOAL_QOS)
    goals.publish(joint_state(values["joints"], 0, GOAL))
    driver.wait = PATIENCE
    run_until(ros, driver, lambda: np.abs(arm.v / FASTEST).max() > 0.9)
    driver.wait = 0.0  # commands come too late
    periods = iter(range(PERIODS_TO_REST))
    run_until(ros, driver, lambda: next(periods, None) is None)
    assert np.abs(arm.v).max() < 1e-3  # rad/s
    assert np.abs(arm.q - GOAL).max() > 0.5  # rad
    driver.wait = PATIENCE
    run_until(ros, driver, lambda: np.abs(arm.q - GOAL).max() < 0.01)


def test_a_wrong_parameter_ends_it_with_one_line():
    arguments = ["--ros-args", "--params-file", ROOT / "config" / "panda.yaml"]
    ended = run_to_end(sys.executable, TEMPLATE, *arguments, "-p", "acceleration_max:=[1.0]")
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert line.startswith("error: parameter 'acceleration_max' is [1]; allowed: 7 numbers")
