# SPDX-License-Identifier: Apache-2.0
"""Contacts with friction: what they can exert, and the torques that the QP finds for it."""

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, nnls

from torque_safety_controller.parts.contact.contacts import FrictionContact, friction_pyramid
from torque_safety_controller.qp import AccelerationRange, InverseDynamicsQP, TaskTerm

SOLE = np.array([[0.05, 0.03, 0.1], [0.05, -0.03, 0.1], [-0.05, -0.03, 0.1], [-0.05, 0.03, 0.1]])
HAND = "panda_hand_tcp"
ELBOW = "panda_link4"
SOLE_CONTACT = (HAND, SOLE, [0.0, 0.0, -1.0], 0.6)
POINT_CONTACT = (ELBOW, [[0.02, 0.1, -0.03]], [0.3, 1.0, 0.0], 0.4)

normals = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda x: np.linalg.norm(x) > 0.1)


def parts(force, normal):
    """Length of a force across a normal, and along it."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    along = normal @ force
    return np.linalg.norm(force - along * normal), along


@given(normals, st.floats(0.0, 3.0), st.integers(0, 1000))
@settings(deadline=None)
def test_forces_in_a_pyramid_do_not_slip_and_its_edges_are_at_the_limit(normal, friction, seed):
    edges = friction_pyramid(np.array(normal) / np.linalg.norm(normal), friction)
    rho = np.random.default_rng(seed).exponential(size=edges.shape[1]) ** 3
    across, along = parts(edges @ rho, normal)
    assert across <= friction * along + 1e-9 * rho.sum()
    assert along == pytest.approx(rho.sum())
    for edge in edges.T:
        across, along = parts(edge, normal)
        assert across == pytest.approx(friction * along, abs=1e-12)


@given(normals, st.floats(0.05, 3.0), st.floats(0.0, 2 * np.pi))
@settings(deadline=None)
def test_a_pyramid_of_four_sides_spans_a_cone_of_seven_tenths_of_the_friction(
    normal, friction, angle
):
    normal = np.array(normal) / np.linalg.norm(normal)
    edges = friction_pyramid(normal, friction)
    across = pin.exp3(angle * normal) @ (edges[:, 0] - normal)
    force = normal + np.cos(np.pi / 4.0) * (1.0 - 1e-9) * across
    assert nnls(edges, force)[1] < 1e-7


class ContactArm:
    """Panda with a contact, a sole on its hand or a point on its elbow, at a state."""

    def __init__(self, contact=SOLE_CONTACT, speed=0.0) -> None:
        rng = np.random.default_rng(3)
        self.model = load_arm("panda").model
        self.data = self.model.createData()
        self.contact = FrictionContact(*contact)
        self.q = np.array([0.3, 0.4, 0.2, -1.6, 0.1, 2.0, 0.5]) + 0.1 * rng.normal(size=7)
        self.v = speed * rng.normal(size=7)
        pin.computeJointJacobians(self.model, self.data, self.q)
        pin.forwardKinematics(self.model, self.data, self.q, self.v, np.zeros(7))

    def forces(self, F_des):
        return self.contact.forces(self.model, self.data, F_des, 10.0)

    def points(self, q):
        """Points of the contact in base axes, and the rotation of its frame."""
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, q)
        pose = data.oMf[self.model.getFrameId(self.contact.frame)]
        return self.contact.points @ pose.rotation.T + pose.translation, pose.rotation

    def press(self, F_des, tau_max=80.0, weight=1e4):
        """Come to rest, pressing; return the wrench, and the torque of each joint."""
        M = pin.crba(self.model, self.data, self.q)
        h = pin.nonLinearEffects(self.model, self.data, self.q, self.v)
        rest, forces = TaskTerm(None, -20.0 * self.v, weight), self.forces(F_des)
        qp, wide, most = InverseDynamicsQP(7, 1e-9), np.full(7, 100.0), np.full(7, tau_max)
        bounds = AccelerationRange(-wide, wide)
        solution = qp.solve([rest], M, h, -most, most, forces, bounds, None)
        np.testing.assert_allclose(solution.a, rest.b, atol=1e-2)
        assert (solution.rho >= 0.0).all()
        tau = M @ solution.a + h - forces.B @ solution.rho
        assert (np.abs(tau) <= tau_max + 1e-6).all()
        # What is asked for is what happens, if the environment pushes back so: by the
        # articulated-body algorithm.
        wrench = self.contact.wrench(solution.rho)
        fext = [pin.Force.Zero() for _ in range(self.model.njoints)]
        frame = self.model.frames[self.model.getFrameId(self.contact.frame)]
        fext[frame.parentJoint] += frame.placement.act(pin.Force(wrench))
        a = pin.aba(self.model, self.model.createData(), self.q, self.v, tau, fext)
        np.testing.assert_allclose(a, solution.a, atol=1e-6)
        return wrench, tau


@pytest.mark.parametrize("contact", [SOLE_CONTACT, POINT_CONTACT])
def test_joint_torques_do_the_work_of_the_forces(contact):
    """Virtual work, with the points' displacements by finite differences."""
    arm, step = ContactArm(contact), 1e-6
    contact, (_, rotation) = arm.contact, arm.points(arm.q)
    edges = rotation @ friction_pyramid(contact.normal, contact.friction)
    moved = [
        (arm.points(arm.q + step * e)[0] - arm.points(arm.q - step * e)[0]) / (2.0 * step)
        for e in np.eye(7)
    ]  # of each joint: shape (p, 3)
    work = np.einsum("jpx,xf->jpf", moved, edges).reshape(7, -1)
    np.testing.assert_allclose(arm.forces(np.zeros(6)).B, work, atol=1e-8)


@pytest.mark.parametrize("speed", [0.0, 0.2])
def test_pressing_takes_the_transposed_jacobian_times_the_force(speed):
    arm = ContactArm(speed=speed)
    F_des = np.array([1.0, -2.0, -10.0, 0.1, 0.2, 0.0])
    F_des[3:] += np.cross([0.0, 0.0, 0.1], F_des[:3])  # about the sole's middle
    wrench, tau = arm.press(F_des)
    np.testing.assert_allclose(wrench, F_des, atol=1e-4)
    hand = arm.model.getFrameId(HAND)
    J = pin.computeFrameJacobian(arm.model, arm.model.createData(), arm.q, hand, pin.LOCAL)
    free = pin.rnea(arm.model, arm.model.createData(), arm.q, arm.v, -20.0 * arm.v)
    np.testing.assert_allclose(tau, free - J.T @ F_des, atol=1e-3)


def test_the_force_ends_where_the_torque_does():
    """Nearly the greatest normal force that torques at rest can give, by a linear programme."""
    arm = ContactArm()
    h = pin.computeGeneralizedGravity(arm.model, arm.model.createData(), arm.q)
    F_des = np.array([0.0, 0.0, -1000.0, 0.0, 0.0, 0.0])
    wrench, tau = arm.press(F_des, 40.0, weight=1e7)
    assert np.isclose(np.abs(tau), 40.0, atol=1e-5).any()
    B = arm.forces(F_des).B
    most = linprog(arm.contact.W[2], np.vstack([B, -B]), np.r_[40.0 + h, 40.0 - h])
    assert 1.01 * most.fun <= wrench[2] <= 0.9 * most.fun


def test_friction_limits_what_a_point_exerts_and_a_pull_is_not_to_be_had():
    """The force of the pyramid that is nearest to one far outside the cone, by another way."""
    arm = ContactArm(POINT_CONTACT)
    F_des = np.r_[np.cross([0.3, 1.0, 0.0], [0.0, 0.0, 20.0]) + [3.0, 10.0, 0.0], 0.0, 0.0, 0.0]
    wrench, _ = arm.press(F_des)
    edges = arm.contact.W[:3]
    nearest = edges @ nnls(edges, F_des[:3])[0]
    np.testing.assert_allclose(wrench[:3], nearest, atol=1e-3)
    across, along = parts(nearest, arm.contact.normal)
    assert 0.2 < across / along <= 0.4 + 1e-9
    wrench, _ = arm.press(np.r_[-10.0 * arm.contact.normal, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(wrench, 0.0, atol=1e-6)
