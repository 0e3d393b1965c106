# SPDX-License-Identifier: Apache-2.0
"""Commands fail at random moments of fast motions, and the robot stops within its limits."""

from contextlib import closing

import numpy as np
import pytest
from direct import DirectLoop
from sensor_msgs.msg import JointState
from stopped_robot import Stopped

from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.bullet_parameters import make_robot, make_stop
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.ramp import Ramp
from torque_safety_controller.supervisor import REST, Order
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import joint_state, read_config

HASTE = {"posture_kp": 100.0, "posture_kd": -1.0, "posture_weight": 10.0, "pose_weight": 0.0}
MOMENTS = 12
BENT = {
    # With the elbow this much bent left_s1 can hold and brake the arm in each posture.
    "baxter_left_arm": {
        "position_min": [-1.7016, -2.147, -3.0541, 2.0, -3.059, -1.5707, -3.059],
        "velocity_max": [1.0, 0.8, 1.0, 1.0, 2.0, 2.0, 2.0],
        "acceleration_min": [-5.0, -3.1, -5.0, -5.0, -5.0, -5.0, -5.0],
        "acceleration_max": [5.0] * 7,
    }
}


def goals(values, rng):
    """Postures at the joints' limits."""
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    while True:
        yield np.where(rng.random(len(low)) < 0.5, low, high)


def chain(ros, robot, effort_tolerance=0.03, **of_robot):
    """Start the nodes in lockstep; return that of the robot."""
    arm = ros.start(
        BulletNode, read_config(robot, "bullet_node") | of_robot | {"clock": "lockstep"}
    )
    ros.start(BoundsNode, read_config(robot, "bounds_node"))
    of_controller = HASTE | {"effort_tolerance": effort_tolerance}
    ros.start(ControllerNode, read_config(robot, "controller_node") | of_controller)
    return arm


def send_to_limits(ros, arm, count, periods, seed):
    """Send the arm to some postures at its limits, one after the other."""
    config = arm._config
    limits = {"position_min": config.position_min, "position_max": config.position_max}
    postures = goals(limits, np.random.default_rng(seed))
    user = ros.talk(JointState, "target_posture", GOAL_QOS)
    for _ in range(count):
        user.publish(joint_state(config.joints, 0, next(postures)))
        end = arm._periods + periods
        ros.wait_until(lambda end=end: arm._periods >= end, "control periods", timeout=60.0)


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_no_limit_is_passed_when_commands_fail_at_a_random_moment(robot):
    rng = np.random.default_rng(0)
    loop = DirectLoop(robot, HASTE)
    config = loop.config
    postures = goals(read_config(robot), rng)
    law = make_stop(config)
    limits = config.position_min, config.position_max, config.velocity_max, config.torque_max
    fastest, thrown = 0.0, 0.0
    with closing(loop.robot), closing(make_robot(config)) as other:
        monitor = other.monitor = LimitMonitor(*limits)
        for _ in range(MOMENTS):
            loop.controller.goals.set_posture(next(postures))
            (*_, last) = loop.run(rng.uniform(0.1, 0.3))
            q, v, _ = loop.robot.state()
            fastest = max(fastest, float((np.abs(v) / config.velocity_max).max()))
            for brake in (False, True):
                other.reset(q, v)
                monitor.reset()
                other.step(last.tau, config.substeps)  # held for a period that was missed
                time = law.time_to_rest(other.state().v) + 0.05
                if brake:
                    other.brake(round(time / other.physics_dt), config.torque_max)
                    thrown = max(thrown, monitor.max_velocity_violation.max())
                else:
                    other.stop(law, round(time / other.physics_dt))
                    assert law.at_rest
                    assert not monitor.violated
    assert fastest > 0.9, "the arm was hardly driven"
    assert thrown > 0.05, "the brakes would have done"


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm", "baxter_left_arm"])
def test_motors_with_lag_errors_and_noise_pass_no_limit_and_hold_it_still(robot):
    """Those of config/imperfect; the steps of the true torque at rest are its noise."""
    rng = np.random.default_rng(0)
    stopped = Stopped(robot, f"imperfect/{robot}", **BENT.get(robot, {}))
    tau_max = stopped.config.torque_max
    with closing(stopped.robot) as arm:
        for _ in range(6):
            q, v = stopped.edge(rng)
            assert stopped.play(q, v, stopped.law.time_to_rest(v) + 0.5) == (0.0, 0.0)
            assert stopped.law.at_rest
            true, believed = [], []
            for _ in range(100):
                arm.stop(stopped.law, 1)
                true.append(arm.state().motor_torque)
                believed.append(arm.believed_torque)
            assert not arm.monitor.violated
            assert (np.abs(np.diff(true, axis=0)) / tau_max).max() < 0.05
            assert (np.abs(np.diff(believed, axis=0)) / tau_max).max() < 0.02


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_the_chain_of_nodes_goes_on_when_commands_return(ros, robot):
    values = read_config(robot, "bullet_node")
    arm = chain(ros, robot)
    rng = np.random.default_rng(1)
    postures = goals(values, rng)
    user = ros.talk(JointState, "target_posture", GOAL_QOS)

    def reach_for(posture, periods):
        user.publish(joint_state(values["joints"], 0, posture))
        end = arm._periods + periods
        ros.wait_until(lambda: arm._periods >= end, "control periods", timeout=60.0)

    for _ in range(2):
        reach_for(next(postures), round(rng.uniform(0.4, 0.6) * values["rate_hz"]))
        assert np.abs(arm._robot.state().v).max() > 0.5
        speed = arm._stop.time_to_rest(arm._robot.state().v)
        for _ in range(round((speed + 0.02) * values["rate_hz"])):  # the controller is not heard
            arm._commands.acting = None
            arm._advance()
            arm._next_state()
        assert arm._stop.at_rest
        ros.wait_until(lambda: arm._commands.acting is not None, "commands")
    reach_for(np.array(values["start_positions"]), round(0.3 * values["rate_hz"]))
    assert not arm._monitor.violated


def test_commands_held_in_rows_of_missed_periods_pass_no_limit(ros):
    """Rows longer than the bounds are declared to cover."""
    arm = chain(ros, "panda", missed_probability=0.6, missed_in_row=5, command_timeout=5)
    send_to_limits(ros, arm, 4, 350, seed=4)
    assert arm._commands.path.missed > 300
    assert (arm._monitor.max_speed > 0.9 * arm._config.velocity_max).any()
    assert not arm._monitor.violated


@pytest.mark.parametrize(
    "robot", ["panda", pytest.param("talos_left_arm", marks=pytest.mark.long)]
)
def test_commands_that_return_after_outages_make_no_jolt(ros, robot):
    """Outages of up to 100 periods begin with 1 % of the commands; goals are at the limits."""
    outages = {"outage_probability": 0.01, "outage_longest": 100, "imperfection_seed": 3}
    # The controller does not help.
    arm = chain(ros, robot, effort_tolerance=0.0, **outages)
    tau_max, stop = arm._config.torque_max, arm._stop
    sent, given, last = [], [], np.zeros(len(tau_max))
    follow, update = stop.follow, arm._monitor.update
    first = False

    def watched_follow(q, v, command, motor_torque):
        nonlocal first
        first = stop._resting
        if first:
            sent.append(np.abs((command - last) / tau_max).max())
        return follow(q, v, command, motor_torque)

    def watched_update(q, v, tau):
        nonlocal first
        if first:
            given.append(np.abs((tau - last) / tau_max).max())
        first = False
        last[:] = tau
        update(q, v, tau)

    stop.follow, arm._monitor.update = watched_follow, watched_update
    send_to_limits(ros, arm, 6, 300, seed=2)
    assert len(given) > 5
    assert max(sent) > 0.3, "there was no jolt to avoid"
    assert max(given) < 0.1
    assert not arm._monitor.violated


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm", "baxter_left_arm"])
def test_no_limit_is_passed_in_hold_without_acceleration_limits(robot):
    rng = np.random.default_rng(5)
    loop = DirectLoop(robot, HASTE)
    postures = goals(read_config(robot), rng)
    fastest = 0.0
    with closing(loop.robot) as arm:
        for _ in range(8):
            loop.controller.goals.set_posture(next(postures))
            loop.run(rng.uniform(0.2, 0.6))
            fastest = max(fastest, float((np.abs(arm.state().v) / loop.config.velocity_max).max()))
            for _ in range(round(0.6 / loop.dt)):
                q, v, _ = arm.state()
                arm.step(loop.controller.step(State(q, v), None, REST).tau, loop.config.substeps)
            assert not arm.monitor.violated
    assert fastest > 0.5, "the arm was hardly driven"


def test_after_hold_an_arm_goes_on_without_a_jolt_wherever_it_stopped():
    """Also within the margins of a limit, where friction lets go of a joint now and then."""
    loop = DirectLoop("talos_left_arm", HASTE)
    rng, ramp = np.random.default_rng(1), Ramp(loop.dt)
    postures, controller = goals(read_config("talos_left_arm"), rng), loop.controller
    steps = []
    with closing(loop.robot) as arm:
        for _ in range(12):
            controller.goals.set_posture(next(postures))
            loop.run(rng.uniform(0.3, 1.2))
            for _ in range(round(0.4 / loop.dt)):
                q, v, _ = arm.state()
                arm.step(controller.step(State(q, v), None, REST).tau, loop.config.substeps)
            ramp.fall(at_once=True)
            last = arm.believed_torque
            for _ in range(round(0.1 / loop.dt)):
                ramp.advance(loop.dt, at_rest=True)
                loop.step(Order(ramp.share))
                tau = arm.believed_torque
                steps.append(np.abs((tau - last) / loop.config.torque_max).max())
                last = tau
        assert not arm.monitor.violated
    assert max(steps) < 0.02


def test_the_arm_is_slowed_after_a_row_of_states_that_is_too_long_and_goes_on(ros, capfd):
    values = read_config("panda", "bullet_node")
    arm = ros.start(BulletNode, values | {"clock": "lockstep"})
    ros.start(BoundsNode, read_config("panda", "bounds_node"))
    controller = ros.start(ControllerNode, read_config("panda", "controller_node") | HASTE)
    goal = np.array(values["start_positions"]) + 0.5
    user = ros.talk(JointState, "target_posture", GOAL_QOS)
    ros.wait_until(lambda: arm._commands.acting is not None, "commands")
    user.publish(joint_state(values["joints"], 0, goal))

    def play(seconds):
        end = arm._periods + round(seconds * values["rate_hz"])
        ros.wait_until(lambda: arm._periods >= end, "control periods", timeout=60.0)

    def share():
        return controller._supervisor.values()["goal_share"]

    play(0.1)
    assert share() == 1.0
    for _ in range(4):  # states that the controller does not see
        arm._advance()
        arm._next_state()
    ros.wait_until(lambda: share() < 1.0, "a row that is too long")
    play(0.4)
    assert "the bounds cover 1: the arm is slowed" in capfd.readouterr().err
    assert 0.0 < share() < 1.0
    assert "slowed to" in controller._report()[1]
    play(3.0)
    assert share() == 1.0
    assert "the arm goes on" in capfd.readouterr().err
    assert np.abs(arm.true_positions - goal).max() < 0.02
    assert not arm._monitor.violated


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_no_torque_steps_where_commands_are_lost_while_states_come(ros, robot):
    """In motion to limits, for 0.6 s; the robot stops itself meanwhile."""
    arm = chain(ros, robot, command_timeout=2)
    values, path, taus = read_config(robot, "bullet_node"), arm._commands.path, []
    send, begin = path.send, arm._next_state
    rate, tau_max = values["rate_hz"], np.array(values["torque_max"])
    lost = False

    def watched_begin():
        taus.append(arm._robot.believed_torque)
        begin()

    def play(seconds):
        end = arm._periods + round(seconds * rate)
        ros.wait_until(lambda: arm._periods >= end, "control periods", timeout=60.0)

    path.send = lambda command, age=0: lost or send(command, age)
    arm._next_state = watched_begin
    user = ros.talk(JointState, "target_posture", GOAL_QOS)
    rng = np.random.default_rng(1)
    for posture, _ in zip(goals(values, rng), range(4), strict=False):
        user.publish(joint_state(values["joints"], 0, posture))
        play(rng.uniform(0.2, 0.4))
        lost = True
        play(0.6)
        assert arm._stop.at_rest
        lost, first = False, len(taus)
        play(0.12)
        steps = np.abs(np.diff(taus[first - 2 : first + round(0.1 * rate)], axis=0))
        # TALOS has stiction, and what breaks loose jumps.
        assert (steps / tau_max).max() < (0.02 if robot == "panda" else 0.03)
        play(0.4)
        assert np.abs(arm._robot.state().v).max() > 0.3, "it does not go on"
        play(0.6)
    assert not arm._monitor.violated
