# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance as printed, beside the equations written down once more.

Nothing of the controller is used for what is expected: inverses and rates by NumPy and by
differences along the motion, (11) by ProxQP.
"""

import numpy as np
import pytest
from general_solver import nearest
from printed_law import FAST, LAMBDA, MU, SLOW, STEP, PrintedLaw
from task_arm import TaskArm, arm_terms

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.integral_feedback.printed import PrintedCompliance


class Motion(PrintedLaw):
    """A real arm on a motion, and how its torque is limited."""

    def __init__(self, robot, rows, method):
        self.arm = TaskArm(robot, rows, armature=0.1)
        super().__init__(self.arm.model, self.arm.posture, rows, 0.3, 2.0, small=1e-5)
        self.limit = np.where(np.arange(self.n) % 3 == 0, 0.02, 1.0)
        self.method, self.binding = method, 0

    def terms(self, t):
        return self.arm.terms(self.q(t), self.v(t))

    def J(self, t):
        return self.terms(t).J

    def limited(self, u):
        """(10), or (11) with a for s: what u takes energy out of."""
        self.beyond, limit = np.abs(u) > self.limit, self.limit
        factor = min(1.0, (limit / np.abs(u)).min())
        if self.method == "scaling":
            return factor * u
        x = nearest(u, -limit, limit, self.a, factor * self.a @ u)
        self.binding += np.abs(x - np.clip(u, -limit, limit)).max() > 1e-3
        return x


@pytest.mark.parametrize(
    ("robot", "rows", "method"), [("panda", 3, "paper"), ("talos", 6, "scaling")]
)
def test_it_is_what_the_paper_prints(robot, rows, method):
    """What differs is J' in the middle of a step: less than 1e-4 of the torque."""
    motion = Motion(robot, rows, method)
    settings = IntegralSettings(motion.limit, LAMBDA, SLOW, FAST, MU, method)
    compliance = PrintedCompliance(settings, rows)
    compliance.reset(arm_terms(motion.terms(0.0), motion.v(0.0)))
    limited = same = 0
    for k in range(1, 150):
        t = k * STEP
        now = arm_terms(motion.terms(t), motion.v(t))
        found = compliance.torque(now, motion.a_ref(t - STEP), STEP)
        expected = motion.expected(t)
        np.testing.assert_allclose(found, expected, atol=1e-4 * max(1.0, np.abs(expected).max()))
        same += (compliance.saturated == motion.beyond).all()
        limited += motion.beyond.any()
    assert limited > 50
    assert same > 140  # they may differ where a limit is just reached
    assert motion.binding > 70 or method == "scaling"


@pytest.mark.parametrize("method", ["paper", "scaling"])
def test_a_torque_is_taken_over_as_far_as_the_task_feels_it(method):
    """And one within the range of the task's inverse goes on."""
    arm, rest = TaskArm("panda"), np.zeros(7)
    terms = arm.terms(arm.posture, rest)
    compliance = PrintedCompliance(IntegralSettings(np.full(7, np.inf), anti_windup=method), 6)
    torque = terms.J.T @ np.array([3.0, -2.0, 4.0, 0.3, 0.1, -0.2])
    now = arm_terms(terms, rest)
    np.testing.assert_allclose(compliance.initialise(torque, now), torque, rtol=1e-9)
    after = compliance.torque(now, rest, 2e-3)
    np.testing.assert_allclose(after, np.exp(-0.1 * 2e-3) * torque, rtol=1e-9)


def test_numbers_that_are_not_finite_are_refused_and_change_nothing():
    arm, rest = TaskArm("panda"), np.zeros(7)
    now = arm_terms(arm.terms(arm.posture, rest), rest)
    compliance = PrintedCompliance(IntegralSettings(np.ones(7), anti_windup="paper"), 6)
    compliance.initialise(np.ones(7), now)
    before = [x.copy() for x in compliance.memory]
    for bad, a_last in ((now._replace(C=np.nan * now.C), rest), (now, 1e308 * np.ones(7))):
        with pytest.raises(ValueError, match="finite"), np.errstate(all="ignore"):
            compliance.torque(bad, a_last, 1e3)
    for x, y in zip(compliance.memory, before, strict=True):
        np.testing.assert_array_equal(x, y)
