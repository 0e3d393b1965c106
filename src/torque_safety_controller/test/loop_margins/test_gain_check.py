# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.tools.gain_limits import (
    LIMIT_MARGIN,
    MARGIN,
    TORQUE_STEP,
    GainCheck,
)
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.testing.ros_harness import read_config

BOUNDS, CONTROLLER = (
    read_config("talos_left_arm", node) for node in ("bounds_node", "controller_node")
)
ARM = read(BoundsConfiguration, BOUNDS)
MODEL = load_model(ARM, ARM.read_urdf())
N = MODEL.nv
INERTIA = ArmInertia(MODEL, ARM.position_min, ARM.position_max)


def check(predicted=False, gains=None, **declared) -> GainCheck:
    given = {"use_estimated_states": predicted, "position_margin": 1e-6}
    calm = {"acceleration_disturbance": [5.0] * N}
    robot = read(BoundsConfiguration, BOUNDS | calm | declared | given)
    config = read(ControllerConfiguration, CONTROLLER | (gains or {}) | given)
    return GainCheck(config, robot)


def limits(**changed):
    return {limit.name: limit for limit in check(**changed).limits()}


def test_without_delay_the_gains_of_the_file_are_borne():
    found = limits()
    assert not any(limit.exceeded for limit in found.values())
    assert set(found) == {
        *("pose_kp", "pose_kd", "posture_kd", "hold_kd", "integral_lambda"),
        *("disturbance_time", "bounds_dt_factor"),
    }


def test_two_periods_of_delay_halve_the_integral_gain_and_a_prediction_gives_it_back():
    """With 100 1/s TALOS was in a lasting limit cycle on a joint limit, with 50 it was not."""
    late = limits(delay=2)
    assert late["integral_lambda"].exceeded
    assert 45.0 < late["integral_lambda"].limit < 55.0
    assert not late["pose_kp"].exceeded
    predicted = limits(delay=2, predicted=True)
    assert not predicted["integral_lambda"].exceeded
    assert predicted["bounds_dt_factor"].limit < late["bounds_dt_factor"].limit


def test_a_limit_is_where_the_margin_is():
    gain = limits(delay=2)["integral_lambda"].limit
    assert check(delay=2).margin(900.0, 50.0, 0.99 * gain) > MARGIN
    assert check(delay=2).margin(900.0, 50.0, 1.01 * gain) < MARGIN
    kd = limits(delay=2)["pose_kd"].limit
    kp = limits(delay=2)["pose_kp"].limit
    assert kp / 900.0 == pytest.approx((kd / 50.0) ** 2)
    assert check(delay=2).margin(0.98 * kp, 0.99 * kd, 0.0) > MARGIN
    assert check(delay=2).margin(1.02 * kp, 1.01 * kd, 0.0) < MARGIN
    factor = limits(delay=2, predicted=True)["bounds_dt_factor"].limit
    assert check(delay=2, predicted=True).limit_margin(1.01 * factor) > LIMIT_MARGIN
    assert check(delay=2, predicted=True).limit_margin(0.99 * factor) < LIMIT_MARGIN


@pytest.mark.parametrize(
    ("worse", "names"),
    [
        ({"delay": 1}, ["pose_kp", "integral_lambda"]),
        ({"delay": 1, "delay_jitter": 1}, ["pose_kp", "integral_lambda"]),
        ({"motor_bandwidth": np.full(N, 100.0)}, ["pose_kp", "integral_lambda"]),
        ({"velocity_error": np.full(N, 0.1)}, ["pose_kp", "pose_kd", "integral_lambda"]),
        ({"position_error": np.full(N, 1e-3)}, ["pose_kp"]),
    ],
)
def test_whatever_is_worse_allows_less(worse, names):
    for name in names:
        assert limits(**worse)[name].limit < limits()[name].limit


def test_jitter_counts_as_the_longer_delay():
    jitter, longer = limits(delay=1, delay_jitter=1), limits(delay=2)
    for name, limit in longer.items():
        assert jitter[name].limit == pytest.approx(limit.limit, rel=1e-3)


def test_integral_action_splits_into_loops_of_single_joints():
    """Eigenvalues of M^-1 diag(M), which scale its gain, are within the factors."""
    for M in INERTIA.matrices[:20]:
        factors = np.linalg.eigvals(np.linalg.solve(M, np.diag(np.diag(M)))).real
        low, high = INERTIA.factors
        assert low - 1e-9 <= factors.min()
        assert factors.max() <= high + 1e-9
        assert (1.0 / factors).sum() == pytest.approx(N)


def test_the_resolution_limits_each_gain_to_its_share_of_the_torque():
    """For the tasks all encoders step at once, with the worst of random signs."""
    declared = {"position_error": [1e-5] * N, "velocity_error": [1e-3] * N}
    found = check(**declared)
    position, velocity = found.steps
    by = {limit.name: limit.by_resolution for limit in found.limits()}
    random = np.random.default_rng(0)
    scale = by["pose_kd"] / 50.0
    assert by["pose_kp"] / 900.0 == pytest.approx(scale**2)
    worst = 0.0
    for M in INERTIA.matrices:
        for signs in random.choice([-1.0, 1.0], (20, N)):
            torque = M @ (signs * (900.0 * scale**2 * position + 50.0 * scale * velocity))
            worst = max(worst, (np.abs(torque) / ARM.torque_max).max())
    assert 0.5 * TORQUE_STEP < worst < 1.001 * TORQUE_STEP
    own = INERTIA.diagonal * velocity / ARM.torque_max
    assert (by["integral_lambda"] * own).max() == pytest.approx(TORQUE_STEP)
    share = -np.expm1(-1e-3 / by["disturbance_time"])
    assert (share / 1e-3 * own).max() == pytest.approx(TORQUE_STEP)


def test_disturbances_are_not_estimated_faster_than_predicted_commands_act():
    # As the observer sees them: predicted velocities, all of whose commands under way did not act.
    delay, wanted, acted = 5, 6.0, -6.0
    late = limits(delay=delay, predicted=True)["disturbance_time"]
    assert late.exceeded
    assert (late.value, late.limit) == (0.003, pytest.approx(0.005))
    for time, within in ((late.limit, True), (0.5 * late.limit, False)):
        observer = Disturbance(1, time)
        v = np.zeros(1)
        for change in (wanted * 1e-3, wanted * 1e-3 + delay * (acted - wanted) * 1e-3):
            mass, most = np.eye(1), np.full(1, 1e3)
            observer.observe(v, np.full(1, wanted), 1e-3, most, mass)
            v = v + change
        observer.observe(v, np.full(1, wanted), 1e-3, most, mass)
        assert (abs(observer.estimate[0]) <= abs(acted - wanted)) == within
    assert not limits(delay=3, predicted=True)["disturbance_time"].exceeded
    assert not limits(delay=5)["disturbance_time"].exceeded
