# SPDX-License-Identifier: Apache-2.0
"""Bounds of batches of arrays are the compiled ones, for each library that can be imported."""

import importlib

import numpy as np
import pytest

from viability_bounds_pkg import batch
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

TOLERANCE = 1e-12  # of the accelerations that change a speed from limit to limit in a step
N = 5


class Library:
    """Makes float64 arrays of a library."""

    def __init__(self, name):
        self.module = pytest.importorskip(
            {"jax": "jax.numpy"}.get(name, name), reason=f"{name} is not installed"
        )
        if name == "jax":
            importlib.import_module("jax").config.update("jax_enable_x64", True)

    def array(self, values):
        return self.module.asarray(values)


@pytest.fixture(params=["numpy", "torch", "jax"])
def library(request):
    return Library(request.param)


def random_solver(rng):
    """Joints with limits of any kind, often so narrow or fast that condition (11) fails."""
    while True:
        dt = 10.0 ** rng.uniform(-3.0, -0.5)
        a_min, a_max = -rng.uniform(2.0, 20.0, N), rng.uniform(2.0, 20.0, N)
        unit = np.maximum(-a_min, a_max) * dt
        length = unit * dt * 10.0 ** rng.uniform(0.5, 4.0, N)
        q_min = rng.uniform(-1.0, 1.0, N) * length
        v_max, q_max = unit * rng.uniform(0.5, 20.0, N), q_min + length
        q_min[rng.random(N) < 0.1], q_max[rng.random(N) < 0.1] = -np.inf, np.inf
        names = [f"joint_{j}" for j in range(N)]
        d, c = unit / dt * rng.uniform(0.2, 3.0, N), rng.uniform(0.0, 0.7, N)
        d[rng.random(N) < 0.5], c[rng.random(N) < 0.2] = np.inf, 0.0
        c = np.where(np.isinf(d), 0.0, c * np.sqrt(np.where(np.isinf(d), 0.0, d) * length))
        limits = JointLimits(names, q_min, q_max, v_max, a_min, a_max, c, d)
        share = rng.choice([0.0, 0.01, 0.1])
        errors = {"position_error": share * length, "velocity_error": share * v_max}
        margin = rng.choice([0.0, 0.1]) * np.minimum(-a_min, a_max)
        try:
            return BoundsSolver(limits, dt, margin, rng.choice([0.1, 1.0]) * dt, **errors), length
        except JointLimitsError:  # nothing is left of these
            continue


def states(solver, length, rng, shape):
    """States inside and outside the limits, some exactly on one of them."""
    limits = solver.limits
    low = np.where(np.isfinite(limits.q_min), limits.q_min, limits.q_max - length)
    low = np.where(np.isfinite(low), low, 0.0)
    q = low + rng.uniform(-0.2, 1.2, (*shape, N)) * length
    v = rng.uniform(-1.3, 1.3, (*shape, N)) * limits.v_max
    kind = rng.integers(0, 20, q.shape)
    q = np.where((kind == 0) & np.isfinite(limits.q_max), limits.q_max, q)
    q = np.where((kind == 1) & np.isfinite(limits.q_min), limits.q_min, q)
    v = np.where(kind == 2, limits.v_max, np.where(kind == 3, 0.0, v))
    return q, v


def test_bounds_are_the_compiled_ones(library):
    """Of 40 robots with 1,000 states each; the library may round in another order."""
    rng, viable, crossed = np.random.default_rng(0), 0, 0
    for _ in range(40):
        solver, length = random_solver(rng)
        q, v = states(solver, length, rng, (1000,))
        expected = solver.bounds(q, v)
        found = batch.bounds(solver, library.array(q), library.array(v))
        scale = np.maximum(1.0, 2.0 * solver.limits.v_max / solver.steps)
        for each, right in zip(found[:2], expected[:2], strict=True):
            assert isinstance(each, type(library.array(q)))
            assert np.all(np.abs(np.asarray(each) - right) <= TOLERANCE * scale)
        # On the edge of the kernel rounding decides.
        assert np.mean(np.asarray(found.viable) != expected.viable) < 1e-3
        viable += expected.viable.mean() / 40
        crossed += np.mean(expected.lower == expected.upper) / 40
    assert 0.2 < viable < 0.8 and crossed > 0.05


def test_any_leading_dimensions(library):
    rng = np.random.default_rng(1)
    solver, length = random_solver(rng)
    q, v = states(solver, length, rng, (3, 4, 2))
    whole = batch.acceleration_bounds(library.array(q), library.array(v), solver.limits, 0.01)
    expected = BoundsSolver(solver.limits, 0.01).bounds(q[1, 2, 1], v[1, 2, 1])
    single = batch.acceleration_bounds(
        library.array(q[1, 2, 1]), library.array(v[1, 2, 1]), solver.limits, 0.01
    )
    assert whole.lower.shape == whole.viable.shape == q.shape
    np.testing.assert_allclose(np.asarray(whole.upper)[1, 2, 1], expected.upper, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(single.lower), expected.lower, rtol=1e-12)


def test_nothing_but_limits_comes_from_states_that_are_not_numbers(library):
    rng = np.random.default_rng(2)
    solver, length = random_solver(rng)
    q, v = states(solver, length, rng, (4,))
    q[0, 0], v[1, 1], q[2, 2], v[3, 3] = np.nan, np.nan, np.inf, -np.inf
    lower, upper, viable = map(
        np.asarray, batch.bounds(solver, library.array(q), library.array(v))
    )
    assert np.all((solver.limits.a_min <= lower) & (upper <= solver.limits.a_max))
    assert np.all(lower <= upper)
    assert not np.diag(viable).any()


def test_float32_stays_float32(library):
    rng = np.random.default_rng(3)
    solver, length = random_solver(rng)
    q, v = (library.array(each.astype(np.float32)) for each in states(solver, length, rng, (9,)))
    assert batch.bounds(solver, q, v).upper.dtype == q.dtype


@pytest.mark.parametrize("shapes", [((N,), (2, N)), ((N + 1,), (N + 1,)), ((), ())])
def test_shapes_that_do_not_fit_are_refused(library, shapes):
    solver, _ = random_solver(np.random.default_rng(4))
    q, v = (library.array(np.zeros(shape)) for shape in shapes)
    with pytest.raises(JointLimitsError, match=r"both must have shape \(\.\.\., 5\)"):
        batch.bounds(solver, q, v)


def test_compiled_by_jax_and_differentiated():
    jax = pytest.importorskip("jax", reason="jax is not installed")
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(5)
    solver, length = random_solver(rng)
    q, v = states(solver, length, rng, (100,))
    upper = jax.jit(lambda q, v: batch.bounds(solver, q, v).upper)
    np.testing.assert_allclose(upper(q, v), solver.bounds(q, v).upper, rtol=1e-9, atol=1e-9)
    slope = jax.grad(lambda q: upper(q, v).sum())(q)
    assert np.isfinite(slope).all() and np.any(slope != 0.0)


def test_differentiated_by_torch():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    rng = np.random.default_rng(6)
    solver, length = random_solver(rng)
    q, v = (torch.asarray(each) for each in states(solver, length, rng, (100,)))
    q.requires_grad_()
    batch.bounds(solver, q, v).upper.sum().backward()
    assert torch.isfinite(q.grad).all() and (q.grad != 0.0).any()
