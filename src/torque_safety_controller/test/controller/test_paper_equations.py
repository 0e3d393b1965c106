# SPDX-License-Identifier: Apache-2.0
"""(1) to (14) of the second paper, written down once more, beside the torque of the controller.

Nothing of the controller is used for what is expected. Where links are comes from Pinocchio;
masses, Coriolis torques and gravity follow from that by differences: the kinetic energy's
matrix, its Christoffel symbols, the potential energy's gradient.
"""

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from controllers import make
from general_solver import nearest

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parts.integral import IntegralAction
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.tasks.gains import Gains
from viability_bounds_pkg.state import State

ARM, N, STEP = load_arm("panda"), 7, 2e-3
TINY, SMALL = 1e-4, 1e-3  # rad; rad or s, of differences of differences
LAMBDA, SLOW, FAST, MU = 8.0, 0.4, 60.0, 0.3
KP, KD = 120.0, 9.0
POSE_WEIGHT, POSTURE_WEIGHT, REGULARISATION = 3.0, 0.2, 1e-6
POSTURE_SPEED = 0.2 * np.cos(np.arange(N))  # rad/s
LIMIT = np.array([0.05, 0.04, 0.05, 0.03, 1e-3, 1e-3, 5e-4])  # N m


def places(q):
    """Of the joints, and of the hand."""
    data = ARM.model.createData()
    pin.framesForwardKinematics(ARM.model, data, q)
    hand = data.oMf[ARM.model.getFrameId(ARM.frame)]
    return [*(data.oMi[i].copy() for i in range(1, N + 1)), hand.copy()]


def jacobians(q):
    """Of all places in their own axes, shape (n + 1, 6, n)."""
    columns = []
    for step in TINY * np.eye(N):
        pairs = zip(places(q - step), places(q + step), strict=True)
        columns.append([pin.log6(a.actInv(b)).vector / (2.0 * TINY) for a, b in pairs])
    return np.array(columns).transpose(1, 2, 0)


def masses(q):
    """M of (1), from the kinetic energy of the links."""
    inertias = [inertia.matrix() for inertia in ARM.model.inertias[1:]]
    pairs = zip(jacobians(q)[:N], inertias, strict=True)
    return sum(J.T @ inertia @ J for J, inertia in pairs) + np.diag(ARM.model.armature)


def coriolis(q, v):
    """C of (1) by Christoffel symbols, for which M' - 2 C is skew-symmetric."""
    # d[i, j, k] is how M_ij changes with q_k.
    d = np.stack(
        [(masses(q + s) - masses(q - s)) / (2.0 * SMALL) for s in SMALL * np.eye(N)], axis=2
    )
    gamma = 0.5 * (d + d.transpose(0, 2, 1) - d.transpose(2, 1, 0))
    return gamma @ v


def gravity(q):
    """g of (1), from the potential energy."""

    def energy(q):
        links = zip(places(q)[:N], ARM.model.inertias[1:], strict=True)
        return sum(9.81 * body.mass * (place * body.lever)[2] for place, body in links)

    return np.array([(energy(q + s) - energy(q - s)) / (2.0 * TINY) for s in TINY * np.eye(N)])


def q_at(t):
    return ARM.q_start + 0.2 * np.sin(3.0 * t + np.arange(N))


def v_at(t):
    return 0.6 * np.cos(3.0 * t + np.arange(N))


def wanted(t, goal, posture):
    """(5) to (9): the accelerations of least weighted squares, by differences along a motion."""
    q, v = q_at(t), v_at(t)
    rows, right, largest = [], [], POSTURE_WEIGHT
    if goal is not None:
        largest = POSE_WEIGHT
        before, now, after = (places(q + h * v)[-1] for h in (-SMALL, 0.0, SMALL))
        axes = now.rotation
        J = np.vstack([axes @ part for part in np.split(jacobians(q)[-1], 2)])
        # J'v: accelerations at a = 0.
        linear = (after.translation - 2.0 * now.translation + before.translation) / SMALL**2
        turns = [pin.log3(b.rotation @ a.rotation.T) for a, b in ((before, now), (now, after))]
        speed, turn = np.split(J @ v, 2)
        error = goal.translation - now.translation, pin.log3(goal.rotation @ axes.T)
        g = np.r_[KP * error[0] - KD * speed, KP * error[1] - KD * turn]  # (7), (8)
        drift = np.r_[linear, (turns[1] - turns[0]) / SMALL**2]
        rows.append(np.sqrt(POSE_WEIGHT) * J)
        right.append(np.sqrt(POSE_WEIGHT) * (g - drift))  # (9)
        damping = -1.5 * v
    else:
        damping = 20.0 * (posture - q) + 1.5 * (POSTURE_SPEED - v)  # (6)
    rows += [np.sqrt(POSTURE_WEIGHT) * np.eye(N), np.sqrt(REGULARISATION * largest) * np.eye(N)]
    right += [np.sqrt(POSTURE_WEIGHT) * damping, np.zeros(N)]
    return np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]


def limited(method, u, s):
    """(10) and (11)."""
    if not u.any():
        return u
    scale = min(1.0, (LIMIT / np.abs(u)).min())
    if method == "scaling":
        return scale * u
    return nearest(u, -LIMIT, LIMIT, s, scale * s @ u)


@pytest.mark.parametrize(("tracking", "method"), [("pose", "paper"), ("posture", "scaling")])
def test_the_torque_is_what_the_equations_say(tracking, method):
    """Along a given motion, whatever torque is sent."""
    gains = Gains(
        pose_kp=KP,
        pose_kd=KD,
        pose_weight=POSE_WEIGHT,
        posture_kp=0.0 if tracking == "pose" else 20.0,
        posture_kd=1.5,
        posture_weight=POSTURE_WEIGHT,
    )
    law = IntegralSettings(LIMIT, LAMBDA, SLOW, FAST, MU, method)
    integral = IntegralAction("joints", law, np.full(N, np.inf))
    controller = make(
        ARM, robot=ARM.robot(STEP), tau_max=np.full(N, 1e4), gains=gains, integral=integral
    )
    controller.reset(q_at(0.0))
    posture = q_at(0.0) + 0.3 * np.sin(np.arange(N))
    goal = None
    if tracking == "pose":
        away = pin.Motion(np.array([0.06, -0.05, 0.04, 0.3, -0.2, 0.4]))
        goal = places(q_at(0.0))[-1] * pin.exp6(away)
        controller.goals.set_pose(goal)
    else:
        controller.goals.set_posture(posture, POSTURE_SPEED)
    wide = AccelerationRange(np.full(N, -1e4), np.full(N, 1e4))
    a_last, slow, fast = np.zeros(N), np.zeros(N), np.zeros(N)
    largest = cut = 0.0
    for k in range(12):
        t = k * STEP
        q, v = q_at(t), v_at(t)
        a = wanted(t, goal, posture)
        half = 0.5 * STEP  # torques are those of the middle of their step
        q_mid, v_mid = q + half * v + 0.5 * half**2 * a_last, v + half * a_last
        if k > 0:
            increment = a_last * STEP - (v - v_at(t - STEP))
            slow = np.exp(-SLOW * STEP) * slow + increment  # (13)
            fast = np.exp(-FAST * STEP) * fast + increment
        s = MU * fast + (1.0 - MU) * slow  # (14)
        C, K = coriolis(q_mid, v_mid), LAMBDA * np.diag(np.diag(masses(q_mid)))
        added = C @ s + limited(method, K @ s, s)  # (3), (4)
        q_mid, v_mid = q + half * v + 0.5 * half**2 * a, v + half * a
        model = masses(q_mid) @ a + coriolis(q_mid, v_mid) @ v_mid + gravity(q_mid)  # (2)
        step = controller.step(State(q, v), wide)
        np.testing.assert_allclose(step.a, a, atol=1e-4 * np.abs(a).max())
        # The rest of the torque is some 100 N m, of which differences know 1e-7.
        np.testing.assert_allclose(step.tau - model, added, atol=2e-4)
        largest = max(largest, np.abs(added).max())
        cut = max(cut, np.abs(K @ s - limited(method, K @ s, s)).max())
        a_last = step.a
    assert largest > 0.04
    assert cut > 0.02
