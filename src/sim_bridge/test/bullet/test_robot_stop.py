# SPDX-License-Identifier: Apache-2.0
"""The drives' own stop of a Panda: pushed meanwhile, and in turn with commands and brakes."""

from contextlib import closing

import numpy as np
import pytest
from stopped_robot import Stopped


@pytest.fixture(scope="module")
def stopped():
    made = Stopped("panda")
    with closing(made.robot):
        yield made


def test_a_push_during_the_stop_is_braked_at_once(stopped):
    rng, robot, law = np.random.default_rng(1), stopped.robot, stopped.law
    for _ in range(2):
        q, v = stopped.edge(rng)
        robot.reset(q, v)
        robot.monitor.reset()
        robot.stop(law, 20)
        robot.apply_wrench("panda_hand", 15.0 * rng.choice([-1.0, 1.0], 3), np.zeros(3))
        robot.stop(law, 100)
        robot.clear_wrenches()
        robot.stop(law, round(law.time_to_rest(v) / stopped.dt) + 100)
        assert law.at_rest
        assert robot.monitor.max_position_violation.max() < 3e-4
        assert robot.monitor.max_velocity_violation.max() < 0.05


def test_commands_brakes_and_stops_alternate_without_a_jump(stopped):
    robot, law, config = stopped.robot, stopped.law, stopped.config
    q, zero = np.array(config.start_positions), np.zeros(stopped.n)
    robot.reset(q, zero)
    robot.brake(5, config.torque_max)
    robot.stop(law, 50)
    robot.step(robot.state().motor_torque, 2)  # the torque that held it goes on holding it
    np.testing.assert_allclose(robot.state().v, 0.0, atol=1e-6)

    robot.move(q, zero, config.torque_max, config.velocity_max, 20)
    before = robot.state().motor_torque
    robot.stop(law, 1)  # begins anew, at rest
    assert law.at_rest
    jump = np.abs(robot.state().motor_torque - before)
    assert (jump < 0.01 * config.torque_max).all()
