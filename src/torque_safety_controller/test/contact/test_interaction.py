# SPDX-License-Identifier: Apache-2.0
"""Forces at the hand, through the controller that is told of them."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from controllers import GAINS as PLAIN
from hypothesis import given, settings
from hypothesis import strategies as st

from torque_safety_controller.controller import Controller
from torque_safety_controller.parts.contact.contacts import FrictionContact
from torque_safety_controller.parts.contact.interaction import (
    Compliance,
    Interaction,
    InteractionSettings,
)
from torque_safety_controller.parts.contact.wrench_sensor import WrenchSensor
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.parts.joint_bounds import JointBounds
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.admittance import AdmittanceTask, admittance
from viability_bounds_pkg.state import State

GAINS = replace(PLAIN, posture_weight=1e-6)  # so little that the hand does what its tasks want
DT = 1e-3
Z = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
ARM = load_arm("panda")
Q, REST = ARM.q_start, np.zeros(7)
ELSEWHERE = Q + 0.05
STRONG = np.full(7, 1e3)  # N m
KP, KV = 5e-3, 1e-7  # of Table I, defaults
DUAL = {"yield_threshold": np.array([10.0, 2.0])}
NORMAL = np.array([0.0, 0.0, -1.0])
"""A table below a hand that points down pushes against the hand's z axis."""


class SimulatedHand:
    """A controller of Panda, and what its sensor feels."""

    def __init__(self, contact=False, tau_max=ARM.tau_max, **settings) -> None:
        zero = pin.Inertia.Zero()
        sensor = WrenchSensor(pin.SE3.Identity(), zero, np.zeros(3), filter_hz=1e9, timeout=0.005)
        self.contact = FrictionContact(ARM.frame, np.zeros((1, 3)), NORMAL, 0.5)
        self.goals = Goals(7, GAINS)
        self.interaction = Interaction(
            self.goals,
            sensor,
            self.contact if contact else None,
            settings=InteractionSettings(**settings),
        )
        parts = [self.interaction, self.goals, JointBounds()]
        self.controller = Controller(ARM.robot(DT), parts, tau_max, hold_kd=GAINS.hold_kd)
        self.controller.reset(Q)
        robot = ARM.robot(0.0)
        robot.update(State(Q, REST), REST)
        self.start = robot.pose.copy()
        self.goals.set_pose(self.start)

    def step(self, wrench=None, q=Q, count=1, bound=1e3):
        for _ in range(count):
            if wrench is not None:
                self.interaction.sensor.receive(wrench)
            bounds = AccelerationRange(np.full(7, -bound), np.full(7, bound))
            step = self.controller.step(State(q, REST), bounds)
        return step

    def accelerates(self, step) -> np.ndarray:
        return self.controller.robot.J @ step.a + self.controller.robot.drift

    @property
    def state(self) -> Compliance:
        return self.interaction.state

    @property
    def holds_where_it_is(self) -> bool:
        return self.goals.pose_des.isApprox(self.controller.robot.pose)


def force(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    return np.array([x, y, z, 0.0, 0.0, 0.0])


# (27)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_the_task_asks_for_what_equation_27_says(seed):
    rng = np.random.default_rng(seed)
    robot = ARM.robot(0.0)
    robot.update(State(*ARM.random_state(rng)), REST)
    F_ref, F, F_ref_rate, F_rate = rng.normal(size=(4, 6)) * 10.0
    kp = rng.uniform(0.0, 1.0, size=2)
    expected = -np.repeat(kp, 3) * (F_ref - F) - KV * (F_ref_rate - F_rate)
    g = admittance(F_ref - F, F_ref_rate - F_rate, kp, (np.inf, np.inf), 50.0)
    task = AdmittanceTask(g, 2.0, np.arange(6)).term(robot)
    a = np.linalg.lstsq(task.A, task.b, rcond=None)[0]
    np.testing.assert_allclose(robot.J @ a + robot.drift, expected, atol=1e-6)


@pytest.mark.parametrize("push", [0.1, 100.0])
def test_the_hand_does_not_rush(push):
    """It settles at the speed of (27) against the damping, or at the limit."""
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    g = admittance(-push * np.tile(direction, 2), np.zeros(6), (0.1, 0.2), (0.02, 0.1), 50.0)
    np.testing.assert_allclose(g[:3] / 50.0, min(0.1 * push / 50.0, 0.02) * direction)
    np.testing.assert_allclose(g[3:] / 50.0, min(0.2 * push / 50.0, 0.1) * direction)


def test_a_hand_that_feels_too_little_moves_on_and_too_much_back():
    """The paper's weights: the mean of what the two tasks want, in the direction of force only."""
    hand = SimulatedHand(force_directions=Z)
    hand.interaction.set_target(-force(z=-3.0))  # press along z: the table pushes with -3
    free = hand.step(force(), count=1500)
    assert hand.state is Compliance.FORCE
    wanted = 0.5 * KP * 3.0
    assert hand.accelerates(free)[2] == pytest.approx(wanted, rel=1e-3)
    np.testing.assert_allclose(np.delete(hand.accelerates(free), 2), 0.0, atol=1e-4)
    too_much = hand.step(force(z=-9.0), count=2)
    assert hand.accelerates(too_much)[2] == pytest.approx(-2.0 * wanted, rel=1e-3)
    enough = hand.step(force(z=-3.0), count=2)
    np.testing.assert_allclose(hand.accelerates(enough), 0.0, atol=1e-4)


def test_no_stiffness_is_left_where_force_is_controlled():
    hand = SimulatedHand(force_directions=Z)
    hand.goals.set_pose(hand.start * pin.SE3(np.eye(3), np.array([0.01, 0.0, 0.02])))
    hand.interaction.set_target(np.zeros(6))
    a = hand.accelerates(hand.step(force()))
    assert a[0] == pytest.approx(GAINS.pose_kp * 0.01, rel=1e-2)
    assert a[2] == pytest.approx(0.0, abs=1e-4)


def test_a_target_in_the_base_frame_turns_with_the_hand_and_is_forgotten_by_a_reset():
    hand = SimulatedHand(force_directions=np.ones(6))
    pressed = np.array([1.0, 2.0, -3.0, 0.1, 0.2, 0.3])
    hand.interaction.set_target(pressed, np.eye(3))
    hand.step(np.zeros(6), count=1000)
    expected = -(pressed.reshape(2, 3) @ hand.start.rotation).ravel()
    np.testing.assert_allclose(hand.interaction.reference, expected, atol=1e-3)
    hand.controller.reset(Q)
    hand.step(np.zeros(6))
    assert hand.state is Compliance.OFF


# Contact


def test_the_motors_give_what_the_contact_takes():
    """Against inverse dynamics with the force as Pinocchio's external one; and only in contact."""
    hand = SimulatedHand(contact=True, force_directions=Z, tau_max=STRONG)
    assert hand.step(force()).forces is None
    hand.interaction.set_target(-force(z=-10.0))
    pressing = hand.step(force(z=-10.0), count=1000)
    # The wrench task has a hundred thousandth of the others' weight, and gamma acts on it, too.
    np.testing.assert_allclose(hand.interaction.reference, force(z=-10.0), atol=2.5)
    frame = ARM.model.frames[ARM.model.getFrameId(ARM.frame)]
    fext = [pin.Force.Zero() for _ in range(ARM.model.njoints)]
    fext[frame.parentJoint] = frame.placement.act(pin.Force(hand.interaction.reference))
    # With rest before and after, the middle of the step is Q to first order.
    expected = pin.rnea(ARM.model, ARM.model.createData(), Q, REST, pressing.a, fext)
    np.testing.assert_allclose(pressing.tau, expected, atol=1e-2)


def test_torque_limits_hold_with_the_contact_counted_in():
    hand = SimulatedHand(contact=True, force_directions=Z)
    hand.interaction.set_target(-force(z=-2000.0))
    at_limit = False
    for _ in range(500):
        tau = np.abs(hand.step(force(z=-2000.0), bound=0.5).tau)
        assert (tau <= ARM.tau_max).all()
        at_limit |= (tau > 0.999 * ARM.tau_max).any()
    assert at_limit
    # What is counted on is less than was asked for, and that is what (27) goes by.
    assert -1500.0 < hand.interaction.reference[2] < -50.0


@pytest.mark.parametrize(
    "goal",
    [
        force(x=5.0, z=-10.0),
        force(x=1e12, z=-1.0),
        force(y=-1e12),
        force(x=5.0, z=10.0),
        np.array([0.0, 0.0, -1.0, 1e12, 0.0, 0.0]),
    ],
    ids=["possible", "across", "across only", "a pull", "a moment"],
)
@pytest.mark.parametrize("felt", [-7.0, 0.0, 3.0, 40.0])
def test_a_contact_is_counted_on_for_what_it_can_give_and_for_half_a_newton_more_than_is_felt(
    goal, felt
):
    hand = SimulatedHand(contact=True, force_directions=Z)
    hand.interaction.set_target(-goal)
    (task,) = hand.step(force(z=-felt), count=200).forces.tasks
    pressing = NORMAL @ task.F_des[:3]
    assert 0.0 <= pressing <= max(felt, 0.0) + 0.5 + 1e-9
    across = task.F_des[:3] - pressing * NORMAL
    assert np.linalg.norm(across) <= hand.contact.friction * pressing + 1e-9
    if goal[2] == -10.0 and felt == 3.0:
        np.testing.assert_allclose(task.F_des, [1.75, 0.0, -3.5], rtol=0.1)


# Dual compliance


def test_the_hand_is_led_above_the_threshold_and_held_below_half_of_it():
    hand, before = SimulatedHand(**DUAL), False
    for value in np.random.default_rng(0).uniform(-20.0, 20.0, 200):
        hand.step(force(y=value))
        after = hand.state is Compliance.YIELDING
        assert after == (abs(value) > (5.0 if before else 10.0))
        before = after
    led = hand.accelerates(hand.step(force(x=12.0)))
    assert led[0] > 0.1  # m/s^2
    held = hand.accelerates(hand.step(force(x=4.0)))
    np.testing.assert_allclose(held, 0.0, atol=1e-4)
    hand.step(np.array([0, 0, 0, 0, 2.1, 0.0]))
    assert hand.state is Compliance.YIELDING, "to a moment"


def test_where_the_hand_is_let_go_is_its_new_goal():
    hand = SimulatedHand(**DUAL)
    hand.step(force(x=20.0))
    hand.step(force(x=20.0), ELSEWHERE)
    there = hand.controller.robot.pose.copy()
    for q in (ELSEWHERE + 1e-3, Q):
        hand.step(force(x=1.0), q)
        assert hand.state is Compliance.HOLDING
        assert hand.goals.pose_des.isApprox(there)


# What goes wrong


@pytest.mark.parametrize("pressing", [False, True])
def test_a_sensor_that_falls_silent_ends_it_where_the_hand_is(pressing):
    hand = SimulatedHand(contact=True, force_directions=Z, **DUAL)
    if pressing:
        hand.interaction.set_target(-force(z=-10.0))
    hand.step(force(z=-20.0))
    assert hand.state is (Compliance.FORCE if pressing else Compliance.YIELDING)
    step = hand.step(None, ELSEWHERE, count=10)
    assert hand.state is Compliance.SILENT
    assert hand.holds_where_it_is
    assert step.forces is None
    np.testing.assert_allclose(hand.accelerates(step), 0.0, atol=1e-4)
    # Back again, nothing is pressed unasked.
    step = hand.step(force(z=-5.0), ELSEWHERE)
    assert hand.state is Compliance.HOLDING
    np.testing.assert_allclose(hand.accelerates(step), 0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("directions", "state"),
    [(np.zeros(6), Compliance.OFF), (np.roll(Z, -1), Compliance.FORCE)],
    ids=["taken back", "exchanged"],
)
def test_directions_that_change_while_pressing_hold_the_hand_where_it_is(directions, state):
    """Else what was pressed along would spring back to a goal that the hand has left."""
    hand = SimulatedHand(force_directions=Z)
    hand.interaction.set_target(force(z=10.0))
    hand.step(force())
    hand.step(force(), ELSEWHERE)
    assert hand.goals.pose_des.isApprox(hand.start)
    hand.interaction.settings = replace(hand.interaction.settings, force_directions=directions)
    hand.step(force(), ELSEWHERE)
    assert hand.state is state
    assert hand.holds_where_it_is
