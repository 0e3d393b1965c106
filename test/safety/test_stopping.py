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
PANDA = read_config("panda", "bullet_node")


def goals(robot, rng):
    """Postures at the joints' limits."""
    values = read_config(robot)
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    while True:
        yield np.where(rng.random(len(low)) < 0.5, low, high)


def share_of_speed(loop):
    return (np.abs(loop.robot.state().v) / loop.config.velocity_max).max()


# Without messages


@pytest.mark.parametrize("robot", ["panda", "talos_left_arm"])
def test_no_limit_is_passed_when_commands_fail_at_a_random_moment(robot):
    rng = np.random.default_rng(0)
    loop = DirectLoop(robot, HASTE)
    config, postures, law = loop.config, goals(robot, rng), make_stop(loop.config)
    limits = config.position_min, config.position_max, config.velocity_max, config.torque_max
    fastest, thrown = 0.0, 0.0
    with closing(loop.robot), closing(make_robot(config)) as other:
        monitor = other.monitor = LimitMonitor(*limits)
        for _ in range(12):
            loop.controller.goals.set_posture(next(postures))
            (*_, last) = loop.run(rng.uniform(0.1, 0.3))
            q, v, _ = loop.robot.state()
            fastest = max(fastest, share_of_speed(loop))
            for brake in (False, True):
                other.reset(q, v)
                monitor.reset()
                other.step(last.tau, config.substeps)  # held for a period that was missed
                steps = round((law.time_to_rest(other.state().v) + 0.05) / other.physics_dt)
                if brake:
                    other.brake(steps, config.torque_max)
                    thrown = max(thrown, monitor.max_velocity_violation.max())
                else:
                    other.stop(law, steps)
                    assert law.at_rest
                    assert not monitor.violated
    assert fastest > 0.9, "the arm was hardly driven"
    assert thrown > 0.05, "the brakes would have done"


def test_motors_with_lag_errors_and_noise_pass_no_limit_and_hold_it_still():
    """Those of config/imperfect; the steps of the true torque at rest are its noise."""
    rng = np.random.default_rng(0)
    stopped = Stopped("talos_left_arm", "imperfect/talos_left_arm")
    with closing(stopped.robot) as arm:
        for _ in range(4):
            q, v = stopped.edge(rng)
            assert stopped.play(q, v, stopped.law.time_to_rest(v) + 0.5) == (0.0, 0.0)
            assert stopped.law.at_rest
            true = []
            for _ in range(100):
                arm.stop(stopped.law, 1)
                true.append(arm.state().motor_torque)
            assert not arm.monitor.violated
            steps = np.abs(np.diff(true, axis=0)) / stopped.config.torque_max
            assert steps.max() < 0.05


@pytest.mark.parametrize("robot", ["panda", "baxter_left_arm"])
def test_no_limit_is_passed_in_hold_without_acceleration_limits(robot):
    rng = np.random.default_rng(5)
    loop, postures = DirectLoop(robot, HASTE), goals(robot, rng)
    fastest = 0.0
    with closing(loop.robot) as arm:
        for _ in range(6):
            loop.controller.goals.set_posture(next(postures))
            loop.run(rng.uniform(0.2, 0.6))
            fastest = max(fastest, share_of_speed(loop))
            for _ in range(round(0.6 / loop.dt)):
                q, v, _ = arm.state()
                arm.step(loop.controller.step(State(q, v), None, REST).tau, loop.config.substeps)
            assert not arm.monitor.violated
    assert fastest > 0.5, "the arm was hardly driven"


def test_after_hold_an_arm_goes_on_without_a_jolt_wherever_it_stopped():
    """Also within the margins of a limit, where friction lets go of a joint now and then."""
    rng = np.random.default_rng(1)
    loop, postures = DirectLoop("talos_left_arm", HASTE), goals("talos_left_arm", rng)
    ramp, controller, steps = Ramp(loop.dt), loop.controller, []
    with closing(loop.robot) as arm:
        for _ in range(5):
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


# Through the nodes, in lockstep


class Driven:
    """A Panda that has been sent to postures at its limits, and what was heard meanwhile.

    Attributes:
        v, tau: speeds and torques of the motors that the states report, shape (N, 7).
        command: torques that answered these states.
    """

    def __init__(self, ros, seed, effort_tolerance=0.03, **of_robot):
        states = ros.listen(JointState, "joint_states")
        commands = ros.listen(JointState, "joint_commands")
        ros.start(BulletNode, PANDA | of_robot | {"clock": "lockstep"})
        ros.start(BoundsNode, read_config("panda", "bounds_node"))
        changed = HASTE | {"effort_tolerance": effort_tolerance}
        ros.start(ControllerNode, read_config("panda", "controller_node") | changed)
        user = ros.talk(JointState, "target_posture", GOAL_QOS)
        ros.wait_until(lambda: commands, "commands")
        for posture, _ in zip(goals("panda", np.random.default_rng(seed)), range(5), strict=False):
            user.publish(joint_state(PANDA["joints"], 0, posture))
            end = len(states) + 300
            ros.wait_until(lambda end=end: len(states) >= end, "control periods", timeout=300.0)
        answers = dict(zip(commands.stamps, commands, strict=True))
        pairs = [(state, answers.get(at)) for state, at in zip(states, states.stamps, strict=True)]
        answered = [(state, command) for state, command in pairs if command is not None]
        self.v = np.array([state.velocity[:7] for state, _ in answered])
        self.tau = np.array([state.effort[:7] for state, _ in answered])
        self.command = np.array([command.effort for _, command in answered])


def test_commands_held_in_rows_of_missed_periods_pass_no_limit(ros):
    """Rows longer than the bounds are declared to cover."""
    rows = {"missed_probability": 0.6, "missed_in_row": 5, "command_timeout": 5}
    driven = Driven(ros, seed=4, **rows)
    ros.assert_limits_kept()
    assert int(ros.reported("bullet_node", "missed_deadlines_injected")) > 300
    assert (np.abs(driven.v) > 0.9 * np.array(PANDA["velocity_max"])).any()


def test_commands_that_return_after_outages_make_no_jolt(ros):
    """Outages of up to 100 periods begin with 1% of the commands; the robot stops meanwhile."""
    outages = {"outage_probability": 0.01, "outage_longest": 100, "imperfection_seed": 3}
    # The controller does not help.
    driven = Driven(ros, seed=2, effort_tolerance=0.0, **outages)
    ros.assert_limits_kept()
    tau_max = np.array(PANDA["torque_max"])
    ignored = (np.abs(driven.command[:-1] - driven.tau[1:]) / tau_max).max(axis=1)
    steps = (np.abs(np.diff(driven.tau, axis=0)) / tau_max).max(axis=1)
    still = np.abs(driven.v).max(axis=1) < 0.01  # rad/s
    # It stood, whatever it was told, and then moves.
    returns = [
        k
        for k in range(4, len(steps))
        if still[k - 3 : k + 1].all() and ignored[k - 1] > 0.05 and not still[k + 1]
    ]
    assert len(returns) > 3
    assert ignored[np.array(returns) - 1].max() > 0.2, "there was no jolt to avoid"
    assert steps[returns].max() < 0.02
