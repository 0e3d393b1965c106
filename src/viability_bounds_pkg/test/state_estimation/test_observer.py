# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.observer import SLACK, Observer, design_observer

CASES = [
    # dt, largest error of position and acceleration
    (0.001, 5e-5, 2.0),
    (0.002, 5e-5, 5.0),
    (0.01, 5e-4, 1.0),
    (0.001, 1e-4, 60.0),
    (0.002, 1e-6, 40.0),
    (0.002, 0.0, 3.0),
]
STEPS = 2500


def observer_at(design, dt, state, lasting=0.0):
    observer = Observer(design, dt, np.full(len(state.q), lasting))
    observer.start(state)
    return observer


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


@pytest.mark.parametrize("target", [0, 1])
@pytest.mark.parametrize(("dt", "delta", "w"), CASES)
def test_an_adversary_comes_near_the_guaranteed_errors_but_not_beyond(dt, delta, w, target):
    # Played forward: the signs of the responses in the order of time, d constant in each step.
    design = design_observer(dt, [delta], [w])
    noise, pulses, _ = responses(design, dt)
    count = 1500
    n = delta * np.sign(noise[:count, target])[::-1]
    d = w * np.sign(pulses[:count].mean(axis=1)[:, target])[::-1]
    observer = observer_at(design, dt, State(np.zeros(1), np.zeros(1)))
    truth = State(np.zeros(1), np.zeros(1))
    guaranteed = design.position_error[0], design.velocity_error[0]
    for k in range(count):
        truth = truth.after(d[k : k + 1], dt)
        observer.predict(np.zeros(1))
        innovation = observer.innovation(truth.q + n[k])
        assert abs(innovation[0]) <= design.innovation[0] * (1.0 + 1e-9) + 1e-15
        observer.correct(innovation)
        errors = [abs(a - b)[0] for a, b in zip(truth, observer.state, strict=True)]
        assert errors[0] <= guaranteed[0] * (1.0 + 1e-9) + 1e-12
        assert errors[1] <= guaranteed[1] * (1.0 + 1e-9) + 1e-12
    # d may change its sign within a step, too, which this adversary does not.
    assert errors[target] >= 0.9 * guaranteed[target]


def test_guarantees_hold_under_quantisation_noise_and_changing_accelerations():
    rng = np.random.default_rng(1)
    dt, resolution, w = 0.001, 1e-4, 4.0
    design = design_observer(dt, np.full(50, 0.5 * resolution), np.full(50, w))
    start = State(rng.uniform(-1, 1, 50), np.zeros(50))
    observer, truth = observer_at(design, dt, start), start
    largest = np.zeros(50)
    for k in range(4000):
        d = w * np.sign(np.sin(rng.uniform(2.0, 60.0) * k * dt + np.arange(50)))
        known = 10.0 * np.sin(0.01 * k + np.arange(50))
        truth = truth.after(known + d, dt)
        observer.predict(known)
        observer.correct(observer.innovation(resolution * np.rint(truth.q / resolution)))
        np.maximum(largest, abs(truth.v - observer.state.v), out=largest)
        assert (abs(truth.q - observer.state.q) <= design.position_error).all()
    assert (largest <= design.velocity_error).all()
    assert (largest > 0.2 * design.velocity_error).any(), "far from what is guaranteed"


@pytest.mark.parametrize(("dt", "delta", "w"), CASES[:4])
def test_no_other_gains_are_much_better(dt, delta, w):
    def worst(l1, l2):
        """Return the largest error of the velocity with any gains, infinite if unstable."""
        A = np.array([[1.0 - l1, (1.0 - l1) * dt], [-l2, 1.0 - l2 * dt]])
        if np.abs(np.linalg.eigvals(A)).max() > 0.995:
            return np.inf
        noise, step = np.array([l1, l2]), np.array([(1.0 - l1) * 0.5 * dt, 1.0 - 0.5 * l2 * dt])
        total = 0.0
        for _ in range(1500):
            total += delta * abs(noise[1]) + w * dt * abs(step[1])
            noise, step = A @ noise, A @ step
        return total

    design = design_observer(dt, [delta], [w])
    p = 1.0 - np.sqrt(design.velocity_gain[0] * dt)
    frequencies = -np.log(p) / dt * np.geomspace(0.25, 4.0, 13)
    same_poles = min(worst(1.0 - z**2, (1.0 - z) ** 2 / dt) for z in np.exp(-frequencies * dt))
    # Complex and real pairs of poles around it, too.
    best = min(
        worst(1.0 - (z1 * z2).real, ((1.0 - z1) * (1.0 - z2)).real / dt)
        for w0 in frequencies
        for damping in (0.4, 0.6, 0.8, 1.2, 1.8, 3.0)
        for z1, z2 in [
            np.exp(w0 * dt * np.roots([1.0, 2.0 * damping, 1.0]))  # roots of s^2 + 2 d s + 1
        ]
    )
    ours = design.velocity_error[0]
    assert ours <= 1.01 * SLACK * same_poles
    assert ours <= 1.15 * SLACK * best


def test_larger_errors_of_the_position_make_slower_observers():
    design = design_observer(0.001, [1e-6, 1e-5, 1e-4, 1e-3], np.full(4, 3.0))
    assert (np.diff(design.velocity_gain) < 0.0).all()
    assert (np.diff(design.velocity_error) > 0.0).all()


def test_exact_positions_give_an_observer_that_is_right_after_two_periods():
    dt = 0.01
    design = design_observer(dt, [0.0], [3.0])
    assert design.position_error[0] == 0.0
    assert design.velocity_error[0] == pytest.approx(3.0 * dt / 2)
    observer = observer_at(design, dt, State(np.array([0.3]), np.array([-4.0])))
    truth = State(np.array([1.0]), np.array([0.5]))
    for _ in range(2):
        truth = truth.after(np.ones(1), dt)
        observer.predict(np.ones(1))
        observer.correct(observer.innovation(truth.q))
    np.testing.assert_allclose(observer.state, truth, atol=1e-12)


def test_nothing_declared_guarantees_that_there_is_no_error():
    design = design_observer(0.001, np.zeros(3), np.zeros(3))
    for each in (design.position_error, design.velocity_error, design.innovation):
        np.testing.assert_array_equal(each, np.zeros(3))


def test_an_error_at_the_start_decays_where_accelerations_are_declared_exact():
    dt = 0.001
    design = design_observer(dt, [1e-3], [0.0])
    observer = observer_at(design, dt, State(np.zeros(1), np.ones(1)))
    for _ in range(2000):
        observer.predict(np.zeros(1))
        observer.correct(observer.innovation(np.zeros(1)))
    assert abs(observer.state.v[0]) < 1e-6


def test_a_lasting_disturbance_is_learned_up_to_what_is_declared():
    dt = 0.001
    for lasting, left in ((0.0, 1.0), (2.0, 1.0 / 3.0), (3.0, 0.0)):
        design = design_observer(dt, [5e-5], [3.0 + lasting])
        observer = observer_at(design, dt, State(np.zeros(1), np.zeros(1)), lasting)
        truth = observer.state
        for _ in range(3000):
            truth = truth.after(np.full(1, 3.0), dt)
            observer.predict(np.zeros(1))
            observer.correct(observer.innovation(truth.q))
        assert observer.disturbance[0] == pytest.approx(min(lasting, 3.0), rel=1e-3)
        lag = 2.0 / ((1.0 - np.sqrt(1.0 - design.position_gain[0])) / dt) - 1.5 * dt
        expected = left * 3.0 * lag  # what is not learned makes the velocity late
        assert truth.v[0] - observer.state.v[0] == pytest.approx(expected, rel=1e-2, abs=1e-5)


def test_the_guarantee_holds_while_disturbances_are_learned():
    rng = np.random.default_rng(6)
    dt, resolution, w = 0.001, 1e-4, 4.0
    design = design_observer(dt, np.full(30, 0.5 * resolution), np.full(30, 2.0 * w))
    observer = observer_at(design, dt, State(np.zeros(30), np.zeros(30)), w)
    truth = observer.state
    largest = np.zeros(30)
    for k in range(6000):
        if k % 300 == 0:  # the worst is a change of sign after the other one was learned
            d = w * rng.choice([-1.0, 1.0], 30)
        truth = truth.after(d, dt)
        observer.predict(np.zeros(30))
        innovation = observer.innovation(resolution * np.rint(truth.q / resolution))
        assert (abs(innovation) <= design.innovation).all()
        observer.correct(innovation)
        np.maximum(largest, abs(truth.v - observer.state.v), out=largest)
        assert (abs(truth.q - observer.state.q) <= design.position_error).all()
    assert (largest <= design.velocity_error).all()
    assert (largest > 0.5 * design.velocity_error).any()


@pytest.mark.parametrize("delta", [0.0, 1e-7, 1e-5, 1e-3])
def test_learning_is_stable_for_any_poles(delta):
    design = design_observer(0.001, [delta], [3.0])
    observer = observer_at(design, 0.001, State(np.full(1, 1e-3), np.ones(1)), 1e9)
    for _ in range(30000):
        observer.predict(np.zeros(1))
        observer.correct(observer.innovation(np.zeros(1)))
    assert abs(observer.state.v[0]) < 1e-6
    assert abs(observer.disturbance[0]) < 1e-3
