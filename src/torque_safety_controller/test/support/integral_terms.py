# SPDX-License-Identifier: Apache-2.0
"""Integral actions with random dynamics, which need not be those of a robot, for tests."""

import numpy as np

from torque_safety_controller.anti_windup import nearest_with_leak
from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralFeedback,
)

N = 5
DT = 1e-3
SHARP = 1e-12  # relative; rounding and nothing else
ROUGH = 1e-9


def random_dynamics(rng, n=N, speed=1.0):
    """A mass matrix and any C: what is said below does not need it to be a robot's."""
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.3 * np.eye(n), speed * rng.normal(size=(n, n))


def arm_terms(M, C, v=None) -> ArmTerms:
    """Terms of an arm without a task."""
    n = len(M)
    no_task = np.zeros((0, n))
    return ArmTerms(M, C, no_task, no_task, np.zeros(n) if v is None else v)


def begun(law, v=None) -> IntegralFeedback:
    """An integral action at the beginning, at this velocity."""
    feedback = IntegralFeedback(law)
    zero = np.zeros((len(law.budget),) * 2)
    feedback.reset(arm_terms(zero, zero, v))
    return feedback


def at_state(law, fast, slow=None) -> IntegralFeedback:
    """An integral action with these integrators."""
    feedback = begun(law)
    feedback.memory.fast[:] = fast
    feedback.memory.slow[:] = fast if slow is None else slow
    return feedback


def torque_now(feedback, M, C):
    """The torque of a step that takes no time."""
    return feedback.torque(arm_terms(M, C), np.zeros(len(M)), 0.0)


def uncorrected(law, s, M, C):
    """Torque and leak of (11*) for this s, before the integrators are corrected."""
    limit = law.budget
    Ks = law.gain * np.diag(M) * s
    w = C @ s + np.clip(Ks, -limit, limit)
    return nearest_with_leak(M, s, C @ s + Ks, limit, w)


def moving(feedback, rng, steps=50):
    """Some steps of a slow motion; the terms after them and the torques."""
    M, C = np.diag(rng.uniform(0.5, 2.0, N)), 0.2 * rng.normal(size=(N, N))
    v, torques = np.zeros(N), []
    feedback.reset(arm_terms(M, C))
    for k in range(steps):
        v = v + DT * rng.normal(size=N)
        a_ref = 3.0 * np.cos(0.05 * k + np.arange(N))
        torques.append(feedback.torque(arm_terms(M, C, v), a_ref, DT))
    return arm_terms(M, C, v), np.array(torques)
