# SPDX-License-Identifier: Apache-2.0
"""What follows from declarations, and which leave no bounds."""

import numpy as np
import pytest

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, make_bounds
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.state_estimation.observer import design_observer
from viability_bounds_pkg.testing.ros_harness import read_config

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
ESTIMATED = {"use_estimated_states": True}
NARROW = {"position_min": [-0.5] * 7, "position_max": [0.5] * 7}


def configured(**changed):
    return read(BoundsConfiguration, PANDA | changed)


def reach(config):
    """Speeds that the bounds keep, rad/s, and how far before its limits a joint rests, rad."""
    loop, declared = config.loop, config.declared
    margins, solver = loop.margins(declared), loop.bounds(declared)
    w = loop.torque_margins.acceleration + declared.acceleration_disturbance
    # What the errors may make of rest, or of the speed kept, by the end of a step.
    gained = margins.velocity_error + solver.steps * w
    away = margins.position_error + 0.5 * solver.steps * (margins.velocity_error + gained)
    rest = (gained**2)[:, None] / (2.0 * solver.braking)
    rest += (away + loop.torque_margins.position)[:, None]
    return solver.limits.v_max - gained, rest


@pytest.mark.parametrize("more", [{}, ESTIMATED])
def test_nothing_declared_keeps_nothing_back(more):
    config = configured(**more)
    assert not config.uncertainty.position_error.any()
    assert not config.uncertainty.velocity_error.any()
    assert config.horizon == config.bounds_dt_factor * config.dt


@pytest.mark.parametrize("name", DECLARED)
@pytest.mark.parametrize("more", [{}, ESTIMATED, {**ESTIMATED, "velocity_estimation": False}])
def test_each_declaration_takes_something(name, more):
    less = {**DECLARED, name: 0 if isinstance(DECLARED[name], int) else []}
    _, whole = reach(configured(**DECLARED, **more))
    _, left = reach(configured(**less, **more))
    if name == "velocity_error" and more == ESTIMATED:
        np.testing.assert_array_equal(left, whole)
    else:
        assert (left < whole).all()


def test_observed_velocities_have_the_errors_of_the_observer():
    config = configured(position_error=[1e-4] * 7, acceleration_disturbance=[0.2] * 7, **ESTIMATED)
    design = design_observer(config.dt, [1e-4] * 7, [0.2] * 7)
    np.testing.assert_array_equal(config.uncertainty.position_error, design.position_error)
    np.testing.assert_array_equal(config.uncertainty.velocity_error, design.velocity_error)


def test_rows_of_missed_deadlines_and_late_commands_lengthen_the_horizon():
    assert configured(missed_deadlines=1).horizon == 2.0 * 0.002
    assert configured(missed_deadlines=4).horizon == pytest.approx(5.0 * 0.002)
    assert configured(missed_deadlines=4, delay_jitter=2).horizon == pytest.approx(7.0 * 0.002)


@pytest.mark.parametrize("missed", [0, 2])
def test_bounds_that_look_far_ahead_give_way_to_what_commands_act_for(missed):
    """But no further: a command may act for as long as a row of missed deadlines."""
    config = configured(missed_deadlines=missed, bounds_dt_factor=100.0)
    solver = config.loop.bounds(config.declared)
    held = (1 + missed) * config.dt
    assert (solver.steps >= held).all()
    assert (solver.steps < config.horizon).any()
    assert solver.exact.all()
    assert config.uncertainty.held == pytest.approx(held)


@pytest.mark.parametrize("more", [{}, ESTIMATED])
def test_joints_rest_and_keep_a_speed_where_the_margins_say(more):
    config = configured(**DECLARED, **more)
    bounds, (speed, rest) = make_bounds(config), reach(config)
    limits, still = config.limits, np.zeros(7)
    np.testing.assert_allclose(bounds(limits.q_max - rest[:, 0], still).upper, 0.0, atol=1e-7)
    np.testing.assert_allclose(bounds(limits.q_min + rest[:, 1], still).lower, 0.0, atol=1e-7)
    middle = 0.5 * (limits.q_min + limits.q_max)
    np.testing.assert_allclose(bounds(middle, speed).upper, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "name", "joint"),
    [
        ({"velocity_error": [0.1] * 6 + [1.2]}, "velocity_error", "panda_joint7"),
        ({"position_error": [0.1] * 3 + [2.0] * 4}, "position_error", "panda_joint4"),
        ({"missed_deadlines": 90, "velocity_error": [0.8] * 7}, "velocity_error", "panda_joint1"),
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
