# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, nnls
from task_arm import TaskArm

from torque_safety_controller.parts.contact.contacts import (
    FACETS,
    FrictionContact,
    friction_pyramid,
)
from torque_safety_controller.qp import (
    AccelerationRange,
    InverseDynamicsQP,
    LinearConstraints,
    TaskTerm,
    stack_constraints,
)

SOLE = np.array([[0.05, 0.03, 0.1], [0.05, -0.03, 0.1], [-0.05, -0.03, 0.1], [-0.05, 0.03, 0.1]])
HAND = "panda_hand_tcp"
ELBOW = "panda_link4"

directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda x: np.linalg.norm(x) > 0.1)
frictions = st.floats(0.0, 3.0)


def parts(force, normal):
    """Length of a force across a normal, and along it."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    along = normal @ force
    return np.linalg.norm(force - along * normal), along


def unit(normal):
    return np.array(normal) / np.linalg.norm(normal)


@given(directions, frictions, st.integers(0, 1000))
@settings(max_examples=200, deadline=None)
def test_forces_in_an_inscribed_pyramid_do_not_slip(normal, friction, seed):
    edges = friction_pyramid(unit(normal), friction)
    rho = np.random.default_rng(seed).exponential(size=FACETS) ** 3
    across, along = parts(edges @ rho, normal)
    assert across <= friction * along + 1e-9 * rho.sum()
    assert along == pytest.approx(rho.sum())
    for edge in edges.T:  # the edges are at the limit: nothing is given up there
        across, along = parts(edge, normal)
        assert across == pytest.approx(friction * along, abs=1e-12)


@given(directions, st.floats(0.05, 3.0), st.floats(0.0, 2 * np.pi))
@settings(max_examples=100, deadline=None)
def test_what_a_pyramid_spans(normal, friction, angle):
    """All of a cone cos(pi / facets) as wide."""
    normal = unit(normal)
    edges = friction_pyramid(normal, friction)
    across = pin.exp3(angle * normal) @ (edges[:, 0] - normal)
    force = normal + np.cos(np.pi / FACETS) * (1.0 - 1e-9) * across
    assert nnls(edges, force)[1] < 1e-7


def test_a_patch_exerts_moments_with_the_centre_of_pressure_inside():
    contact = FrictionContact(HAND, SOLE, np.array([0.0, 0.0, -2.0]), 0.5)
    assert contact.W.shape == (6, 16)
    rng = np.random.default_rng(2)
    for _ in range(50):
        rho = rng.exponential(size=16) ** 3
        force, moment = contact.W[:3] @ rho, contact.W[3:] @ rho
        expected = sum(
            np.cross(point, friction_pyramid(np.array([0, 0, -1.0]), 0.5) @ rho[4 * i : 4 * i + 4])
            for i, point in enumerate(SOLE)
        )
        np.testing.assert_allclose(moment, expected, atol=1e-12)
        moment = moment - np.cross([0.0, 0.0, 0.1], force)  # about the middle of the sole
        centre = np.array([-moment[1], moment[0]]) / force[2]
        assert (np.abs(centre) <= [0.05 + 1e-12, 0.03 + 1e-12]).all()
    assert np.linalg.matrix_rank(contact.W) == 6
    assert np.linalg.matrix_rank(FrictionContact(HAND, SOLE[:1], [0, 0, 1.0], 0.5).W) == 3


SOLE_CONTACT = (HAND, SOLE, [0.0, 0.0, -1.0], 0.6)
POINT_CONTACT = (ELBOW, [[0.02, 0.1, -0.03]], [0.3, 1.0, 0.0], 0.4)


class ContactArm:
    """Panda with a contact, a sole on its hand or a point on its elbow, at a state."""

    def __init__(self, contact=SOLE_CONTACT, seed=3, speed=1.0):
        rng = np.random.default_rng(seed)
        self.model = TaskArm("panda").model
        self.data = self.model.createData()
        self.contact = FrictionContact(*contact)
        self.q = TaskArm("panda").posture + 0.1 * rng.normal(size=7)
        self.v = speed * rng.normal(size=7)
        pin.computeJointJacobians(self.model, self.data, self.q)
        pin.forwardKinematics(self.model, self.data, self.q, self.v, np.zeros(7))

    def forces(self, F_des, weight=10.0):
        return self.contact.forces(self.model, self.data, F_des, weight)

    def points(self, q):
        """Points of the contact in base axes, and the rotation of its frame."""
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, q)
        pose = data.oMf[self.model.getFrameId(self.contact.frame)]
        return self.contact.points @ pose.rotation.T + pose.translation, pose.rotation

    def dynamics(self):
        M = pin.crba(self.model, self.data, self.q)
        return M, pin.nonLinearEffects(self.model, self.data, self.q, self.v)

    def accelerations(self, tau, rho):
        """By the articulated-body algorithm, with the forces on their links."""
        forces = [pin.Force.Zero() for _ in range(self.model.njoints)]
        frame = self.model.frames[self.model.getFrameId(self.contact.frame)]
        forces[frame.parentJoint] += frame.placement.act(pin.Force(self.contact.wrench(rho)))
        return pin.aba(self.model, self.model.createData(), self.q, self.v, tau, forces)


@pytest.mark.parametrize("contact", [SOLE_CONTACT, POINT_CONTACT])
def test_joint_torques_do_the_work_of_the_forces(contact):
    """Virtual work, with the points' displacements by finite differences."""
    arm = ContactArm(contact)
    B, step = arm.forces(np.zeros(6)).B, 1e-6
    contact, (_, rotation) = arm.contact, arm.points(arm.q)
    edges = rotation @ friction_pyramid(contact.normal, contact.friction)
    moved = [
        (arm.points(arm.q + step * e)[0] - arm.points(arm.q - step * e)[0]) / (2.0 * step)
        for e in np.eye(7)
    ]  # of each joint: shape (p, 3)
    work = np.einsum("jpx,xf->jpf", moved, edges).reshape(7, -1)
    assert B.shape == (7, 4 * len(contact.points))
    np.testing.assert_allclose(B, work, atol=1e-8)


def press(arm, F_des, tau_max, posture_weight=1e4):
    """Hold still and let a contact exert a wrench; return the solution and the torque."""
    M, h = arm.dynamics()
    wide = np.full(7, 100.0)
    forces = arm.forces(F_des)
    qp = InverseDynamicsQP(7, 1e-9)
    program = qp.build(
        [TaskTerm(None, -20.0 * arm.v, posture_weight)],
        AccelerationRange(-wide, wide),
        M,
        -tau_max - h,
        tau_max - h,
        contacts=forces,
    )
    solution = qp.solve(program)
    assert (solution.rho >= 0.0).all()
    tau = M @ solution.a + h - forces.B @ solution.rho
    assert (np.abs(tau) <= tau_max + 1e-6).all()
    # What is asked for is what happens, if the environment pushes back so.
    np.testing.assert_allclose(arm.accelerations(tau, solution.rho), solution.a, atol=1e-6)
    return solution, tau


def test_pressing_at_rest_takes_gravity_and_the_transposed_jacobian_times_the_force():
    arm = ContactArm(speed=0.0)
    F_des = np.array([1.0, -2.0, -10.0, 0.1, 0.2, 0.0])
    F_des[3:] += np.cross([0.0, 0.0, 0.1], F_des[:3])  # about the sole's middle
    solution, tau = press(arm, F_des, np.full(7, 80.0))
    np.testing.assert_allclose(arm.contact.wrench(solution.rho), F_des, atol=1e-4)
    np.testing.assert_allclose(solution.a, 0.0, atol=1e-6)
    J = pin.computeFrameJacobian(
        arm.model, arm.model.createData(), arm.q, arm.model.getFrameId(HAND), pin.LOCAL
    )
    h = pin.computeGeneralizedGravity(arm.model, arm.model.createData(), arm.q)
    np.testing.assert_allclose(tau, h - J.T @ F_des, atol=1e-4)


def test_pressing_in_motion_serves_both_tasks():
    arm = ContactArm(speed=0.2)
    F_des = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
    solution, _ = press(arm, F_des, np.full(7, 80.0))
    np.testing.assert_allclose(arm.contact.wrench(solution.rho), F_des, atol=1e-4)
    np.testing.assert_allclose(solution.a, -20.0 * arm.v, atol=1e-6)


def test_the_force_ends_where_the_torque_does():
    """Nearly the greatest normal force that torques at rest can give, by a linear programme."""
    arm = ContactArm(speed=0.0)
    h, tau_max = arm.dynamics()[1], np.full(7, 40.0)
    F_des = np.array([0.0, 0.0, -1000.0, 0.0, 0.0, 0.0])
    solution, tau = press(arm, F_des, tau_max, posture_weight=1e7)
    np.testing.assert_allclose(solution.a, 0.0, atol=1e-2)
    assert np.isclose(np.abs(tau), tau_max, atol=1e-5).any()
    B, W = arm.forces(F_des).B, arm.contact.W
    r = W.shape[1]
    most = linprog(
        W[2] @ np.eye(r),
        np.vstack([B[:, :r], -B[:, :r]]),
        np.r_[tau_max + h, tau_max - h],
        method="highs",
    )
    force = arm.contact.wrench(solution.rho)[2]
    assert 1.01 * most.fun <= force <= 0.9 * most.fun


def test_a_pull_is_not_to_be_had():
    arm = ContactArm(speed=0.0)
    solution, _ = press(arm, np.array([0.0, 0.0, 10.0, 0.0, 0.0, 0.0]), np.full(7, 80.0))
    np.testing.assert_allclose(arm.contact.wrench(solution.rho), 0.0, atol=1e-6)


def test_friction_limits_what_a_point_exerts():
    """The force of the pyramid that is nearest to one far outside the cone, by another way."""
    arm = ContactArm(POINT_CONTACT, speed=0.0)
    F_des = np.r_[np.cross([0.3, 1.0, 0.0], [0.0, 0.0, 20.0]) + [3.0, 10.0, 0.0], 0.0, 0.0, 0.0]
    solution, _ = press(arm, F_des, np.full(7, 80.0))
    contact = arm.contact
    nearest = contact.W[:3] @ nnls(contact.W[:3], F_des[:3])[0]
    np.testing.assert_allclose(arm.contact.wrench(solution.rho)[:3], nearest, atol=1e-3)
    across, along = parts(nearest, contact.normal)
    assert 0.2 < across / along <= 0.4 + 1e-9


def test_rows_are_stacked_in_order():
    one = LinearConstraints(np.ones((1, 2)), np.zeros(1), np.ones(1))
    two = LinearConstraints(2.0 * np.ones((2, 2)), np.full(2, 2.0), np.full(2, 3.0))
    none = LinearConstraints(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    assert stack_constraints([]) is None
    assert stack_constraints([none, none]) is None
    assert stack_constraints([none, two]) is two
    stacked = stack_constraints([one, none, two])
    np.testing.assert_array_equal(stacked.G, [[1, 1], [2, 2], [2, 2]])
    np.testing.assert_array_equal(stacked.lower, [0, 2, 2])
    np.testing.assert_array_equal(stacked.upper, [1, 3, 3])


def test_the_force_on_a_springy_table_becomes_the_one_that_is_asked_for():
    """The hand holds its place along the table and presses; what pushes back is a spring."""
    arm, dt, steps = ContactArm(speed=0.0), 1e-3, 1500
    model, frame = arm.model, arm.model.getFrameId(HAND)
    up = np.array([0.0, 0.0, 1.0])
    normal = arm.points(arm.q)[1].T @ up
    contact = FrictionContact(HAND, np.zeros((1, 3)), normal, 0.5)
    F_des = np.r_[10.0 * normal, 0.0, 0.0, 0.0]
    across = np.eye(6)
    across[:3, :3] -= np.outer(normal, normal)
    data, q, v = arm.data, arm.q.copy(), np.zeros(7)
    pin.updateFramePlacement(model, data, frame)
    goal, wide, tau_max = data.oMf[frame].copy(), np.full(7, 50.0), np.full(7, 80.0)
    qp, forces = InverseDynamicsQP(7), []
    for _ in range(steps):
        M, h = pin.crba(model, data, q), pin.nonLinearEffects(model, data, q, v)
        pin.computeJointJacobians(model, data, q)
        pin.forwardKinematics(model, data, q, v, np.zeros(7))
        pose = pin.updateFramePlacement(model, data, frame)
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
        drift = pin.getFrameAcceleration(model, data, frame, pin.LOCAL).vector
        error = across @ pin.log6(pose.actInv(goal)).vector
        hand = TaskTerm(J, 900.0 * error - 50.0 * J @ v - drift, 1e4)
        pressed = contact.forces(model, data, F_des, 10.0)
        program = qp.build(
            [hand, TaskTerm(None, -5.0 * v, 10.0)],
            AccelerationRange(-wide, wide),
            M,
            -tau_max - h,
            tau_max - h,
            contacts=pressed,
        )
        solution = qp.solve(program)
        tau = M @ solution.a + h - pressed.B @ solution.rho
        speed = up @ (pose.rotation @ (J @ v)[:3])
        pushed = max(0.0, 2000.0 * (goal.translation[2] - pose.translation[2]) - 20.0 * speed)
        v = v + dt * np.linalg.solve(M, tau - h + J[:3].T @ pose.rotation.T @ (pushed * up))
        q = q + dt * v
        forces.append(pushed)
    np.testing.assert_allclose(forces[-200:], 10.0, atol=0.1)
    assert np.abs(v).max() < 1e-2
    assert np.linalg.norm(error[:3]) < 1e-3
