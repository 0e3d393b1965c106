# SPDX-License-Identifier: Apache-2.0
"""The robot node with imperfect hardware, against the robot's dynamics without messages."""

from contextlib import closing

import numpy as np
import pytest
from robot_probe import BRAKES, JOINTS, VALUES, RobotProbe

from sim_bridge.command_path import CommandPath
from sim_bridge.hardware import Motors, Sensing
from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

N = len(JOINTS)
TORQUE_MAX = np.array(VALUES["torque_max"])
ROBOTS = sorted(path.stem for path in (config_folder() / "imperfect").glob("*.yaml"))
EVERYTHING = {
    "encoder_resolution": [1e-4] * N,
    "position_noise": [1e-5] * N,
    "velocity_source": "encoder",
    "velocity_filter_hz": 80.0,
    "velocity_noise": [0.01] * N,
    "state_delay": 1,
    "command_delay": 1,
    "motor_bandwidth": [100.0] * N,
    "torque_constant_error": [0.02] * N,
    "torque_ripple": [0.01] * N,
    "current_noise": [0.005] * N,
    "missed_probability": 0.2,
    "imperfection_seed": 3,
    # Without these limits held commands act unchanged.
    "acceleration_min": None,
    "acceleration_max": None,
}


def torques(count):
    """Return commands that move the arm gently about, shape (count, N)."""
    t = np.arange(count)[:, None]
    return 0.05 * TORQUE_MAX * np.sin((0.1 + 0.02 * np.arange(N)) * t)


def play(robot, commands):
    """Send a command for each period; return positions, velocities and efforts received."""
    first = len(robot.states) - 1
    for tau in commands:
        robot.step(tau)
    rows = list({state.header.stamp.nanosec: state for state in robot.states[first:]}.values())
    assert len(rows) == len(commands) + 1
    names = "position", "velocity", "effort"
    return [np.array([getattr(row, name)[:N] for row in rows]) for name in names]


def expected(commands, **changes):
    """Return what should be received: path, robot and sensing joined without messages."""
    config = read(BulletConfiguration, VALUES | changes)
    path, held, row = CommandPath(config.imperfections), None, 0
    sensing, braked = Sensing(config.imperfections, TORQUE_MAX, config.dt), 0
    with closing(make_robot(config)) as robot:
        robot.reset(config.start_positions, np.zeros(N))
        rows = [sensing.reset(*robot.state()[:2], robot.believed_torque)]
        for tau in commands:
            path.send(tau)
            arrived = path.due()
            row = row + 1 if arrived is None else 0
            held = held if arrived is None and row <= config.command_timeout else arrived
            if held is None:
                braked += 1
                robot.brake(config.substeps, TORQUE_MAX)
            else:
                robot.step(held, config.substeps)
            rows.append(sensing.read(*robot.state()[:2], robot.believed_torque))
    return [np.array(each) for each in zip(*rows, strict=True)], path.missed, braked


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({"missed_in_row": 7, "imperfection_seed": 5}, "none"),
        # Rows longer than the time-out lead to the brakes, and back.
        (
            {"missed_probability": 0.8, "missed_in_row": 6, "command_timeout": 2} | BRAKES,
            "missed_probability",
        ),
        (EVERYTHING, ", ".join(list(EVERYTHING)[:-3])),
    ],
    ids=["none", "rows", "everything"],
)
def test_readings_are_what_the_parts_make_of_the_true_motion_bit_for_bit(ros, given, names):
    robot, commands = RobotProbe(ros, **given), torques(60)
    rows, missed, braked = expected(commands, **given)
    for _ in range(2):  # the second time after a reset
        np.testing.assert_array_equal(play(robot, commands), rows)
        assert robot.reported_now("missed_deadlines_injected") == str(missed)
        assert robot.reported("deadline_misses") == "0"
        assert robot.reported("commands_refused") == "none"
        assert robot.reported("imperfections") == names
        if "command_timeout" in given:
            assert int(robot.reported("braked_periods")) == braked > 5
        robot.reset()


def test_a_pause_changes_no_reading(ros):
    """The state at the pause is published again with a new stamp, and not measured again."""
    robot = RobotProbe(ros, velocity_source="encoder", position_noise=[1e-3] * N)
    robot.step(np.zeros(N), times=10)
    q, v, stamp = robot.q, robot.v, robot.stamp
    robot.pause(True)
    robot.pause(False)
    ros.wait_until(lambda: robot.stamp > stamp, "a state with a new stamp")
    np.testing.assert_array_equal(robot.q, q)
    np.testing.assert_array_equal(robot.v, v)


@pytest.mark.parametrize("name", ROBOTS)
def test_each_robot_has_a_file_of_its_imperfections_with_which_it_can_be_held(name):
    own = read_config(name, "bullet_node") | read_config(f"imperfect/{name}", "bullet_node")
    config = read(BulletConfiguration, own)
    given = config.imperfections
    assert {"encoder_resolution", "motor_bandwidth", "missed_probability"} <= set(given.names)
    assert given.missed_in_row == config.command_timeout == own["missed_deadlines"]
    motors = Motors(given, config.torque_max, config.physics_dt)
    with closing(make_robot(config)) as robot:
        robot.reset(config.start_positions, np.zeros(len(config.joints)))
        robot.brake(1, config.torque_max)
        hold = robot.state().motor_torque
    torque = np.array([motors.step(hold, config.start_positions) for _ in range(100)])
    assert (np.abs(torque - hold) < 0.06 * config.torque_max).all()
