# SPDX-License-Identifier: Apache-2.0
"""The drives' own stop in the states where brakes throw joints beyond their limits."""

from contextlib import closing

import numpy as np
import pytest
from stopped_robot import Stopped

from sim_bridge.node.bullet_parameters import BulletConfiguration, make_stop
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config

FEW_STEPS = 0.012  # s


@pytest.fixture(params=["panda", "talos_left_arm", "baxter_left_arm"])
def stopped(request):
    made = Stopped(request.param)
    with closing(made.robot):
        yield made


@pytest.fixture
def panda():
    made = Stopped("panda")
    with closing(made.robot):
        yield made


def test_the_stop_passes_no_limit_where_the_brakes_do(stopped):
    rng = np.random.default_rng(0)
    thrown = np.zeros(2)
    for _ in range(15):
        q, v = stopped.edge(rng)
        time = stopped.law.time_to_rest(v)
        assert stopped.play(q, v, time + FEW_STEPS) == (0.0, 0.0)
        if stopped.config.torque_max[1] != 50.0:  # Baxter's shoulder may need longer
            assert stopped.law.at_rest
        thrown = np.maximum(thrown, stopped.play(q, v, time, brake=True))
    assert thrown[1] > 0.5  # rad/s


def test_it_holds_the_arm_still_after_the_stop(stopped):
    q = np.array(stopped.config.start_positions)
    stopped.play(q, 0.3 * stopped.config.velocity_max, 1.5)
    assert stopped.law.at_rest
    q, _, tau = stopped.robot.state()
    stopped.robot.stop(stopped.law, 500)
    moved = np.abs(stopped.robot.state().q - q)
    assert moved.max() < 2e-6
    step = np.abs(stopped.robot.state().motor_torque - tau) / stopped.config.torque_max
    assert step.max() < 1e-3


def test_a_push_during_the_stop_is_braked_at_once(panda):
    rng = np.random.default_rng(1)
    for _ in range(6):
        q, v = panda.edge(rng)
        panda.robot.reset(q, v)
        panda.robot.monitor.reset()
        panda.robot.stop(panda.law, 20)
        panda.robot.apply_wrench("panda_hand", 15.0 * rng.choice([-1.0, 1.0], 3), np.zeros(3))
        panda.robot.stop(panda.law, 100)
        panda.robot.clear_wrenches()
        panda.robot.stop(panda.law, round(panda.law.time_to_rest(v) / panda.dt) + 100)
        assert panda.law.at_rest
        assert panda.robot.monitor.max_position_violation.max() < 3e-4
        assert panda.robot.monitor.max_velocity_violation.max() < 0.05


def test_commands_and_stops_alternate_without_a_jump_that_is_not_commanded(panda):
    config = panda.config
    q = np.array(config.start_positions)
    panda.robot.reset(q, np.zeros(panda.n))
    panda.robot.stop(panda.law, 50)
    held = panda.robot.state()
    panda.robot.step(held.motor_torque, 2)  # the torque that held it goes on holding it
    np.testing.assert_allclose(panda.robot.state().v, 0.0, atol=1e-6)
    panda.robot.move(q, np.zeros(panda.n), config.torque_max, config.velocity_max, 20)
    before = panda.robot.state().motor_torque
    panda.robot.stop(panda.law, 1)  # begins anew, at rest
    assert panda.law.at_rest
    jump = np.abs(panda.robot.state().motor_torque - before)
    assert (jump < 0.01 * config.torque_max).all()


def test_a_stop_after_the_brakes_releases_them(panda):
    panda.robot.reset(panda.config.start_positions, np.zeros(panda.n))
    panda.robot.brake(5, panda.config.torque_max)
    panda.robot.stop(panda.law, 5)
    assert not panda.robot._brakes.any()
    assert np.abs(panda.robot.state().v).max() < 1e-6


def test_without_acceleration_limits_there_is_no_stop():
    given = read_config("panda", "bullet_node")
    none = given | {"acceleration_min": [], "acceleration_max": []}
    assert make_stop(read(BulletConfiguration, none)) is None
    with pytest.raises(SettingError, match="acceleration_max.*the other limit"):
        read(BulletConfiguration, given | {"acceleration_max": []})
    with pytest.raises(SettingError, match="acceleration_min.*the other limit"):
        read(BulletConfiguration, given | {"acceleration_min": []})
    slow = {"rate_hz": 1.0, "physics_step_max": 1.0}
    with pytest.raises(SettingError, match="steps of 1 s.*panda_joint"):
        make_stop(read(BulletConfiguration, given | slow))
