# SPDX-License-Identifier: Apache-2.0
"""Friction of the simulated TALOS: told from a recording, and compensated."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pinocchio as pin
import pytest
from direct import DirectLoop, column, distance

from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from sim_bridge.tools.record_excitation import excitation, record
from torque_safety_controller.friction.identification import friction_model, identify
from torque_safety_controller.friction.joint_recording import Recording
from torque_safety_controller.parts.friction import Friction
from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

pytestmark = pytest.mark.long

ROBOT = "talos_left_arm"
GIVEN = read_config(ROBOT, "bullet_node")
MODEL = ("coulomb", "static", "viscous")
STILL = 1e-4  # rad/s


def test_friction_is_identified_despite_wrong_masses():
    """From 36 s of motion of arms 10% heavier than the model; the controller's file has it."""
    config = read(BulletConfiguration, GIVEN)
    assert set(GIVEN["mass_scales"]) == {1.1}
    with closing(make_robot(config)) as robot:
        motion = excitation(config, config.start_positions, config.dt)
        recorded, monitor = record(robot, config, *motion)
    assert not monitor.violated
    model = read_robot(config_folder() / f"{ROBOT}.yaml").model
    fits = list(identify(model, Recording(**recorded)))
    assert not any(fit.notes for fit in fits)
    found, written = friction_model(fits), read_config(ROBOT, "controller_node")
    for name, true, within in (
        ("coulomb", "friction_coulomb", 0.05),
        ("viscous", "friction_viscous", 0.05),
        ("static", "friction_static", 0.1),
        ("stribeck_velocity", "stribeck_velocity", 0.1),
    ):
        np.testing.assert_allclose(getattr(found, name), GIVEN[true], rtol=within, err_msg=name)
        own = written[f"friction_model_{name}"]
        np.testing.assert_allclose(getattr(found, name), own, rtol=0.01, err_msg=name)


def reach(share, integral="none") -> tuple[float, float]:
    """Return the error, m, and the speed, rad/s, that remain of TALOS at a goal.

    It believes in `share` of its friction and compensates that; 0: off.
    """
    loop = DirectLoop(ROBOT, {"integral_action": integral})
    model = loop.controller.find(Friction).settings.model
    believed = {f"friction_model_{name}": share * getattr(model, name) for name in MODEL}
    if share:
        loop.change(friction_compensation=1.0, **believed)
    offset = pin.SE3(np.eye(3), np.array([0.06, -0.08, 0.05]))
    loop.controller.goals.set_pose(loop.pose() * offset)
    last = loop.run(2.5)[-300:]
    assert not loop.robot.monitor.violated
    return distance(last).max(), np.abs(column(last, "v")).max()


def test_a_pose_is_reached_and_kept_without_a_limit_cycle():
    without, _ = reach(0.0)
    assert 3e-3 < without < 2e-2
    for share, better in ((0.7, 1.5), (1.3, 8.0)):
        error, speed = reach(share)
        assert error < without / better, share
        assert speed < STILL, share


def test_it_does_not_hunt_with_the_integral():
    assert reach(1.3, "joints")[0] < 2.5e-4
