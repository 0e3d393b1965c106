# SPDX-License-Identifier: Apache-2.0
"""A Panda with integral action, whose motors give what they are told, for tests."""

from copy import deepcopy
from functools import cache

import numpy as np
from arms import load_arm

from torque_safety_controller.integral_feedback import IntegralSettings
from torque_safety_controller.parts.integral import make_integral
from viability_bounds_pkg.state import State

ARM = load_arm("panda")
N = ARM.n
DT = 1e-3
LAMBDA = 30.0
BUDGET = 0.2 * ARM.tau_max
REST = np.zeros(N)
# N m; what acts on the joints and the model does not know.
DISTURBANCE = 0.06 * ARM.tau_max * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])


def make_settings(**changed) -> IntegralSettings:
    return IntegralSettings(**{"budget": BUDGET, "gain": LAMBDA} | changed)


class IntegralLoop:
    """An arm that holds its posture by a spring and a damper, and the integral action."""

    def __init__(self, mode="joints", disturbance=2.0, **changed) -> None:
        self.robot = ARM.robot(DT)
        self.robot.rates = True
        self.action = make_integral(mode, make_settings(**changed), disturbance * ARM.tau_max)
        self.q, self.v, self.a = ARM.q_start.copy(), REST, REST
        self.torques = [REST]

    def step(self, elapsed=DT, v_seen=None, disturbance=DISTURBANCE) -> np.ndarray:
        """Play a period; return what was added."""
        v = self.v if v_seen is None else v_seen
        self.robot.update(State(self.q, v), self.a)
        added = self.action.torque(self.robot, self.a, elapsed)
        self.a = 100.0 * (ARM.q_start - self.q) - 20.0 * v
        tau = self.robot.torque(self.a) + added + disturbance
        self.q, self.v = ARM.move(self.q, self.v, tau, DT, steps=1)
        self.torques.append(added)
        return added

    def run(self, seconds, **others):
        for _ in range(round(seconds / DT)):
            self.step(**others)
        return self

    def steps(self, last) -> float:
        """Return the largest change of torque in the last steps, in torque limits."""
        return relative(np.diff(np.array(self.torques[-last - 1 :]), axis=0))


def relative(torque) -> float:
    return float(np.abs(torque / ARM.tau_max).max())


def settled(mode, **changed) -> IntegralLoop:
    """An arm whose integral action carries a good part of the disturbance, to be moved on."""
    return deepcopy(settled_once(mode, **changed))


@cache
def settled_once(mode, **changed) -> IntegralLoop:
    loop = IntegralLoop(mode, **changed).run(0.4)
    assert relative(loop.action.last) > 0.03 or mode == "none"
    assert loop.steps(50) < 2e-4
    return loop
