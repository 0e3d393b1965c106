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
KP, KD = 60.0, 15.0


class Loop:
    """Each state is `sensing` periods old, each command acts `acting` periods later."""

    def __init__(self, sensing, acting, bandwidth, noise=0.0, lost=(), scale=1.0) -> None:
        self.lag = np.full(N, 1.0 / (2.0 * np.pi * bandwidth) if bandwidth else 0.0)
        self.delay = sensing + acting
        self.design = design_observer(DT, np.full(N, 0.5 * RESOLUTION), np.full(N, W))
        self.estimator = StateEstimator(
            model(), DT, self.delay, self.lag, self.design, np.full(N, 2.0), TAU_MAX, np.zeros(N)
        )
        hold = np.array(pin.rnea(model(), model().createData(), HOME, 0 * HOME, 0 * HOME))
        rng = np.random.default_rng(4)
        # 0.95: the model at the estimated state is not quite that at the true one.
        switches = rng.choice([-0.95 * W, 0.95 * W], (N, 400)) * scale
        self.arm = TrueArm(
            model(),
            DT,
            State(HOME, np.zeros(N)),
            hold,
            self.lag if bandwidth else None,
            lambda t: switches[:, int(t / 0.0017)],
        )
        self.noise, self.rng, self.lost = noise, rng, lost
        self.sent = [hold] * (acting + 1)
        self.seen = [self._sense()] * (sensing + 1)
        self.data = model().createData()

    def _sense(self):
        coarse = RESOLUTION * np.rint(self.arm.state.q / RESOLUTION)
        noise = self.noise * TAU_MAX * np.clip(self.rng.standard_normal(N), -3, 3)
        return State(coarse, np.zeros(N)), self.arm.tau + noise

    def meets(self):
        """Return the state that a command meets that begins to act now."""
        q, v = self.arm.state
        a = self.arm.acceleration() + self.arm.disturbance(self.arm.t)
        return State(q + self.lag * v, v + self.lag * a)

    def run(self, steps, goal):
        """Return estimated states by period, and what the commands met by period."""
        estimates, met = [], []
        for k in range(1, steps + 1):
            self.seen = [*self.seen[1:], self._sense()]
            state = self.estimator.step(k * PERIOD_NS, *self.seen[0])
            estimates.append(state)
            a = KP * (goal(k * DT) - state.q) - KD * state.v
            tau = np.array(pin.rnea(model(), self.data, *state, a))
            tau = np.clip(tau, -TAU_MAX, TAU_MAX)
            self.estimator.answer(k * PERIOD_NS, tau)
            arrived = self.sent[-1] if k in self.lost else tau
            self.sent = [*self.sent[1:], arrived]
            met.append(self.meets())
            self.arm.step(self.sent[0])
        return estimates, met

    def errors(self, steps=500):
        """Return the largest errors of each joint's position and velocity when commands act."""
        goal = lambda t: HOME + 0.4 * np.sin(5.0 * t + np.arange(N)) - 0.4 * np.sin(np.arange(N))  # noqa: E731
        estimates, met = self.run(steps, goal)
        acting = len(self.sent) - 1
        pairs = list(zip(estimates, met[acting:], strict=False))
        return np.max([np.abs(np.subtract(x, y)) for x, y in pairs], axis=0)

    def allowed(self):
        """Return what the declared errors allow, point 5 of docs/theory/bounds.md."""
        tau = self.delay * DT + self.lag
        e_q, e_v = self.design.position_error, self.design.velocity_error
        return e_q + tau * e_v + 0.5 * W * tau**2, e_v + W * tau


@pytest.mark.parametrize(
    ("sensing", "acting", "bandwidth"), [(0, 0, 0.0), (1, 1, 0.0), (0, 2, 100.0), (1, 1, 100.0)]
)
def test_errors_when_commands_act_are_within_what_is_declared(sensing, acting, bandwidth):
    loop = Loop(sensing, acting, bandwidth)
    q, v = loop.errors()
    allowed_q, allowed_v = loop.allowed()
    assert (q <= allowed_q).all()
    assert (v <= allowed_v).all()
    assert (v > 0.2 * allowed_v).any(), "far from what is declared"
    assert not loop.estimator.resets
    assert (loop.estimator.innovation <= loop.design.innovation).all()


def test_noise_of_the_reported_torque_does_not_matter():
    quiet, noisy = Loop(1, 1, 100.0), Loop(1, 1, 100.0, noise=0.01)
    q, v = noisy.errors(300)
    allowed_q, allowed_v = noisy.allowed()
    assert (q <= allowed_q).all()
    assert (v <= allowed_v).all()
    assert (v < 1.5 * quiet.errors(300)[1]).all()


def test_without_prediction_the_errors_are_larger():
    loop = Loop(1, 1, 100.0)
    with_prediction = loop.errors(300)[1]
    blind = Loop(1, 1, 100.0)
    blind.estimator = StateEstimator(
        model(), DT, 0, np.zeros(N), blind.design, np.full(N, 2.0), TAU_MAX, np.zeros(N)
    )
    assert (blind.errors(300)[1] > 1.2 * with_prediction).any()


def test_lost_commands_do_not_lead_the_observer_astray():
    lost = {k for k in range(50, 500) if k % 40 < 3}
    loop = Loop(1, 1, 0.0, noise=0.005, lost=lost)
    loop.errors()
    assert not loop.estimator.resets
    assert (loop.estimator.innovation <= 1.1 * loop.design.innovation).all()


def test_twice_as_large_errors_as_declared_do_not_make_it_unstable():
    loop = Loop(1, 1, 100.0, scale=2.0)
    q, v = loop.errors()
    allowed_q, allowed_v = loop.allowed()
    assert (q <= 2.0 * allowed_q).all()
    assert (v <= 2.0 * allowed_v).all()
    assert not loop.estimator.resets
