# SPDX-License-Identifier: Apache-2.0
"""The linear loop of a joint, the largest gains that a robot bears, and the tool for them."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from torque_safety_controller.integral_feedback.leaky_integrator import LeakyIntegrator
from torque_safety_controller.loop_margins import (
    Feedback,
    Link,
    filter_share,
    limit_gains,
    motion,
    open_loop,
)
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.disturbance import Disturbance
from torque_safety_controller.tools.gain_limits import GainCheck, main
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config
from viability_bounds_pkg.viability import BoundsSolver

DT = 1e-3
LEAK = (0.1, 100.0, 0.5)
POLE = math.exp(-150.0 * DT)
OBSERVER = 1.0 - POLE**2, (1.0 - POLE) ** 2 / DT


def simulated(link, gains, steps=400, factor=1.0):
    """Return the positions of a joint with unit inertia, written as a loop over time."""
    A, b = motion(DT, link.lag)
    x = np.array([0.01, 0.0, 0.0])
    under_way = deque([0.0] * link.delay)
    sent = deque([0.0] * (link.predicted or 0))
    lag = link.lag if link.predicted is not None else 0.0
    A_model, b_model = motion(DT, lag)
    fast, slow = LeakyIntegrator(gains.leak[1], 1), LeakyIntegrator(gains.leak[0], 1)
    estimate = np.zeros(3)
    s, v_before, a_ref, e = 0.0, 0.0, 0.0, 0.0
    found = []
    for _ in range(steps):
        found.append(x[0])
        seen = np.array([x[0], x[1], estimate[2]])
        if link.observer is not None:
            error = x[0] - estimate[0]
            seen[:2] = estimate[:2] + np.multiply(link.observer, error)
        ahead = seen
        for command in sent:
            ahead = A_model @ ahead + b_model * command
        ahead = ahead + lag * np.array([ahead[1], ahead[2], 0.0])
        increment = a_ref * DT - (ahead[1] - v_before)
        s += increment
        integral = gains.leak[2] * fast.update([s], DT) + (1.0 - gains.leak[2]) * slow.update(
            [s], DT
        )
        a_ref = -gains.kp * ahead[0] - gains.kd * ahead[1]
        if gains.disturbance_time:
            e += filter_share(gains.disturbance_time, DT) * (-increment / DT - e)
            a_ref -= e
        v_before = ahead[1]
        command = a_ref + gains.integral * integral[0]
        sent.append(command)
        estimate = A_model @ seen + b_model * sent.popleft()
        under_way.append(factor * command)
        x = A @ x + b * under_way.popleft()
    return np.array(found)


CASES = [
    (Link(DT), Feedback(900.0, 50.0)),
    (Link(DT, 2), Feedback(900.0, 50.0, 100.0, LEAK, 0.003)),
    (Link(DT, 1, 1.0 / 300.0), Feedback(400.0, 40.0, 50.0)),
    (Link(DT, 2, 5e-3, predicted=2), Feedback(900.0, 60.0, 100.0)),
    (Link(DT, 3, 5e-3, OBSERVER, 2), Feedback(900.0, 60.0, 50.0)),
]


@pytest.mark.parametrize("case", CASES)
def test_the_matrices_are_those_of_the_loop_written_out(case, factor=1.25):
    loop = open_loop(*case)
    q = simulated(*case, factor=factor)
    x = np.zeros(len(loop.b))
    x[0] = q[0]
    closed = loop.A + factor * np.outer(loop.b, loop.c)
    expected = []
    for _ in q:
        expected.append(x[0])
        x = closed @ x
    np.testing.assert_allclose(q, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_the_modulus_margin_is_a_gain_margin(case):
    """The loop stays stable with gains between 1 / (1 + m) and 1 / (1 - m)."""
    loop = open_loop(*case)
    margin = loop.modulus_margin()
    assert 0.0 < margin < 1.0
    for factor in (1.0 / (1.0 + 0.99 * margin), 1.0 / (1.0 - 0.99 * margin)):
        assert loop._replace(b=factor * loop.b).spectral_radius() < 1.0 + 1e-6


def test_the_bounds_of_the_paper_have_half_a_margin_and_bear_no_delay():
    """Slopes 2 / T^2 and 2 / T for T of two periods: |z|^2 = 1 / 4, with a delay 3 / 2."""
    horizon = 2.0 * DT
    gains = Feedback(2.0 / horizon**2, 2.0 / horizon)
    loop = open_loop(Link(DT), gains)
    assert loop.modulus_margin() == pytest.approx(0.5, abs=1e-3)
    late = open_loop(Link(DT, 1), gains)
    assert late.spectral_radius() == pytest.approx(math.sqrt(1.5), abs=1e-6)
    assert late.modulus_margin() == 0.0


@pytest.mark.parametrize("disturbance", [0.0, 4.0])
def test_bounds_at_a_limit_are_as_steep_as_the_formula_says(disturbance):
    limits = JointLimits(["a"], [-1.0], [1.0], [2.0], [-10.0], [10.0])
    horizon, margin = 2.0 * DT, np.array([disturbance])
    solver = BoundsSolver(limits, horizon, margin, DT)

    def upper(x, v):
        return solver.bounds(np.array([1.0 - x]), np.array([v])).upper[0]

    low, high = 0.0, 1e-3
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if upper(middle, 0.0) < 0.0 else (low, middle)
    step_q, step_v = 1e-9, 1e-6
    kp_found, kd_found = limit_gains(horizon, margin, np.array([10.0]))
    kp = (upper(high + step_q, 0.0) - upper(high, 0.0)) / step_q
    kd = (upper(high, -step_v) - upper(high, 0.0)) / step_v
    assert kp == pytest.approx(kp_found[0], rel=0.02)
    assert kd == pytest.approx(kd_found[0], rel=0.02)


# Limits of a robot


BOUNDS, CONTROLLER = (
    read_config("talos_left_arm", node) for node in ("bounds_node", "controller_node")
)
ARM = read(BoundsConfiguration, BOUNDS)
N = len(ARM.joints)
KP, KD = 900.0, 50.0  # of the file
MARGIN, LIMIT_MARGIN = 0.5, 0.3  # that gains are to leave


def check(predicted=False, **declared) -> GainCheck:
    given = {"use_estimated_states": predicted, "position_margin": 1e-6}
    calm = {"acceleration_disturbance": [5.0] * N}
    robot = read(BoundsConfiguration, BOUNDS | calm | declared | given)
    return GainCheck(read(ControllerConfiguration, CONTROLLER | given), robot)


def limits(**changed):
    return {limit.name: limit for limit in check(**changed).limits()}


@pytest.fixture(scope="module")
def ideal():
    """Limits of an arm without delay or errors."""
    return limits()


def test_two_periods_of_delay_halve_the_integral_gain_and_a_prediction_gives_it_back(ideal):
    """With 100 1/s TALOS was in a lasting limit cycle on a joint limit, with 50 it was not."""
    assert not any(limit.exceeded for limit in ideal.values())
    late = limits(delay=2)
    assert late["integral_lambda"].exceeded
    assert 45.0 < late["integral_lambda"].limit < 55.0
    assert not late["pose_kp"].exceeded
    predicted = limits(delay=2, predicted=True)
    assert not predicted["integral_lambda"].exceeded
    assert predicted["bounds_dt_factor"].limit < late["bounds_dt_factor"].limit


def test_a_limit_is_where_the_margin_is():
    late = check(delay=2)
    found = {limit.name: limit.limit for limit in late.limits()}
    gain, kp, kd = (found[name] for name in ("integral_lambda", "pose_kp", "pose_kd"))
    assert late.margin(KP, KD, 0.99 * gain) > MARGIN > late.margin(KP, KD, 1.01 * gain)
    assert kp / KP == pytest.approx((kd / KD) ** 2)
    assert late.margin(0.98 * kp, 0.99 * kd, 0.0) > MARGIN
    assert late.margin(1.02 * kp, 1.01 * kd, 0.0) < MARGIN
    predicted = check(delay=2, predicted=True)
    (factor,) = (limit.limit for limit in predicted.limits() if limit.name == "bounds_dt_factor")
    assert predicted.limit_margin(1.01 * factor) > LIMIT_MARGIN
    assert predicted.limit_margin(0.99 * factor) < LIMIT_MARGIN


def test_jitter_counts_as_the_longer_delay():
    jitter, longer = limits(delay=1, delay_jitter=1), limits(delay=2)
    for name, limit in longer.items():
        assert jitter[name].limit == pytest.approx(limit.limit, rel=1e-3)


def test_the_resolution_limits_each_gain_to_a_twentieth_of_the_torque():
    """Encoders that all step at once, with the worst of random signs."""
    found = check(position_error=[1e-5] * N, velocity_error=[1e-3] * N)
    position, velocity = found.steps
    by = {limit.name: limit.by_resolution for limit in found.limits()}
    random = np.random.default_rng(0)
    worst = 0.0
    for M in found.inertia.matrices:
        for signs in random.choice([-1.0, 1.0], (20, N)):
            torque = M @ (signs * (by["pose_kp"] * position + by["pose_kd"] * velocity))
            worst = max(worst, (np.abs(torque) / ARM.torque_max).max())
    assert 0.5 * 0.05 < worst < 1.001 * 0.05
    own = found.inertia.diagonal * velocity / ARM.torque_max
    assert (by["integral_lambda"] * own).max() == pytest.approx(0.05)


def test_disturbances_are_not_estimated_faster_than_predicted_commands_act():
    """As the observer sees them: predicted velocities, whose commands under way did not act."""
    delay, wanted, acted = 5, 6.0, -6.0
    late = limits(delay=delay, predicted=True)["disturbance_time"]
    assert late.exceeded
    assert (late.value, late.limit) == (0.003, pytest.approx(0.005))
    for time, within in ((late.limit, True), (0.5 * late.limit, False)):
        observer = Disturbance(1, time)
        v = np.zeros(1)
        for change in (0.0, wanted * 1e-3, wanted * 1e-3 + delay * (acted - wanted) * 1e-3):
            v = v + change
            observer.observe(v, np.full(1, wanted), 1e-3, np.full(1, 1e3), np.eye(1))
        assert (abs(observer.estimate[0]) <= abs(acted - wanted)) == within
    assert not limits(delay=5)["disturbance_time"].exceeded


# The tool


def run(robot, text=None, folder=None) -> int:
    """Run it for a robot with further declarations."""
    files = [config_folder() / f"{robot}.yaml"]
    if text is not None:
        files.append(folder / "declared.yaml")
        files[1].write_text(f"/**/bounds_node:\n  ros__parameters: {{{text}}}\n")
    return main([word for path in files for word in ("--params-file", str(path))])


@pytest.mark.parametrize("robot", ["baxter_left_arm", "panda", "talos_left_arm"])
def test_ideal_robots_bear_the_gains_of_their_files(robot, capsys):
    assert run(robot) == 0
    assert "exceeded" not in capsys.readouterr().out


def test_the_tool_prints_the_largest_gains_and_says_what_is_exceeded(tmp_path, capsys):
    assert run("talos_left_arm", "delay: 2", tmp_path) == 1
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert rows["integral_lambda"].split()[:4] == ["integral_lambda", "100", "<=", "49.28"]
    assert rows["integral_lambda"].endswith("exceeded")
    assert rows["bounds_dt_factor"].endswith("exceeded")
    assert not rows["pose_kp"].endswith("exceeded")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("delay: -1", "parameter 'delay' is -1"),
        ("dellay: 1", "unknown parameter 'dellay'; did you mean 'delay'?"),
    ],
)
def test_what_is_wrong_in_a_file_gets_one_line(tmp_path, capsys, text, line):
    assert run("talos_left_arm", text, tmp_path) == 1
    said = capsys.readouterr().err
    assert said.startswith("gain_limits: ")
    assert line in said
    assert said.count("\n") == 1
