"""The bounds keep the limits: in motion, under disturbances, and on the way back from outside."""

import numpy as np
import pytest
from joint_cases import CASES, FAILING, FAST_LOOP, HOLDING, column, one_joint, states_of

from viability_bounds_pkg import paper_algorithms
from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver, condition_11

CASES = {**CASES, **FAST_LOOP}

VIOLATION = 1e-9
"""Largest violation of a limit in continuous time, rad and rad/s."""

MOTIONS = 400
STEPS = 50


def advance(q, v, a, dt):
    """Return the state after dt, and the lowest and highest position on the way."""
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.where(a != 0.0, -v / a, -1.0)
    turn = np.where((turn > 0.0) & (turn < dt), turn, dt)
    at_turn = q + turn * v + 0.5 * turn**2 * a
    q_next = q + dt * v + 0.5 * dt**2 * a
    low = np.minimum(np.minimum(q, q_next), at_turn)
    high = np.maximum(np.maximum(q, q_next), at_turn)
    return q_next, v + dt * a, low, high


def towards_nearest(q, v, lower, upper, limits, rng):
    """Rush at the limit that is closer: the greedy adversary."""
    return np.where(limits.q_max - q < q - limits.q_min, upper, lower)


POLICIES = {
    "upper": lambda q, v, lower, upper, limits, rng: upper,
    "lower": lambda q, v, lower, upper, limits, rng: lower,
    "random": lambda q, v, lower, upper, limits, rng: rng.uniform(lower, upper),
    "either": lambda q, v, lower, upper, limits, rng: np.where(
        rng.random(q.shape) < 0.5, lower, upper
    ),
    "faster": lambda q, v, lower, upper, limits, rng: np.where(v > 0.0, upper, lower),
    "nearest": towards_nearest,
}


class Violations:
    """Largest violations of the position and speed limits seen, rad and rad/s."""

    def __init__(self, limits):
        self.limits = limits
        self.position = self.speed = -np.inf

    def see(self, low, high, v):
        position = np.maximum(high - self.limits.q_max, self.limits.q_min - low)
        self.position = max(self.position, position.max())
        self.speed = max(self.speed, (np.abs(v) - self.limits.v_max).max())

    @property
    def worst(self):
        return max(self.position, self.speed)


def viable_states(solver, case, count, seed):
    q, v = (column(x) for x in states_of(case, 4 * count, seed))
    viable = solver.bounds(q, v).viable[:, 0]
    assert viable.sum() > 0.2 * count
    return q[viable][:count], v[viable][:count]


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", CASES)
def test_limits_hold_for_ever(name, policy):
    """In all, 1.6 million joint-steps."""
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    solver = BoundsSolver(limits, dt)
    rng = np.random.default_rng(1)
    q, v = viable_states(solver, case, MOTIONS, seed=2)
    seen = Violations(limits)
    for _ in range(STEPS):
        lower, upper, viable = solver.bounds(q, v)
        assert viable.all()
        a = POLICIES[policy](q, v, lower, upper, limits, rng)
        q, v, low, high = advance(q, v, a, dt)
        seen.see(low, high, v)
    assert seen.worst <= VIOLATION


@pytest.mark.parametrize("name", FAILING)
def test_algorithm_3_breaks_the_limits_where_condition_11_fails(name):
    """Which is why there is more to do there, and shows that this harness can tell."""
    case = FAILING[name]
    limits, dt = one_joint(*case[:5]), case[5]
    worst = -np.inf
    for policy in POLICIES.values():
        rng = np.random.default_rng(1)
        q, _ = (column(x) for x in states_of(case, 200, seed=2))
        v = np.zeros_like(q)
        seen = Violations(limits)
        for _ in range(STEPS):
            lower, upper = paper_algorithms.combined_bounds(q, v, limits, dt)
            lower, upper = (np.clip(b, limits.a_min, limits.a_max) for b in (lower, upper))
            a = policy(q, v, np.minimum(lower, upper), upper, limits, rng)
            q, v, low, high = advance(q, v, a, dt)
            seen.see(low, high, v)
        worst = max(worst, seen.worst)
    assert worst > 1e-3 * min(case[2], case[1] - case[0])


@pytest.mark.parametrize("name", CASES)
def test_limits_hold_for_any_shorter_period(name):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    solver = BoundsSolver(limits, dt, period=0.3 * dt)
    rng = np.random.default_rng(3)
    for policy in POLICIES.values():
        q, v = viable_states(solver, case, 100, seed=4)
        seen = Violations(limits)
        for _ in range(60):
            lower, upper, viable = solver.bounds(q, v)
            assert viable.all()
            a = policy(q, v, lower, upper, limits, rng)
            q, v, low, high = advance(q, v, a, dt * rng.uniform(0.05, 1.0))
            seen.see(low, high, v)
        assert seen.worst <= VIOLATION


def test_the_exact_kernel_is_for_one_period_where_condition_11_fails():
    """So that a shorter period must be told to the solver: it breaks the limits otherwise."""
    case = CASES["hardly affected"]
    limits, dt = one_joint(*case[:5]), case[5]
    solver = BoundsSolver(limits, dt)
    assert solver.exact.all()
    assert not BoundsSolver(limits, dt, period=0.5 * dt).exact.any()
    q, v = viable_states(solver, case, 400, seed=4)
    seen = Violations(limits)
    for _ in range(100):
        q, v, low, high = advance(q, v, solver.bounds(q, v).upper, 0.5 * dt)
        seen.see(low, high, v)
    assert seen.worst > 1e-3


DISTURBANCES = {
    "pushes up": lambda v, sign, w, rng: w + 0.0 * v,
    "pushes down": lambda v, sign, w, rng: -w + 0.0 * v,
    "pushes on": lambda v, sign, w, rng: w * np.sign(v),
    "pushes where it is told to go": lambda v, sign, w, rng: w * sign,
    "changes within the step": lambda v, sign, w, rng: w * rng.choice([-1.0, 1.0], v.shape),
    "any": lambda v, sign, w, rng: rng.uniform(-w, w, v.shape),
}


@pytest.mark.parametrize("period", [1.0, 0.5])
@pytest.mark.parametrize("share", [0.02, 0.3])
@pytest.mark.parametrize("name", CASES)
def test_a_margin_holds_against_any_disturbance(name, share, period):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    w = share * min(-case[3], case[4])
    try:
        solver = BoundsSolver(limits, dt, [w], period=period * dt)
    except JointLimitsError:
        # Then indeed the disturbance alone can throw the joint out within a few steps.
        assert w * dt > 0.1 * min(case[2], (case[1] - case[0]) / dt)
        return
    for policy in POLICIES.values():
        for disturbance in DISTURBANCES.values():
            rng = np.random.default_rng(5)
            q, v = viable_states(solver, case, 40, seed=6)
            seen = Violations(limits)
            for _ in range(20):
                lower, upper, viable = solver.bounds(q, v)
                assert viable.all()
                assert (upper >= lower).all()
                a = policy(q, v, lower, upper, limits, rng)
                sign = np.where(a > 0.5 * (lower + upper), 1.0, -1.0)
                for part in (0.4, 0.1, 0.5):
                    true = a + disturbance(v, sign, w, rng)
                    q, v, low, high = advance(q, v, true, part * period * dt)
                    seen.see(low, high, v)
            assert seen.worst <= VIOLATION


def test_without_a_margin_the_disturbance_breaks_the_limits():
    case = HOLDING["figure 3"]
    limits, dt = one_joint(*case[:5]), case[5]
    solver = BoundsSolver(limits, dt)
    q, v = viable_states(solver, case, 100, seed=6)
    seen = Violations(limits)
    for _ in range(20):
        q, v, low, high = advance(q, v, solver.bounds(q, v).upper + 0.2, dt)
        seen.see(low, high, v)
    assert seen.worst > 1e-3


def outside_states(case, count, seed):
    """Return states beyond the position limits, too fast, or too fast to stop in time."""
    rng = np.random.default_rng(seed)
    q_min, q_max, v_max, a_min, a_max, dt = case
    low = q_min if np.isfinite(q_min) else -1.0
    high = q_max if np.isfinite(q_max) else 1.0
    reach = 0.3 * (high - low)
    q = rng.uniform(low - reach, high + reach, count)
    v = rng.uniform(-2.0, 2.0, count) * min(v_max, (high - low) / dt)
    return column(q), column(v)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_every_joint_returns(name, policy, margin):
    case = CASES[name]
    limits, dt = one_joint(*case[:5]), case[5]
    w = margin * min(-case[3], case[4])
    try:
        solver = BoundsSolver(limits, dt, [w])
    except JointLimitsError:
        return
    rng = np.random.default_rng(7)
    q, v = outside_states(case, 300, seed=8)
    start = solver.bounds(q, v).viable
    assert not start.all()
    # The way that braking at its limit takes, from each state: no joint may go further.
    reach_up = q + np.where(v > 0.0, v * v / (2.0 * -limits.a_min), 0.0)
    reach_down = q - np.where(v < 0.0, v * v / (2.0 * limits.a_max), 0.0)
    highest = np.maximum(limits.q_max, reach_up)
    lowest = np.minimum(limits.q_min, reach_down)
    fastest = np.maximum(limits.v_max, np.abs(v))
    back = start.copy()
    for _ in range(3000):
        lower, upper, viable = solver.bounds(q, v)
        # Once back, never out again.
        assert (viable | ~back).all()
        back |= viable
        a = POLICIES[policy](q, v, lower, upper, limits, rng)
        q, v, low, high = advance(q, v, a, dt)
        assert (np.abs(v) <= fastest + VIOLATION).all()
        if condition_11(limits, dt, [w]).all():
            assert (high <= highest + VIOLATION).all()
            assert (low >= lowest - VIOLATION).all()
        if back.all():
            break
    assert back.all()


def test_a_step_beyond_the_limit_by_rounding_is_no_emergency():
    limits = one_joint(-1.0, 1.0, 2.0, -10.0, 10.0)
    lower, upper, viable = BoundsSolver(limits, 0.01).bounds([np.nextafter(1.0, 2.0)], [0.0])
    assert viable[0]
    assert upper[0] == pytest.approx(0.0, abs=1e-10)
    assert lower[0] == -10.0
