# SPDX-License-Identifier: Apache-2.0
"""Observers against disturbances that do their worst, and against other gains."""

import numpy as np
import pytest

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.observer import Observer, design_observer

CASES = [
    # dt, largest error of position and acceleration
    (0.001, 5e-5, 2.0),
    (0.01, 5e-4, 1.0),
    (0.002, 1e-6, 40.0),
    (0.002, 0.0, 3.0),
]
STEPS = 1500


def observer_at(design, dt, state, lasting=0.0):
    observer = Observer(design, dt, np.full(len(state.q), lasting))
    observer.start(state)
    return observer


def track(observer, a, q):
    """Advance by a period to a measured position; return the innovation."""
    observer.predict(a)
    innovation = observer.innovation(q)
    observer.correct(innovation)
    return innovation


def responses(design, dt):
    """Return the responses of the error to one wrong measurement, and to d at times in a step.

    They come from the observer itself: shape (steps, 2) and (steps, times, 2).
    """
    times = (np.arange(200) + 0.5) / 200 * dt

    def follow(error_q, error_v, n):
        # The truth rests at zero, so that the error is minus the estimate.
        observer = observer_at(design, dt, State(np.array([-error_q]), np.array([-error_v])))
        rows = []
        for measured in (n, *np.zeros(STEPS - 1)):
            observer.correct(observer.innovation(np.array([measured])))
            rows.append([-observer.state.q[0], -observer.state.v[0]])
            observer.predict(np.zeros(1))
        return np.array(rows)

    noise = follow(0.0, 0.0, 1.0)
    # A pulse of d at time s: dt - s of way and 1 of speed at the end of the step. It is linear.
    way, speed = follow(1.0, 0.0, 0.0), follow(0.0, 1.0, 0.0)
    pulses = way[:, None] * (dt - times)[:, None] + speed[:, None]
    return noise, pulses, times[1] - times[0]


@pytest.mark.parametrize(("dt", "delta", "w"), CASES)
def test_bang_bang_disturbances_reach_the_guaranteed_errors(dt, delta, w):
    design = design_observer(dt, [delta], [w])
    noise, pulses, interval = responses(design, dt)
    for k, guaranteed in ((0, design.position_error), (1, design.velocity_error)):
        reached = delta * np.abs(noise[:, k]).sum() + w * interval * np.abs(pulses[..., k]).sum()
        assert reached == pytest.approx(guaranteed[0], rel=2e-3)


@pytest.mark.parametrize("lasting", [0.0, 4.0])
def test_guarantees_hold_under_quantisation_and_while_disturbances_are_learned(lasting):
    rng = np.random.default_rng(1)
    dt, resolution, w, count = 0.001, 1e-4, 4.0, 50
    design = design_observer(dt, np.full(count, 0.5 * resolution), np.full(count, w + lasting))
    truth = State(rng.uniform(-1, 1, count), np.zeros(count))
    observer = observer_at(design, dt, truth, lasting)
    largest = np.zeros(count)
    for k in range(3000):
        if k % 300 == 0:  # the worst is a change of sign after the other one was learned
            d = w * rng.choice([-1.0, 1.0], count)
        known = 10.0 * np.sin(0.01 * k + np.arange(count))
        truth = truth.after(known + d, dt)
        innovation = track(observer, known, resolution * np.rint(truth.q / resolution))
        assert (abs(innovation) <= design.innovation).all()
        assert (abs(truth.q - observer.state.q) <= design.position_error).all()
        np.maximum(largest, abs(truth.v - observer.state.v), out=largest)
    assert (largest <= design.velocity_error).all()
    assert (largest > 0.2 * design.velocity_error).any(), "far from what is guaranteed"


@pytest.mark.parametrize(("dt", "delta", "w"), CASES[:3])
def test_no_other_gains_are_much_better(dt, delta, w):
    """The observer may be 15 % worse than those with any equal poles, for less noise."""
    design = design_observer(dt, [delta], [w])
    poles = np.linspace(0.0, 0.995, 200)
    l1, l2 = 1.0 - poles**2, (1.0 - poles) ** 2 / dt
    noise, step = np.array([l1, l2]), np.array([(1.0 - l1) * 0.5 * dt, 1.0 - 0.5 * l2 * dt])
    total = np.zeros(200)
    for _ in range(STEPS):
        total += delta * np.abs(noise[1]) + w * dt * np.abs(step[1])
        noise, step = (
            np.array([(1.0 - l1) * (q + dt * v), v - l2 * (q + dt * v)]) for q, v in (noise, step)
        )
    assert design.velocity_error[0] <= 1.01 * 1.15 * total.min()


def test_exact_positions_give_an_observer_that_is_right_after_two_periods():
    dt = 0.01
    design = design_observer(dt, [0.0], [3.0])
    assert design.position_error[0] == 0.0
    assert design.velocity_error[0] == pytest.approx(3.0 * dt / 2)
    observer = observer_at(design, dt, State(np.array([0.3]), np.array([-4.0])))
    truth = State(np.array([1.0]), np.array([0.5]))
    for _ in range(2):
        truth = truth.after(np.ones(1), dt)
        track(observer, np.ones(1), truth.q)
    np.testing.assert_allclose(observer.state, truth, atol=1e-12)


def test_an_error_at_the_start_decays_whatever_is_declared():
    """While disturbances are learned, and where accelerations are declared exact."""
    design = design_observer(0.001, [0.0, 1e-7, 1e-3, 1e-3], [3.0, 3.0, 3.0, 0.0])
    observer = observer_at(design, 0.001, State(np.full(4, 1e-3), np.ones(4)), 1e9)
    for _ in range(15000):
        track(observer, np.zeros(4), np.zeros(4))
    assert np.abs(observer.state.v).max() < 1e-6
    assert np.abs(observer.disturbance).max() < 1e-3


@pytest.mark.parametrize(("lasting", "left"), [(0.0, 1.0), (2.0, 1.0 / 3.0), (3.0, 0.0)])
def test_a_lasting_disturbance_is_learned_up_to_what_is_declared(lasting, left):
    dt = 0.001
    design = design_observer(dt, [5e-5], [3.0 + lasting])
    truth = State(np.zeros(1), np.zeros(1))
    observer = observer_at(design, dt, truth, lasting)
    for _ in range(3000):
        truth = truth.after(np.full(1, 3.0), dt)
        track(observer, np.zeros(1), truth.q)
    assert observer.disturbance[0] == pytest.approx(lasting, rel=1e-3)
    lag = 2.0 / ((1.0 - np.sqrt(1.0 - design.position_gain[0])) / dt) - 1.5 * dt
    expected = left * 3.0 * lag  # what is not learned makes the velocity late
    assert truth.v[0] - observer.state.v[0] == pytest.approx(expected, rel=1e-2, abs=1e-5)
