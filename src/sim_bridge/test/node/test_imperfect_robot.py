# SPDX-License-Identifier: Apache-2.0
"""The robot node with imperfect hardware, against the robot's dynamics without messages."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from robot_probe import BRAKES, JOINTS, VALUES, RobotProbe
from std_srvs.srv import SetBool, Trigger

from sim_bridge.command_path import CommandPath
from sim_bridge.hardware import Imperfections, Motors, Sensing
from sim_bridge.node.bullet_parameters import BulletConfiguration, make_robot
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config

N = len(JOINTS)
TORQUE_MAX = np.array(VALUES["torque_max"])
CONFIG = Path(__file__).resolve().parents[2] / "config"
ROBOTS = sorted(path.stem for path in (CONFIG / "imperfect").glob("*.yaml"))


def per_joint(value):
    return [value] * N


# Held commands act unchanged, whatever the limits.
NO_LAW = {"acceleration_min": None, "acceleration_max": None}
EVERYTHING = {
    "encoder_resolution": per_joint(1e-4),
    "position_noise": per_joint(1e-5),
    "velocity_source": "encoder",
    "velocity_filter_hz": 80.0,
    "velocity_noise": per_joint(0.01),
    "state_delay": 1,
    "command_delay": 1,
    "motor_bandwidth": per_joint(100.0),
    "torque_constant_error": per_joint(0.02),
    "torque_ripple": per_joint(0.01),
    "current_noise": per_joint(0.005),
    "missed_probability": 0.2,
    "missed_in_row": 3,
}


def lost(probability, longest, seed):
    """Return which of 100 commands miss their periods."""
    given = Imperfections(
        missed_probability=probability, missed_in_row=longest, imperfection_seed=seed
    )
    path = CommandPath(given)
    return [path.send(k) and path.due() is None for k in range(100)]


def torques(count, seed=0):
    """Return commands that move the arm gently about, shape (count, N)."""
    t = np.arange(count)[:, None]
    return 0.05 * TORQUE_MAX * np.sin((0.1 + 0.02 * np.arange(N)) * t + seed)


def truth(commands, **changes):
    """Return the states at the start of each period and at the end, in arrays of rows.

    Args:
        commands: torques of each period; None for the brakes.
        changes: of the configuration.
    """
    config = read(BulletConfiguration, VALUES | changes)
    with closing(make_robot(config)) as robot:
        robot.reset(config.start_positions, np.zeros(N))
        states = [robot.state()]
        for tau in commands:
            if tau is None:
                robot.brake(config.substeps, TORQUE_MAX)
            else:
                robot.step(tau, config.substeps)
            states.append(robot.state())
    return [np.array(each) for each in zip(*states, strict=True)]


def play(robot, commands):
    """Send a command for each period; return the states received, in arrays of rows."""
    first = len(robot.states) - 1
    for tau in commands:
        robot.step(tau)
    rows = list({state.header.stamp.nanosec: state for state in robot.states[first:]}.values())
    assert len(rows) == len(commands) + 1
    return [np.array([getattr(row, name)[:N] for row in rows]) for name in NAMES]


NAMES = ("position", "velocity", "effort")


def test_without_imperfections_the_motion_is_the_same_bit_for_bit(ros):
    robot = RobotProbe(ros, missed_in_row=7, imperfection_seed=5)
    assert robot.node._robot._motors is None
    commands = torques(60)
    for got, true in zip(play(robot, commands), truth(commands), strict=True):
        np.testing.assert_array_equal(got, true)
    robot.await_reported("imperfections", "none")


@pytest.mark.parametrize("delay", [1, 3])
def test_a_state_is_reported_so_many_periods_late(ros, delay):
    robot = RobotProbe(ros, state_delay=delay)
    commands = torques(30)
    for got, true in zip(play(robot, commands), truth(commands), strict=True):
        np.testing.assert_array_equal(got[delay:], true[:-delay])
        np.testing.assert_array_equal(got[:delay], np.tile(true[0], (delay, 1)))


@pytest.mark.parametrize("delay", [1, 3])
def test_a_command_acts_so_many_periods_late(ros, delay):
    robot = RobotProbe(ros, command_delay=delay)
    commands = list(torques(30))
    late = [None] * delay + commands[:-delay]
    for got, true in zip(play(robot, commands), truth(late), strict=True):
        np.testing.assert_array_equal(got, true)
    # That the brakes hold it until the first command is no failure of the commands.
    robot.await_reported("periods", "30")
    assert robot.reported("braked_periods") == "0"


def test_a_missed_command_is_not_applied_and_the_last_one_is_held(ros):
    robot = RobotProbe(ros, missed_probability=0.3, missed_in_row=3, imperfection_seed=8, **NO_LAW)
    commands = list(torques(80))
    missed, acting = lost(0.3, 3, 8), []
    assert not missed[0]
    for tau, late in zip(commands, missed, strict=False):
        acting.append(acting[-1] if late else tau)
    for got, true in zip(play(robot, commands), truth(acting), strict=True):
        np.testing.assert_array_equal(got, true)
    robot.await_reported("missed_deadlines_injected", str(sum(missed[: len(commands)])))
    assert robot.reported("deadline_misses") == "0"
    assert robot.reported("commands_refused") == "none"
    assert robot.reported("imperfections") == "missed_probability"


def test_a_row_longer_than_the_time_out_leads_to_the_brakes_and_back(ros):
    changes = {"missed_probability": 0.8, "missed_in_row": 6, "imperfection_seed": 1}
    robot = RobotProbe(ros, command_timeout=2, **BRAKES, **changes)
    commands = list(torques(60))
    acting, row = [None], 0
    for tau, missed in zip(commands, lost(0.8, 6, 1), strict=False):
        row = row + 1 if missed else 0
        acting.append(tau if row == 0 else acting[-1] if row <= 2 else None)
    acting = acting[1:]
    braked = sum(each is None for each in acting)
    assert 10 < braked < 50
    for got, true in zip(play(robot, commands), truth(acting), strict=True):
        np.testing.assert_array_equal(got, true)
    robot.await_reported("braked_periods", str(braked))


def test_everything_at_once_is_what_its_parts_make_of_the_true_motion(ros):
    """Seeded; and again after a reset."""
    robot = RobotProbe(ros, **EVERYTHING, **NO_LAW, imperfection_seed=3)
    config = read(BulletConfiguration, VALUES | EVERYTHING | {"imperfection_seed": 3})
    commands = list(torques(80))
    played = play(robot, commands)
    acting = [None]
    for tau, missed in zip(commands[:-1], lost(0.2, 3, 3), strict=False):
        acting.append(acting[-1] if missed else tau)
    with closing(make_robot(config)) as arm:
        arm.reset(config.start_positions, np.zeros(N))
        sensing = Sensing(config.imperfections, TORQUE_MAX, config.dt)
        state = arm.state()
        rows = [sensing.reset(state.q, state.v, arm.believed_torque)]
        for tau in acting:
            if tau is None:
                arm.brake(config.substeps, TORQUE_MAX)
            else:
                arm.step(tau, config.substeps)
            state = arm.state()
            rows.append(sensing.read(state.q, state.v, arm.believed_torque))
    for got, expected in zip(played, zip(*rows, strict=True), strict=True):
        np.testing.assert_array_equal(got, expected)
    robot.await_reported(
        "imperfections", ", ".join(name for name in EVERYTHING if name != "missed_in_row")
    )
    assert ros.call(Trigger, "bullet_node/reset", Trigger.Request()).success
    before = robot.stamp
    ros.wait_until(lambda: robot.stamp >= before)
    for again, once in zip(play(robot, commands), played, strict=True):
        np.testing.assert_array_equal(again, once)


def test_a_pause_changes_no_reading(ros):
    """The state at the pause is published again with a new stamp, and not measured again."""
    robot = RobotProbe(ros, velocity_source="encoder", position_noise=per_joint(1e-3))
    play(robot, torques(20))
    q, v, stamp = robot.q, robot.v, robot.stamp
    assert np.abs(v).max() > 0.1
    for paused in (True, False):
        ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=paused))
    ros.wait_until(lambda: robot.stamp > stamp, "a state with a new stamp")
    np.testing.assert_array_equal(robot.q, q)
    np.testing.assert_array_equal(robot.v, v)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_files_of_imperfect_robots_describe_one(name):
    own = read_config(name, "bullet_node")
    content = yaml.safe_load((CONFIG / "imperfect" / f"{name}.yaml").read_text())
    for section in ("/**", "/**/bullet_node"):
        own |= content.get(section, {}).get("ros__parameters", {})
    config = read(BulletConfiguration, own)
    given = config.imperfections
    expected = {
        "encoder_resolution",
        "velocity_source",
        "command_delay",
        "motor_bandwidth",
        "torque_constant_error",
        "torque_ripple",
        "current_noise",
        "missed_probability",
    }
    assert set(given.names) >= expected
    assert 1 <= given.state_delay + given.command_delay <= 2
    assert given.missed_in_row == config.command_timeout == own["missed_deadlines"]
    # The arm can be held under gravity with what remains of its torque.
    motors = Motors(given, config.torque_max, config.physics_dt)
    n = len(config.joints)
    with closing(make_robot(config)) as robot:
        robot.reset(config.start_positions, np.zeros(n))
        robot.brake(1, config.torque_max)
        hold = robot.state().motor_torque
    torque = np.array([motors.step(hold, config.start_positions) for _ in range(100)])
    assert (np.abs(torque - hold) < 0.06 * config.torque_max).all()


def test_there_is_such_a_file_for_each_robot():
    assert sorted(path.stem for path in CONFIG.glob("*.yaml")) == ROBOTS
