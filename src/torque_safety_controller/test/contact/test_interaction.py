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
from torque_safety_controller.parts.contact import interaction
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
from torque_safety_controller.tasks.admittance import KV, AdmittanceTask, admittance
from viability_bounds_pkg.state import State

GAINS = replace(PLAIN, posture_weight=1e-6)  # so little that the hand does what its tasks want
WIDE = np.full(7, 1e3)  # rad/s^2; bounds that no one feels
DT = 1e-3
Z = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
ARM = load_arm("panda")
Q, REST = ARM.q_start, np.zeros(7)
PAPER_KP = 5e-3
NORMAL = np.array([0.0, 0.0, -1.0])
"""A table below a hand that points down pushes against the hand's z axis."""


class SimulatedHand:
    """A controller of Panda, and what its sensor feels."""

    def __init__(self, contact=False, tau_max=ARM.tau_max, gains=GAINS, **settings) -> None:
        sensor = WrenchSensor(
            pin.SE3.Identity(),
            pin.Inertia.Zero(),
            np.zeros(3),
            filter_hz=1e9,
            timeout=0.005,
        )
        touching = FrictionContact(ARM.frame, np.zeros((1, 3)), NORMAL, 0.5) if contact else None
        robot = ARM.robot(DT)
        goals = Goals(robot.n, gains)
        self.interaction = Interaction(
            goals, sensor, touching, settings=InteractionSettings(**settings)
        )
        parts = [self.interaction, goals, JointBounds()]
        self.controller = Controller(robot, parts, tau_max, hold_kd=gains.hold_kd)
        self.controller.warm_up()
        self.controller.reset(Q)
        self.pose = ARM.robot(0.0)
        self.pose.update(State(Q, REST), REST)
        self.controller.goals.set_pose(self.pose.pose.copy())

    def step(self, wrench=None, q=Q, v=REST, bounds=WIDE):
        if wrench is not None:
            self.interaction.sensor.receive(wrench)
        return self.controller.step(State(q, v), AccelerationRange(-bounds, bounds))

    @property
    def state(self) -> Compliance:
        return self.interaction.state

    def hand_acceleration(self, step, v=REST) -> np.ndarray:
        return self.controller.robot.J @ step.a + self.controller.robot.drift


def force(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    return np.array([x, y, z, 0.0, 0.0, 0.0])


# (27)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_task_asks_for_what_equation_27_says(seed):
    rng = np.random.default_rng(seed)
    robot = ARM.robot(0.0)
    q, v = ARM.random_state(rng)
    robot.update(State(q, v), REST)
    F_ref, F, F_ref_rate, F_rate = rng.normal(size=(4, 6)) * 10.0
    kp, any_speed = rng.uniform(0.0, 1.0, size=2), (np.inf, np.inf)
    Kp = np.diag(np.repeat(kp, 3))
    expected = -Kp @ (F_ref - F) - KV * (F_ref_rate - F_rate)
    g = admittance(F_ref - F, F_ref_rate - F_rate, kp, any_speed, 50.0)
    task = AdmittanceTask(g, 2.0, np.arange(6)).term(robot)
    a = np.linalg.lstsq(task.A, task.b, rcond=None)[0]
    np.testing.assert_allclose(robot.J @ a + robot.drift, expected, atol=1e-6)
    some = np.array([1, 2, 5])
    part = AdmittanceTask(g, 2.0, some).term(robot)
    np.testing.assert_array_equal(part.A, task.A[some])
    np.testing.assert_array_equal(part.b, task.b[some])


@pytest.mark.parametrize("push", [0.1, 3.0, 100.0])
def test_the_hand_does_not_rush(push):
    """It settles at the speed of (27) against the damping, or at the limit."""
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    wrench = push * np.concatenate([direction, direction])
    g = admittance(-wrench, np.zeros(6), (0.1, 0.2), (0.02, 0.1), 50.0)
    np.testing.assert_allclose(g[:3] / 50.0, min(0.1 * push / 50.0, 0.02) * direction)
    np.testing.assert_allclose(g[3:] / 50.0, min(0.2 * push / 50.0, 0.1) * direction)


def test_a_hand_that_feels_too_little_moves_on_and_too_much_back(monkeypatch):
    """The paper's weights: the mean of what the two tasks want, in the direction of force only."""
    monkeypatch.setattr(interaction, "PRESS_SPEED_MAX", (10.0, 10.0))
    hand = SimulatedHand(force_directions=Z)
    hand.interaction.set_target(-force(z=-10.0))  # press along z: the table pushes with -10
    for _ in range(3000):
        free = hand.step(force())
    assert hand.state is Compliance.FORCE
    wanted = 0.5 * PAPER_KP * 10.0
    assert hand.hand_acceleration(free)[2] == pytest.approx(wanted, rel=1e-3)
    np.testing.assert_allclose(np.delete(hand.hand_acceleration(free), 2), 0.0, atol=1e-4)
    hand.step(force(z=-30.0))  # in which the derivative acts, too
    too_much = hand.step(force(z=-30.0))
    assert hand.hand_acceleration(too_much)[2] == pytest.approx(-2.0 * wanted, rel=1e-3)
    hand.step(force(z=-10.0))
    enough = hand.step(force(z=-10.0))
    np.testing.assert_allclose(hand.hand_acceleration(enough), 0.0, atol=1e-4)


def test_no_stiffness_is_left_where_force_is_controlled():
    hand = SimulatedHand(force_directions=Z)
    goal = hand.pose.pose * pin.SE3(np.eye(3), np.array([0.01, 0.0, 0.02]))
    hand.controller.goals.set_pose(goal)
    hand.interaction.set_target(np.zeros(6))
    a = hand.hand_acceleration(hand.step(force()))
    assert a[0] == pytest.approx(GAINS.pose_kp * 0.01, rel=1e-2)
    assert a[2] == pytest.approx(0.0, abs=1e-4)


def test_a_target_in_the_base_frame_turns_with_the_hand():
    hand = SimulatedHand(force_directions=np.ones(6))
    R = hand.pose.pose.rotation
    pressed = np.array([1.0, 2.0, -3.0, 0.1, 0.2, 0.3])
    hand.interaction.set_target(pressed, np.eye(3))
    for _ in range(3000):
        hand.step(np.zeros(6))
    expected = -np.concatenate([R.T @ pressed[:3], R.T @ pressed[3:]])
    np.testing.assert_allclose(hand.interaction.reference, expected, atol=1e-6)


# Contact


def test_the_motors_give_what_the_contact_takes():
    """Against inverse dynamics with the force as Pinocchio's external one; and only in contact."""
    hand = SimulatedHand(contact=True, force_directions=Z, tau_max=np.full(7, 1e3))
    free = hand.step(force())
    hand.interaction.set_target(-force(z=-10.0))
    exact = ARM.robot(DT)
    exact.update(State(Q, REST), REST)
    np.testing.assert_allclose(free.tau, exact.torque(free.a), atol=1e-9)
    for _ in range(2000):
        pressing = hand.step(force(z=-10.0))
    assert pressing.forces is not None
    # The wrench task has a hundred thousandth of the others' weight, and gamma acts on it, too.
    np.testing.assert_allclose(hand.interaction.reference, force(z=-10.0), atol=2.5)
    model, data = ARM.model, ARM.model.createData()
    frame = model.frames[model.getFrameId(ARM.frame)]
    fext = [pin.Force.Zero() for _ in range(model.njoints)]
    fext[frame.parentJoint] = frame.placement.act(pin.Force(hand.interaction.reference))
    # With rest before and after, the middle of the step is Q to first order.
    expected = pin.rnea(model, data, Q, REST, pressing.a, fext)
    np.testing.assert_allclose(pressing.tau, expected, atol=1e-2)


def test_torque_limits_hold_with_the_contact_counted_in(monkeypatch):
    monkeypatch.setattr(interaction, "WRENCH_WEIGHT", 1e6)
    monkeypatch.setattr(interaction, "WRENCH_TIME", 1e-3)
    hand = SimulatedHand(contact=True, force_directions=Z)
    hand.interaction.set_target(-force(z=-2000.0))
    steps = [hand.step(force(z=-2000.0), bounds=np.full(7, 0.5)) for _ in range(50)]
    assert all((np.abs(step.tau) <= ARM.tau_max).all() for step in steps)
    # They bind: what is counted on is less than was asked for, and that is what (27) goes by.
    assert -1500.0 < hand.interaction.reference[2] < -50.0
    assert (np.abs(steps[-1].tau) > 0.999 * ARM.tau_max).any()


def test_what_is_counted_on_exceeds_what_is_felt_by_a_step_at_most(monkeypatch):
    monkeypatch.setattr(interaction, "FORCE_STEP", 2.0)
    monkeypatch.setattr(interaction, "WRENCH_TIME", 1e-6)
    hand = SimulatedHand(contact=True, force_directions=Z)
    hand.interaction.set_target(-force(x=5.0, z=-10.0))
    for measured, counted in ((0.0, 2.0), (3.0, 5.0), (-7.0, 2.0), (9.0, 10.0), (40.0, 10.0)):
        (task,) = hand.step(force(z=-measured)).forces.tasks
        # Smaller, and in the same direction.
        np.testing.assert_allclose(task.F_des, [0.5 * counted, 0.0, -counted], rtol=1e-9)


@pytest.mark.parametrize(
    "goal",
    [
        force(x=1e12, z=-1.0),
        force(y=-1e12),
        force(x=5.0, z=10.0),
        np.array([0.0, 0.0, -1.0, 1e12, 0.0, 0.0]),
    ],
    ids=["across", "across only", "a pull", "a moment"],
)
def test_what_a_contact_cannot_give_is_not_counted_on(goal, monkeypatch):
    monkeypatch.setattr(interaction, "WRENCH_TIME", 1e-6)
    hand = SimulatedHand(contact=True, force_directions=Z)
    hand.interaction.set_target(-goal)
    contact = hand.interaction.contact
    (task,) = hand.step(force()).forces.tasks
    pressing = contact.normal @ task.F_des[:3]
    assert 0.0 <= pressing <= interaction.FORCE_STEP + 1e-9
    across = task.F_des[:3] - pressing * contact.normal
    assert np.linalg.norm(across) <= contact.friction * pressing + 1e-9
    assert np.linalg.norm(task.F_des[3:]) < 1.0


# Dual compliance


def test_yielding_has_hysteresis():
    hand = SimulatedHand(yield_threshold=np.array([10.0, 1.0]))
    before = False
    for value in np.random.default_rng(0).uniform(-20.0, 20.0, 200):
        hand.step(force(y=value))
        after = hand.state is Compliance.YIELDING
        if abs(value) > 10.0:
            assert after
        elif abs(value) <= 10.0 * interaction.YIELD_RELEASE:
            assert not after
        else:
            assert after == before
        before = after


def test_a_moment_is_yielded_to_as_well():
    hand = SimulatedHand(yield_threshold=np.array([10.0, 2.0]))
    hand.step(np.array([0, 0, 0, 0, 2.1, 0.0]))
    assert hand.state is Compliance.YIELDING
    hand.step(np.array([0, 0, 0, 0, 0.9, 0.0]))
    assert hand.state is Compliance.HOLDING


def test_the_hand_is_held_below_the_threshold_and_led_above():
    settings = {"yield_threshold": np.array([10.0, 2.0])}
    hand = SimulatedHand(**settings)
    held = hand.step(force(x=9.0))
    assert hand.state is Compliance.HOLDING
    np.testing.assert_allclose(hand.hand_acceleration(held), 0.0, atol=1e-4)
    led = hand.step(force(x=12.0))
    assert hand.state is Compliance.YIELDING
    gain = interaction.YIELD_KP[0]
    assert hand.hand_acceleration(led)[0] == pytest.approx(0.5 * gain * 12.0, rel=1e-2)


def test_where_the_hand_is_let_go_is_its_new_goal():
    hand = SimulatedHand(yield_threshold=np.array([10.0, 2.0]))
    hand.step(force(x=20.0))
    elsewhere = Q + 0.05
    hand.step(force(x=20.0), elsewhere)
    taken = hand.controller.goals.held
    there = hand.controller.robot.pose.copy()
    hand.step(force(x=1.0), elsewhere + 1e-3)
    assert hand.state is Compliance.HOLDING
    assert hand.controller.goals.pose_des.isApprox(there)
    assert hand.controller.goals.held == taken
    hand.step(force(x=1.0), Q)
    assert hand.controller.goals.pose_des.isApprox(there)


# What goes wrong


@pytest.mark.parametrize("pressing", [False, True])
def test_a_sensor_that_falls_silent_ends_it_where_the_hand_is(pressing):
    hand = SimulatedHand(contact=True, force_directions=Z, yield_threshold=np.array([10.0, 2.0]))
    if pressing:
        hand.interaction.set_target(-force(z=-10.0))
    hand.step(force(z=-20.0))
    assert hand.state is (Compliance.FORCE if pressing else Compliance.YIELDING)
    elsewhere = Q + 0.05
    for _ in range(10):
        step = hand.step(None, elsewhere)
    assert hand.state is Compliance.SILENT
    assert hand.controller.goals.pose_des.isApprox(hand.controller.robot.pose)
    assert step.forces is None
    np.testing.assert_allclose(hand.hand_acceleration(step), 0.0, atol=1e-4)
    assert not hand.interaction.report()["target_wrench"].any()
    # Back again, nothing is pressed unasked.
    step = hand.step(force(z=-5.0), elsewhere)
    assert hand.state is Compliance.HOLDING
    np.testing.assert_allclose(hand.hand_acceleration(step), 0.0, atol=1e-4)


def test_directions_taken_back_end_the_pressing_where_the_hand_is():
    hand = SimulatedHand(force_directions=Z)
    hand.interaction.set_target(force(z=10.0))
    hand.step(force())
    elsewhere = Q + 0.05
    hand.interaction.settings = replace(hand.interaction.settings, force_directions=np.zeros(6))
    hand.step(force(), elsewhere)
    assert hand.state is Compliance.OFF
    assert hand.controller.goals.pose_des.isApprox(hand.controller.robot.pose)


def test_directions_exchanged_while_pressing_hold_the_hand_where_it_is():
    """Else what was pressed along would spring back to a goal that the hand has left."""
    hand = SimulatedHand(force_directions=Z)
    hand.interaction.set_target(force(z=10.0))
    hand.step(force())
    elsewhere = Q + 0.05
    hand.step(force(), elsewhere)
    assert hand.controller.goals.pose_des.isApprox(hand.pose.pose)
    hand.interaction.settings = replace(hand.interaction.settings, force_directions=np.roll(Z, -1))
    hand.step(force(), elsewhere)
    assert hand.state is Compliance.FORCE
    assert hand.controller.goals.pose_des.isApprox(hand.controller.robot.pose)
    taken = hand.controller.goals.held
    hand.step(force(), elsewhere)
    assert hand.controller.goals.held == taken


def test_settings_that_change_do_not_let_go_of_a_hand_that_is_led():
    hand = SimulatedHand(yield_threshold=np.array([10.0, 2.0]))
    hand.step(force(x=20.0))
    hand.interaction.settings = replace(
        hand.interaction.settings, yield_threshold=np.array([11.0, 2.0])
    )
    hand.step(force(x=8.0))
    assert hand.state is Compliance.YIELDING


def test_starting_anew_presses_nothing():
    hand = SimulatedHand(force_directions=Z)
    hand.interaction.set_target(force(z=10.0))
    hand.step(force())
    hand.controller.reset(Q)
    hand.step(force())
    assert hand.state is Compliance.OFF
