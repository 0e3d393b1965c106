# SPDX-License-Identifier: Apache-2.0
"""The estimator node: joint states in, joint states as commands will meet them out."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import InertiaStamped
from sensor_msgs.msg import JointState
from true_arm import model

from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.robot.payload import Payload
from viability_bounds_pkg.ros.runtime import GOAL_QOS, stamp_to_ns
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import design_observer
from viability_bounds_pkg.testing.ros_harness import joint_state, read_config

NODE = "estimator_node"
VALUES = read_config("panda") | {"state_timeout": 0.2}
JOINTS = VALUES["joints"]
N = len(JOINTS)
PERIOD = 2_000_000  # ns
DT = 1e-9 * PERIOD
HOME = np.array(VALUES["start_positions"])
STILL = np.zeros(N)
TAU = np.array([5.0, -20.0, 3.0, 30.0, 1.0, 2.0, 0.5])
COARSE = {"position_error": [1e-4] * N, "acceleration_disturbance": [5.0] * N}


class EstimatorProbe:
    """The other side: sends states and commands, keeps answers."""

    def __init__(self, ros, **changed) -> None:
        self.ros = ros
        self.node = ros.start(EstimatorNode, VALUES | changed)
        self.answers = ros.listen(JointState, "estimated_joint_states")
        self.states = ros.talk(JointState, "joint_states")
        self.commands = ros.talk(JointState, "joint_commands")
        ros.hears("estimated_joint_states")

    def ask(self, message) -> JointState:
        """Send a state until it is answered, return the answer."""
        stamp = stamp_to_ns(message.header.stamp)
        self.answers.clear()
        self.ros.wait_until(
            lambda: stamp in self.answers.stamps,
            "an answer",
            each=lambda: self.states.publish(message),
            period=0.1,
        )
        return self.answers[self.answers.stamps.index(stamp)]

    def state(self, k, q=HOME, v=STILL, tau=()):
        """Ask with joints in the usual order, return the estimate."""
        answer = self.ask(joint_state(JOINTS, k * PERIOD, q, v, tau))
        assert answer.name == JOINTS
        return State(np.array(answer.position), np.array(answer.velocity))

    def command(self, k, tau=(), joints=JOINTS) -> None:
        """Send a command that the node reads."""
        before = self.node.commands_heard
        message = joint_state(joints, k * PERIOD, (), (), tau)
        self.ros.wait_until(
            lambda: self.node.commands_heard > before,
            "the command",
            each=lambda: self.commands.publish(message),
            period=1.0,  # so long that none comes late, and is taken for the next one
        )

    def reported(self, key):
        return self.ros.reported(NODE, key)


def reference(delay=0, lag=0.0, coarse=True, arm=None):
    """Return the estimator that a node should have."""
    design = design_observer(DT, np.full(N, 1e-4 * coarse), np.full(N, 5.0 * coarse))
    return StateEstimator(
        arm or model(),
        DT,
        delay,
        np.full(N, lag),
        design,
        np.array(VALUES["velocity_max"]),
        np.array(VALUES["torque_max"]),
        np.zeros(N),
    )


def test_answers_are_those_of_the_estimator_with_stamp_and_effort_of_the_state(ros):
    arm = EstimatorProbe(ros, delay=2, motor_bandwidth=[100.0] * N, **COARSE)
    ours = reference(2, 1.0 / (2.0 * math.pi * 100.0))
    rng = np.random.default_rng(1)
    tau = np.array([0.0, -10.0, 0.0, 20.0, 0.0, 2.0, 0.0])
    for k in range(1, 13):
        q, v = HOME + rng.uniform(-1e-4, 1e-4, N), rng.uniform(-0.1, 0.1, N)
        got = arm.state(k, q, v, tau)
        np.testing.assert_allclose(got, ours.step(k * PERIOD, State(q, v), tau), atol=1e-12)
        np.testing.assert_array_equal(arm.answers[-1].effort, tau)
        command = tau + rng.uniform(-2.0, 2.0, N)
        arm.command(k, command)
        ours.answer(k * PERIOD, command)
    assert not ours.resets
    # A repeated state gets the same answer and is no step.
    np.testing.assert_array_equal(arm.state(12, q, v, tau), got)
    ros.wait_until(lambda: arm.reported("states_answered") == "12")


def test_a_load_counts_in_the_prediction(ros):
    arm = EstimatorProbe(ros, delay=2, **COARSE)
    message = InertiaStamped()
    message.header.frame_id, message.inertia.m = "panda_hand", 2.0
    ros.talk(InertiaStamped, "payload", GOAL_QOS).publish(message)
    ros.wait_until(lambda: arm.reported("payload") == "2.00 kg at panda_hand", "the load")
    loaded = model().copy()
    Payload(loaded).carry("panda_hand", 2.0, np.zeros(3), np.zeros((3, 3)))
    ours = reference(2, arm=loaded)
    for k in range(1, 6):
        np.testing.assert_allclose(
            arm.state(k, tau=TAU), ours.step(k * PERIOD, State(HOME, STILL), TAU), atol=1e-12
        )
        arm.command(k, TAU)
        ours.answer(k * PERIOD, TAU)


def test_states_without_velocities_are_answered_with_those_estimated(ros):
    arm = EstimatorProbe(ros, **COARSE)
    speed = 0.2
    for k in range(1, 41):  # no torque is known: the observers follow the positions
        answer = arm.ask(joint_state(JOINTS, k * PERIOD, HOME + speed * k * DT, ()))
    np.testing.assert_allclose(answer.velocity, np.full(N, speed), atol=0.1)
    assert arm.node.commands_heard == 0


def test_joints_in_any_order_and_others_with_them(ros):
    arm = EstimatorProbe(ros, delay=1, velocity_estimation=False)
    order = [3, 0, 6, 1, 2, 5, 4]
    names = [*(JOINTS[i] for i in order[:4]), "finger", *(JOINTS[i] for i in order[4:])]
    v = np.linspace(0.1, 0.7, N)

    def placed(values, finger):
        shuffled = np.array(values)[order]
        return [*shuffled[:4], finger, *shuffled[4:]]

    message = joint_state(
        names, PERIOD, placed(HOME, 0.04), placed(v, -0.5), placed(STILL + 3.0, 9.0)
    )
    message.header.frame_id = "base"
    answer = arm.ask(message)
    assert answer.name == names
    assert answer.header == message.header
    assert answer.effort == message.effort
    state = reference(1, coarse=False).step(PERIOD, State(HOME, v), STILL + 3.0)
    np.testing.assert_allclose(answer.position, placed(state.q, 0.04), atol=1e-12)
    np.testing.assert_allclose(answer.velocity, placed(state.v, -0.5), atol=1e-12)


def test_commands_beyond_the_torque_limits_count_as_these(ros):
    estimates = []
    for tau in (TAU, VALUES["torque_max"], np.full(N, 1e6)):
        arm = EstimatorProbe(ros, delay=1, velocity_estimation=False)
        for k in (1, 2):
            arm.state(k)
            arm.command(k, tau)
        estimates.append(np.array(arm.state(3)))
        ros.stop(arm.node)
    usual, most, more = estimates
    np.testing.assert_array_equal(more, most)
    assert np.abs(most - usual).max() > 1e-3


def test_a_jump_and_a_gap_start_anew_and_are_told(ros):
    arm = EstimatorProbe(ros, **COARSE)
    for k in (1, 2, 3):
        arm.state(k)
    elsewhere = HOME + 0.004  # less than what cannot be
    np.testing.assert_allclose(arm.state(4, elsewhere, STILL + 0.2), [elsewhere, STILL + 0.2])
    arm.state(5, elsewhere, STILL + 0.2)
    np.testing.assert_allclose(arm.state(20, elsewhere, STILL), [elsewhere, STILL])
    ros.wait_until(lambda: "stamps jumped: 1" in arm.reported("resets"))
    assert "the state jumped: 1" in arm.reported("resets")
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN
    assert arm.reported("message") == "started anew since the start"


def test_messages_that_are_wrong_are_dropped_and_counted(ros):
    arm = EstimatorProbe(ros, delay=1, state_timeout=30.0)
    arm.state(1)
    arm.answers.clear()
    broken = joint_state(JOINTS, 2 * PERIOD, [math.nan, *HOME[1:]], STILL)
    ros.wait_until(
        lambda: "not finite: " in arm.reported("states_refused"),
        each=lambda: arm.states.publish(broken),
    )
    assert not arm.answers
    arm.command(1, [math.nan] * N)
    arm.command(1, [1.0] * (N - 1))
    arm.command(1, [1.0] * (N - 1), joints=JOINTS[1:])
    for reason in ("not finite", "wrong size", "missing joint"):
        ros.wait_until(lambda why=reason: f"{why}: " in arm.reported("commands_refused"))
    for k in (2, 3, 4):  # an effort that is not finite is none
        assert np.isfinite(arm.state(k, tau=[math.nan] * N)).all()


def test_diagnostics_tell_the_errors(ros):
    arm = EstimatorProbe(ros, delay=1, **COARSE)
    ros.wait_until(lambda: arm.reported("message") == "no joint state yet")
    design = design_observer(DT, np.full(N, 1e-4), np.full(N, 5.0))
    arm.state(1)
    ros.wait_until(lambda: arm.reported("message") == "answering")
    for key, value in (
        ("velocity_error_rad_s", design.velocity_error),
        ("position_error_rad", design.position_error),
        ("innovation_declared_rad", design.innovation),
    ):
        np.testing.assert_allclose([float(x) for x in arm.reported(key).split()], value, rtol=1e-6)
    arm.state(2, HOME + 5e-4)
    larger = f"errors of {JOINTS[0]} larger than declared"
    ros.wait_until(lambda: arm.reported("message") == larger)
    assert ros.diagnostics[NODE]["level"] == DiagnosticStatus.WARN
    assert float(arm.reported("innovation_max_rad").split()[0]) >= 4e-4


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"delay": 1.5}, "delay"),
        ({"position_error": [-1e-4] * N}, "position_error"),
        ({"velocity_max": None, "robot_description": "topic"}, "velocity_max"),
        ({"joints": [*JOINTS[:-1], "elbow"]}, "joints"),
    ],
)
def test_it_does_not_start_with_bad_parameters(shared_ros, changed, name):
    shared_ros.refuses_to_start(EstimatorNode, VALUES | changed, name)
