# SPDX-License-Identifier: Apache-2.0
"""Compiled bias forces and diagonals of the inertia matrix, against Pinocchio's."""

import numpy as np
import pinocchio as pin
import pytest
from estimated_models import baxter, panda

from viability_bounds_pkg.estimate.torque_terms import Bodies, torque_terms


def tree():
    """Joints that turn, slide or do both as a screw, in branches, with rotors and slanted axes."""
    model, axis = pin.Model(), np.array([0.6, 0.0, 0.8])
    joints = [
        pin.JointModelRZ(),
        pin.JointModelPX(),
        pin.JointModelRevoluteUnaligned(axis),
        pin.JointModelPrismaticUnaligned(axis),
        pin.JointModelHY(0.3),
        pin.JointModelRX(),
    ]
    for k, (parent, joint) in enumerate(zip((0, 1, 2, 1, 4, 5), joints, strict=True)):
        index = model.addJoint(parent, joint, pin.SE3.Random(), f"joint{k}")
        model.appendBodyToJoint(index, pin.Inertia.Random(), pin.SE3.Random())
    model.armature = np.linspace(0.1, 0.6, model.nv)
    return model


@pytest.mark.parametrize("make", [tree, panda, baxter])
def test_terms_are_those_of_pinocchio(make):
    pin.seed(0)
    model, rng = make(), np.random.default_rng(0)
    data = model.createData()
    q, v = rng.uniform(-3.0, 3.0, (2, 50, model.nv))
    h, inertia = torque_terms(Bodies.of(model), q, v)
    for i, (q_i, v_i) in enumerate(zip(q, v, strict=True)):
        right = pin.nonLinearEffects(model, data, q_i, v_i)
        np.testing.assert_allclose(h[i], right, rtol=1e-11, atol=1e-11)
        diagonal = pin.crba(model, data, q_i).diagonal()
        np.testing.assert_allclose(inertia[i], diagonal, rtol=1e-11)
