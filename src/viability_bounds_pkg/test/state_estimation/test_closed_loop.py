# SPDX-License-Identifier: Apache-2.0
"""An arm with coarse encoders, delay, motor lag and a disturbance, controlled by predictions."""

import numpy as np
import pinocchio as pin
import pytest
from true_arm import TrueArm, model

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import design_observer

DT, PERIOD_NS = 0.001, 1_000_000
RESOLUTION = 1e-4  # rad
W = 4.0  # rad/s^2
N = 7
TAU_MAX = np.array([87.0, 87, 87, 87, 12, 12, 12])
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
DESIGN = design_observer(DT, np.full(N, 0.5 * RESOLUTION), np.full(N, W))


class Loop:
    """Each state is `sensing` periods old, each command acts `acting` periods later."""

    def __init__(self, sensing, acting, bandwidth=0.0, noise=0.0, lost=(), predicts=True) -> None:
        self.lag = np.full(N, 1.0 / (2.0 * np.pi * bandwidth) if bandwidth else 0.0)
        self.delay = sensing + acting
        delay, lag = (self.delay, self.lag) if predicts else (0, np.zeros(N))
        self.estimator = StateEstimator(
            model(), DT, delay, lag, DESIGN, np.full(N, 2.0), TAU_MAX, np.zeros(N)
        )
        hold = np.array(pin.rnea(model(), model().createData(), HOME, 0 * HOME, 0 * HOME))
        rng = np.random.default_rng(4)
        # 0.95: the model at the estimated state is not quite that at the true one.
        switches = rng.choice([-0.95 * W, 0.95 * W], (N, 400))
        self.arm = TrueArm(
            DT,
            State(HOME, np.zeros(N)),
            hold,
            self.lag if bandwidth else None,
            lambda t: switches[:, int(t / 0.0017)],
        )
        self.noise, self.rng, self.lost = noise, rng, lost
        self.sent = [hold] * (acting + 1)
        self.seen = [self._sense()] * (sensing + 1)

    def _sense(self):
        coarse = RESOLUTION * np.rint(self.arm.state.q / RESOLUTION)
        noise = self.noise * TAU_MAX * np.clip(self.rng.standard_normal(N), -3, 3)
        return State(coarse, np.zeros(N)), self.arm.tau + noise

    def errors(self, steps):
        """Return the largest errors of the states in which commands act, shape (2, n)."""
        estimates, met, data = [], [], model().createData()
        for k in range(1, steps + 1):
            self.seen = [*self.seen[1:], self._sense()]
            state = self.estimator.step(k * PERIOD_NS, *self.seen[0])
            estimates.append(state)
            goal = HOME + 0.4 * (np.sin(5.0 * k * DT + np.arange(N)) - np.sin(np.arange(N)))
            a = 60.0 * (goal - state.q) - 15.0 * state.v
            tau = np.clip(pin.rnea(model(), data, *state, a), -TAU_MAX, TAU_MAX)
            self.estimator.answer(k * PERIOD_NS, tau)
            self.sent = [*self.sent[1:], self.sent[-1] if k in self.lost else tau]
            met.append(self.arm.met())
            self.arm.step(self.sent[0])
        pairs = zip(estimates, met[len(self.sent) - 1 :], strict=False)
        return np.max([np.abs(np.subtract(x, y)) for x, y in pairs], axis=0)

    def allowed(self):
        """Return what the declared errors allow, "State predicted" in docs/theory/bounds.md."""
        tau = self.delay * DT + self.lag
        e_q, e_v = DESIGN.position_error, DESIGN.velocity_error
        return np.array([e_q + tau * e_v + 0.5 * W * tau**2, e_v + W * tau])


@pytest.mark.parametrize(
    ("sensing", "acting", "bandwidth", "noise"), [(0, 2, 0.0, 0.0), (1, 1, 100.0, 0.01)]
)
def test_errors_when_commands_act_are_within_what_is_declared(sensing, acting, bandwidth, noise):
    loop = Loop(sensing, acting, bandwidth, noise)
    errors = loop.errors(400)
    assert (errors <= loop.allowed()).all()
    assert (errors[1] > 0.2 * loop.allowed()[1]).any(), "far from what is declared"
    assert not loop.estimator.resets
    assert (loop.estimator.innovation <= DESIGN.innovation).all()


def test_without_prediction_the_errors_are_larger():
    errors, blind = Loop(1, 1, 100.0).errors(200), Loop(1, 1, 100.0, predicts=False).errors(200)
    assert (blind[1] > 1.2 * errors[1]).any()


def test_lost_commands_do_not_lead_the_observer_astray():
    loop = Loop(1, 1, noise=0.005, lost={k for k in range(50, 300) if k % 40 < 3})
    loop.errors(300)
    assert not loop.estimator.resets
    assert (loop.estimator.innovation <= 1.1 * DESIGN.innovation).all()
