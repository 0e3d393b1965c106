# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.loop_margins.gain_check import (
    LIMIT_MARGIN,
    MARGIN,
    TORQUE_STEP,
    GainCheck,
    GainSettings,
    RobotTiming,
)
from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.robot_configuration import load_model
from viability_bounds_pkg.testing.ros_harness import read_config

ARM = read(BoundsConfiguration, read_config("talos_left_arm", "bounds_node"))
MODEL = load_model(ARM, ARM.read_urdf())
N = MODEL.nv
INERTIA = ArmInertia.of(MODEL, ARM.position_min, ARM.position_max)
GAINS = GainSettings(
    {"pose": (900.0, 50.0), "posture": (0.0, 5.0)}, 100.0, (0.1, 100.0, 0.5), 0.003
)
TIMING = RobotTiming(
    dt=1e-3,
    declared=replace(
        ARM.declared.without(*ARM.declared.names), acceleration_disturbance=np.full(N, 5.0)
    ),
    braking=np.full(N, 20.0),
    horizon=2.0,
)
ESTIMATED = {"predicted": True, "observed": True}


def timing(predicted=False, observed=False, **changed) -> RobotTiming:
    own = replace(TIMING.declared, **changed)
    return replace(TIMING, declared=own, predicted=predicted, observed=observed)


def check(gains=GAINS, **changed) -> GainCheck:
    return GainCheck(gains, timing(**changed), INERTIA, ARM.torque_max)


def limits(**changed):
    return {limit.name: limit for limit in check(**changed).limits()}


def test_without_delay_the_gains_of_the_file_are_borne():
    found = limits()
    assert not any(limit.exceeded for limit in found.values())
    assert set(found) == {
        *("pose_kp", "pose_kd", "posture_kd", "integral_lambda"),
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


def test_the_torque_step_of_the_resolution_is_the_worst_of_all_signs():
    error = np.full(N, 5e-5)
    found = check(position_error=error, **ESTIMATED)
    gains = timing(position_error=error).observers
    random = np.random.default_rng(0)
    worst = np.zeros(N)
    for M in INERTIA.matrices:
        for _ in range(20):
            step = 1e-4 * random.choice([-1.0, 1.0], N)
            q, v = gains.position * step, gains.velocity * step
            torque = M @ (900.0 * q + 50.0 * v) + 100.0 * np.diag(M) * v
            worst = np.maximum(worst, np.abs(torque) / ARM.torque_max)
    steps = found.step_at_rest()
    assert (worst <= steps + 1e-12).all()
    assert (steps < 2.0 * worst).all()


def test_resolution_limits_each_gain_to_its_share_of_the_torque():
    changed = {"position_error": np.full(N, 1e-5), **ESTIMATED}
    gain = limits(**changed)["integral_lambda"].by_resolution
    alone = GAINS._replace(tasks={"pose": (0.0, 1e-12)}, integral=gain)
    assert check(alone, **changed).step_at_rest().max() == pytest.approx(TORQUE_STEP, rel=0.01)
    time = limits(**changed)["disturbance_time"].by_resolution
    share = -np.expm1(-1e-3 / time)
    velocity = timing(**changed).steps.velocity
    torque = INERTIA.diagonal * share * velocity / 1e-3 / ARM.torque_max
    assert torque.max() == pytest.approx(TORQUE_STEP)


def test_disturbances_are_not_estimated_faster_than_predicted_commands_act():
    # As the observer sees them: predicted velocities, all of whose commands under way did not act.
    delay, wanted, acted = 5, 6.0, -6.0
    late = limits(delay=delay, predicted=True)["disturbance_time"]
    assert late.exceeded
    assert "'disturbance_time' is 0.003, " in str(late)
    assert "0.005 is the least allowed" in str(late)
    for time, within in ((late.limit, True), (0.5 * late.limit, False)):
        observer = DisturbanceObserver(1, time)
        v = np.zeros(1)
        for change in (wanted * 1e-3, wanted * 1e-3 + delay * (acted - wanted) * 1e-3):
            mass, most = np.eye(1), np.full(1, 1e3)
            observer.observe(v, np.full(1, wanted), 1e-3, most, mass)
            v = v + change
        observer.observe(v, np.full(1, wanted), 1e-3, most, mass)
        assert (abs(observer.known[0]) <= abs(acted - wanted)) == within
    assert not limits(delay=3, predicted=True)["disturbance_time"].exceeded
    assert not limits(delay=5)["disturbance_time"].exceeded


def test_what_is_exceeded_says_so_in_one_line():
    text = str(limits(delay=2)["integral_lambda"])
    assert text.startswith("parameter 'integral_lambda' is 100, but with the delay, motors and")
    assert "is the most allowed" in text
    assert "no value is allowed" in str(limits(delay=2)["bounds_dt_factor"]) or (
        "is the least allowed" in str(limits(delay=2)["bounds_dt_factor"])
    )
