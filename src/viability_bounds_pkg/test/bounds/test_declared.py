# SPDX-License-Identifier: Apache-2.0
"""What declarations take from the bounds, and which leave none."""

import numpy as np
import pytest

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.node.bounds_parameters import (
    BoundsConfiguration,
    make_bounds,
)
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.viability import BoundsSolver

PANDA = read_config("panda", "bounds_node")
DECLARED = {
    "position_error": [1e-4] * 7,
    "velocity_error": [0.02] * 7,
    "acceleration_disturbance": [1.0, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0],
    "delay": 1,
    "delay_jitter": 1,
    "missed_deadlines": 2,
    "motor_bandwidth": [50.0] * 7,
}
REPORTED, ESTIMATED = {}, {"use_estimated_states": True}
PREDICTED = {"use_estimated_states": True, "velocity_estimation": False}
NARROW = {"position_min": [-0.5] * 7, "position_max": [0.5] * 7}


def configured(**changed):
    return read(BoundsConfiguration, PANDA | changed)


def largest_speed(**changed):
    """Return the speed at which joints brake near their limits, by bisection, rad/s."""
    config = configured(**changed)
    bounds, limits = make_bounds(config), config.limits
    low, high = np.zeros(7), limits.v_max.copy()
    for _ in range(40):
        v = 0.5 * (low + high)
        faster = bounds(limits.q_max - 0.1, v).upper > 0.0
        low, high = np.where(faster, v, low), np.where(faster, high, v)
    return low


@pytest.mark.parametrize("more", [REPORTED, ESTIMATED])
def test_nothing_declared_keeps_nothing_back(more):
    config = configured(**more, acceleration_drift=[], position_margin=0.0)
    limits, dt = config.limits, config.dt
    rng = np.random.default_rng(0)
    q, v = rng.uniform(limits.q_min, limits.q_max, (100, 7)), rng.uniform(-1.0, 1.0, (100, 7))
    expected = BoundsSolver(limits, config.bounds_dt_factor * dt, period=dt).bounds(q, v)
    for found, part in zip(make_bounds(config)(q, v), expected, strict=True):
        np.testing.assert_array_equal(found, part)


@pytest.mark.parametrize("name", DECLARED)
@pytest.mark.parametrize("more", [REPORTED, ESTIMATED, PREDICTED])
def test_each_declaration_takes_something(name, more):
    less = {**DECLARED, name: 0 if isinstance(DECLARED[name], int) else []}
    whole, left = largest_speed(**DECLARED, **more), largest_speed(**less, **more)
    if name == "velocity_error" and more == ESTIMATED:
        np.testing.assert_array_equal(left, whole)  # the observer's own error counts
    else:
        assert (left > whole).all()


def test_rows_of_missed_deadlines_and_late_commands_lengthen_the_horizon():
    assert configured(missed_deadlines=1).horizon == 2.0 * 0.002
    assert configured(missed_deadlines=4, delay_jitter=2).horizon == pytest.approx(7.0 * 0.002)


@pytest.mark.parametrize(
    ("changed", "name", "joint"),
    [
        ({"velocity_error": [0.1] * 6 + [1.2]}, "velocity_error", "panda_joint7"),
        ({"position_error": [0.1] * 3 + [2.0] * 4}, "position_error", "panda_joint4"),
        ({"missed_deadlines": 20, "velocity_error": [0.8] * 7}, "velocity_error", "panda_joint1"),
        ({"delay": 90, "missed_deadlines": 1, **ESTIMATED}, "delay", "panda_joint1"),
        ({"delay_jitter": 40}, "delay_jitter", "panda_joint1"),
        ({"motor_bandwidth": [50.0] * 2 + [1.0] * 5}, "motor_bandwidth", "panda_joint3"),
        ({"acceleration_disturbance": [30.0] + [0.1] * 6}, "acceleration_disturbance", "joint1"),
        ({"acceleration_drift": [1e6] * 7}, "acceleration_drift", "panda_joint1"),
        ({"position_margin": 1.0, **NARROW}, "position_margin", "panda_joint1"),
        ({"position_error": [3.0] * 7, "velocity_error": [3.0] * 7}, "rate_hz", "panda_joint1"),
    ],
)
def test_what_leaves_no_bounds_is_named_with_a_joint(changed, name, joint):
    with pytest.raises(SettingError) as refused:
        make_bounds(configured(**changed))
    assert refused.value.name == name
    wanted = "more" if name == "motor_bandwidth" else "less"
    wanted = "what leaves bounds" if name == "rate_hz" else f"{wanted} at 500 Hz"
    assert refused.value.allowed.startswith(f"{wanted} (")
    assert joint in refused.value.allowed
    assert "\n" not in str(refused.value)
