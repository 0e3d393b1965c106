# SPDX-License-Identifier: Apache-2.0
"""Integral actions with random dynamics, which need not be those of a robot, for tests."""

import numpy as np

from torque_safety_controller.integral_feedback import (
    ArmTerms,
    IntegralFeedback,
    IntegralSettings,
)

N = 5
SHARP = 1e-12  # relative; rounding and nothing else
ROUGH = 1e-9


def random_dynamics(rng, speed=1.0):
    """A mass matrix and any C: what is shown with them does not need it to be a robot's."""
    A = rng.normal(size=(N, N))
    return A @ A.T + 0.3 * np.eye(N), speed * rng.normal(size=(N, N))


def arm_terms(M, C, v=None) -> ArmTerms:
    """Terms of an arm without a task; at rest without `v`."""
    v = np.zeros(len(M)) if v is None else v
    no_task = np.zeros((0, len(M)))
    return ArmTerms(np.ascontiguousarray(M), np.ascontiguousarray(C), no_task, no_task, v)


def begun(settings: IntegralSettings, v=None) -> IntegralFeedback:
    """An integral action at the beginning, at this velocity."""
    feedback = IntegralFeedback(settings)
    zero = np.zeros((len(settings.budget),) * 2)
    feedback.reset(arm_terms(zero, zero, v))
    return feedback


def at_state(settings: IntegralSettings, fast, slow=None) -> IntegralFeedback:
    """An integral action with these integrators."""
    feedback = begun(settings)
    feedback.memory.fast[:] = fast
    feedback.memory.slow[:] = fast if slow is None else slow
    return feedback


def torque_now(feedback, M, C):
    """The torque of a step that takes no time."""
    return feedback.torque(arm_terms(M, C), np.zeros(len(M)), 0.0)
